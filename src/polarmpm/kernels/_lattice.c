/* Multigrid on the lattice: operators of coarser lattices, and what leads from one to the next. The driver is
 * solvers/hierarchy.py. */
#include "_rows.h"

typedef struct {
    const int32_t *parents;    /* [node][PARENTS] nodes of the coarser lattice; -1: none */
    const double *weights;     /* [node][PARENTS] */
    const uint8_t *free;       /* [node * block] unknowns that are interpolated */
    const int64_t *lin;        /* [coarse node] number in the lattice; differences tell neighbours */
    int64_t codes, centre;     /* how many neighbours are told apart; the difference of none */
    int32_t *place;            /* [coarse node][codes] block column in the row of the coarser matrix; -1: none */
} Transfer;

/* C(p, q) += w T, with half rows where it belongs. `other`: also C(q, p) += w T', for the entries of the finer matrix that
 * aren't read, being those that are, transposed. */
INLINE void add_coarse(const int nb, const BlockRows *C, const Transfer *P, int64_t p, int64_t q, double w, const double *T,
                       int other)
{
    if (!C->half || p <= q) {
        const int64_t k = P->place[p * P->codes + P->lin[q] - P->lin[p] + P->centre];
        for (int i = 0; i < nb; ++i) {
            double *line = C->values + C->row_start[p * nb + i] + k * nb;
            for (int j = 0; j < nb; ++j) line[j] += w * T[i * nb + j];
        }
    }
    if (other && (!C->half || q <= p)) {
        const int64_t k = P->place[q * P->codes + P->lin[p] - P->lin[q] + P->centre];
        for (int j = 0; j < nb; ++j) {
            double *line = C->values + C->row_start[q * nb + j] + k * nb;
            for (int i = 0; i < nb; ++i) line[i] += w * T[i * nb + j];
        }
    }
}

/* C += P' A P, a row of A after the other: first times P, then P' times that. */
INLINE int coarsen_of(const int nb, const BlockRows *A, const Transfer *P, const BlockRows *C)
{
    const int size = nb * nb, codes = (int)P->codes;
    double *T = malloc(sizeof(double) * size * codes);
    int32_t *slot = malloc(sizeof(int32_t) * codes), *met = malloc(sizeof(int32_t) * codes);
    int failed = !T || !slot || !met;
    for (int k = 0; !failed && k < codes; ++k) slot[k] = -1;
    for (int64_t row = 0; !failed && row < A->nodes; ++row) {
        const int32_t *own = P->parents + row * PARENTS;
        const double *weight = P->weights + row * PARENTS;
        const int64_t from = own[0] < 0 ? 0 : P->lin[own[0]] - P->centre;
        double D[BLOCK_MAX * BLOCK_MAX], B[BLOCK_MAX * BLOCK_MAX];
        ask_for_row(nb, A, row + AHEAD);
        if (own[0] < 0) continue;
        diagonal_block(A, nb, row, D);
        for (int i = 0; i < nb; ++i)
            if (!P->free[row * nb + i]) D[i * nb + i] = 0.0;
        for (int other = 1; other >= 0; --other) {
            int n = 0;
            for (int64_t b = A->offsets[row]; b < A->offsets[row + 1]; ++b) {
                const int64_t col = A->cols[b], k = b - A->offsets[row];
                const int twice = A->half || (A->symmetric && col < A->nodes);
                if (col == row || twice != other || (twice && col < row)) continue;
                for (int i = 0; i < nb; ++i)
                    for (int j = 0; j < nb; ++j) B[i * nb + j] = block_entry(A, nb, row, k, i, j);
                for (int a = 0; a < PARENTS && P->parents[col * PARENTS + a] >= 0; ++a) {
                    const int64_t q = P->parents[col * PARENTS + a], code = P->lin[q] - from;
                    const double w = P->weights[col * PARENTS + a];
                    if (slot[code] < 0) {
                        slot[code] = n;
                        met[n] = (int32_t)q;
                        memset(T + n * size, 0, sizeof(double) * size);
                        ++n;
                    }
                    double *t = T + slot[code] * size;
                    for (int i = 0; i < size; ++i) t[i] += w * B[i];
                }
            }
            for (int a = 0; a < PARENTS && own[a] >= 0; ++a)
                for (int s = 0; s < n; ++s) add_coarse(nb, C, P, own[a], met[s], weight[a], T + s * size, other);
            for (int s = 0; s < n; ++s) slot[P->lin[met[s]] - from] = -1;
        }
        for (int a = 0; a < PARENTS && own[a] >= 0; ++a)
            for (int c = 0; c < PARENTS && own[c] >= 0; ++c)
                add_coarse(nb, C, P, own[a], own[c], weight[a] * weight[c], D, 0);
    }
    free(T);
    free(slot);
    free(met);
    return failed;
}

BY_BLOCK(coarsen, int, (const BlockRows *A, const Transfer *P, const BlockRows *C), A, P, C)

int polarmpm_coarsen(const BlockRows *A, const Transfer *P, const BlockRows *C) { return BLOCK_CALL(coarsen, A, P, C); }

/* Marks which coarse nodes are coupled: mark[node][code of the other one], of symmetric rows from the smaller number. */
void polarmpm_couple_parents(const BlockRows *A, const Transfer *P, uint8_t *mark)
{
    for (int64_t row = 0; row < A->nodes; ++row)
        for (int64_t b = A->offsets[row]; b < A->offsets[row + 1]; ++b) {
            const int32_t *parents = P->parents + row * PARENTS, *others = P->parents + (int64_t)A->cols[b] * PARENTS;
            if (A->symmetric && A->cols[b] < row) continue;  /* the same as from the other row */
            for (int a = 0; a < PARENTS && parents[a] >= 0; ++a)
                for (int c = 0; c < PARENTS && others[c] >= 0; ++c) {
                    const int swapped = A->symmetric && others[c] < parents[a];
                    const int64_t p = swapped ? others[c] : parents[a], q = swapped ? parents[a] : others[c];
                    mark[p * P->codes + P->lin[q] - P->lin[p] + P->centre] = 1;
                }
        }
}

/* coarse += P' fine */
void polarmpm_restrict(int64_t nodes, int32_t nb, const Transfer *P, const double *fine, double *coarse)
{
    for (int64_t row = 0; row < nodes; ++row)
        for (int a = 0; a < PARENTS && P->parents[row * PARENTS + a] >= 0; ++a)
            for (int i = 0; i < nb; ++i)
                coarse[(int64_t)P->parents[row * PARENTS + a] * nb + i] +=
                    P->free[row * nb + i] ? P->weights[row * PARENTS + a] * fine[row * nb + i] : 0.0;
}

/* fine += P coarse */
void polarmpm_prolong(int64_t nodes, int32_t nb, const Transfer *P, const double *coarse, double *fine)
{
    for (int64_t row = 0; row < nodes; ++row)
        for (int a = 0; a < PARENTS && P->parents[row * PARENTS + a] >= 0; ++a)
            for (int i = 0; i < nb; ++i)
                fine[row * nb + i] += P->free[row * nb + i]
                                          ? P->weights[row * PARENTS + a] * coarse[(int64_t)P->parents[row * PARENTS + a] * nb + i]
                                          : 0.0;
}

/* Whether all of some numbers are finite, in one pass. */
FAST int polarmpm_finite(int64_t count, const double *values)
{
    enum { AT_ONCE = 4 };
    double_vec sum[AT_ONCE] = {{0.0}};
    int64_t k = 0;
    for (; k + AT_ONCE * PIECE <= count; k += AT_ONCE * PIECE)
        for (int i = 0; i < AT_ONCE; ++i) sum[i] += *(const double_vec *)(values + k + i * PIECE) * 0.0;
    double rest = total((sum[0] + sum[1]) + (sum[2] + sum[3]));
    for (; k < count; ++k) rest += values[k] * 0.0;
    return rest == 0.0;
}

INLINE int all_of(const int nb, const uint8_t *flags)
{
    int all = 1;
    for (int i = 0; i < nb; ++i) all &= flags[i];
    return all;
}

/* Unknowns that are coupled with others. Blocks between nodes of which all are stay unread. */
void polarmpm_coupled(const BlockRows *A, uint8_t *coupled)
{
    const int nb = A->block;
    for (int64_t row = 0; row < A->nodes; ++row)
        for (int64_t b = A->offsets[row]; b < A->offsets[row + 1]; ++b) {
            const int64_t col = A->cols[b];
            uint8_t *mine = coupled + row * nb, *other = coupled + col * nb;
            if ((A->symmetric && col < row) || (all_of(nb, mine) && all_of(nb, other))) continue;
            for (int i = 0; i < nb; ++i)
                for (int j = A->half && col == row ? i + 1 : 0; j < nb; ++j) {
                    if ((col == row && i == j) || (mine[i] && other[j])) continue;
                    if (block_entry(A, nb, row, b - A->offsets[row], i, j) == 0.0) continue;
                    mine[i] = 1;
                    other[j] = 1;
                }
        }
}

/* What relaxation on each rank for itself needs on the diagonal: half of the couplings with other ranks' columns, which
 * keeps the smoother a contraction. `size`: square root of the diagonal, other ranks' behind this one's. */
void polarmpm_damp(const BlockRows *A, const double *size, double *added)
{
    const int nb = A->block;
    for (int64_t row = 0; row < A->nodes; ++row)
        for (int i = 0; i < nb; ++i) {
            double sum = 0.0;
            for (int64_t b = A->offsets[row]; b < A->offsets[row + 1]; ++b) {
                const int64_t col = A->cols[b];
                for (int j = 0; col >= A->nodes && j < nb; ++j)
                    if (size[col * nb + j] > 0.0)
                        sum += fabs(block_entry(A, nb, row, b - A->offsets[row], i, j)) / size[col * nb + j];
            }
            added[row * nb + i] = 0.5 * sum * size[row * nb + i];
        }
}

SIZE_OF(Transfer);

/* Multigrid on the lattice: products with block rows in double precision, Gauss-Seidel relaxation of blocks with rows in
 * single precision, the operators of coarser lattices. The driver is solvers/hierarchy.py.
 *
 * A row of the relaxation is a dense matrix of `block` lines, padded to LINE numbers, whose columns are the unknowns of the
 * row's neighbours: these are gathered once, then all lines are vectors. Vectors of unknowns are double.
 *
 * Reading the rows is what all this costs. Of symmetric matrices the half behind the diagonal is read alone, and once in a
 * product or a sweep: what a row's blocks give to the row, and, transposed, what they give to the later rows. */
#include "_points.h"

enum {
    LINE = 8,                  /* numbers of a vector in single precision */
    PIECE = 4,                 /* in double precision; wider vectors than a processor has are kept in memory */
    BLOCK_MAX = 6,             /* unknowns of a node */
    AHEAD = 2,                 /* rows */
    PARENTS = 8                /* nodes of the coarser lattice that a node is interpolated from */
};

typedef float single_vec __attribute__((vector_size(4 * LINE), aligned(4)));
typedef double double_vec __attribute__((vector_size(8 * PIECE), aligned(8)));

typedef struct {
    int32_t block;             /* unknowns of a node */
    int32_t half;              /* of a symmetric matrix: the diagonal block first, of which the upper triangle counts, then
                                * later columns; else all columns, those of this rank ascending */
    int32_t symmetric;         /* a block before the diagonal is the transposed of one behind it, and isn't read */
    int64_t nodes;             /* rows; columns beyond them are other ranks' */
    const int64_t *offsets;    /* [node + 1] first block of a row */
    const int32_t *cols;       /* [block] */
    const int64_t *row_start;  /* [node * block + i] address of block column 0 */
    double *values;
} BlockRows;

typedef struct {
    int64_t widest;            /* neighbours in the longest list */
    int32_t symmetric;         /* what stands before the diagonal is the transposed of what stands behind it */
    const int64_t *up, *low;   /* [node + 1] first neighbour behind the node; before it, and of other ranks: of symmetric
                                * matrices of other ranks only */
    const int32_t *up_cols, *low_cols;
    const int32_t *up_at, *low_at;  /* which block of the row it is */
    const int64_t *up_start, *low_start;  /* [node] address of the row's dense matrix */
    float *up_rows, *low_rows;
    const int64_t *early;      /* [node + 1] of symmetric rows: blocks before the diagonal, as they stand in other rows; in
                                * those rows only that `rest_of` is asked for */
    const int32_t *early_cols, *early_at;  /* the other row, and which block of it */
    float *inverse;            /* [node][block][block] of the diagonal's block */
    float *given;              /* [node * block] of symmetric matrices: what the rows met so far have taken from a row */
    double *added;             /* [node * block] to the diagonal, before it's inverted */
} Relaxation;

typedef struct {
    const int32_t *parents;    /* [node][PARENTS] nodes of the coarser lattice; -1: none */
    const double *weights;     /* [node][PARENTS] */
    const uint8_t *free;       /* [node * block] unknowns that are interpolated */
    const int64_t *lin;        /* [coarse node] number in the lattice; differences tell neighbours */
    int64_t codes, centre;     /* how many neighbours are told apart; the difference of none */
    int32_t *place;            /* [coarse node][codes] block column in the row of the coarser matrix; -1: none */
} Transfer;

INLINE double block_entry(const BlockRows *A, const int nb, int64_t row, int64_t k, int i, int j)
{
    return A->values[A->row_start[row * nb + i] + k * nb + j];
}

/* Block of the diagonal of a row, whole. */
INLINE void diagonal_block(const BlockRows *A, const int nb, int64_t row, double *D)
{
    int64_t k = 0;
    if (!A->half)
        while (k < A->offsets[row + 1] - A->offsets[row] && A->cols[A->offsets[row] + k] != row) ++k;
    for (int i = 0; i < nb; ++i)
        for (int j = 0; j < nb; ++j)
            D[i * nb + j] = A->half && j < i ? block_entry(A, nb, row, k, j, i) : block_entry(A, nb, row, k, i, j);
}

/* Sums of a vector's numbers. */
INLINE double total(double_vec v)
{
    return (v[0] + v[2]) + (v[1] + v[3]);
}

INLINE float single_total(single_vec v)
{
    return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7]));
}

/* sum += n blocks of a row, from `lines` on, times x. With `both` also y += these blocks, transposed, times `own`. */
INLINE void add_blocks(const int nb, const int both, int64_t n, const int32_t *cols, const double *const *lines,
                       const double *x, const double *own, double *xg, double *yg, double *sum, double *y)
{
    const int64_t width = n * nb;
    double_vec s[BLOCK_MAX];
    int64_t k = 0;
    for (int i = 0; i < nb; ++i) s[i] = (double_vec){0.0};
    for (int64_t a = 0; a < n; ++a)
        for (int j = 0; j < nb; ++j) xg[a * nb + j] = x[(int64_t)cols[a] * nb + j];
    for (; k + PIECE <= width; k += PIECE) {
        const double_vec X = *(const double_vec *)(xg + k);
        double_vec Y = {0.0};
        for (int i = 0; i < nb; ++i) {
            const double_vec R = *(const double_vec *)(lines[i] + k);
            s[i] += R * X;
            if (both) Y += R * own[i];
        }
        if (both) *(double_vec *)(yg + k) = Y;
    }
    for (; k < width; ++k) {
        double Y = 0.0;
        for (int i = 0; i < nb; ++i) {
            sum[i] += lines[i][k] * xg[k];
            Y += lines[i][k] * own[i];
        }
        if (both) yg[k] = Y;
    }
    for (int64_t a = 0; both && a < n; ++a)
        for (int j = 0; j < nb; ++j) y[(int64_t)cols[a] * nb + j] += yg[a * nb + j];
    for (int i = 0; i < nb; ++i) sum[i] += total(s[i]);
}

/* y = A x; columns of other ranks are in x behind this one's. */
INLINE void product_of(const int nb, const BlockRows *A, const double *x, double *y)
{
    int64_t widest = 0;
    for (int64_t row = 0; row < A->nodes; ++row)
        widest = A->offsets[row + 1] - A->offsets[row] > widest ? A->offsets[row + 1] - A->offsets[row] : widest;
    double *xg = vectors(2 * (widest * nb + 8)), *yg = xg ? xg + widest * nb + 8 : NULL;
    for (int64_t k = 0; k < A->nodes * nb; ++k) y[k] = xg ? 0.0 : NAN;
    for (int64_t row = 0; xg && row < A->nodes; ++row) {
        const int32_t *cols = A->cols + A->offsets[row];
        const int64_t n = A->offsets[row + 1] - A->offsets[row];
        int64_t from = 0, behind = 1;  /* the diagonal's block, and the first behind those of this rank */
        const double *lines[BLOCK_MAX], *own = x + row * nb;
        double sum[BLOCK_MAX] = {0.0};
        for (int i = 0; i < nb; ++i) lines[i] = A->values + A->row_start[row * nb + i];
        if (A->half) {
            for (int i = 0; i < nb; ++i) {
                sum[i] += lines[i][i] * own[i];
                for (int j = i + 1; j < nb; ++j) {
                    sum[i] += lines[i][j] * own[j];
                    sum[j] += lines[i][j] * own[i];
                }
            }
        } else if (A->symmetric) {
            while (cols[from] != row) ++from;
            for (behind = from + 1; behind < n && cols[behind] < A->nodes;) ++behind;
            int64_t before = 0;
            while (cols[before] >= A->nodes) ++before;
            add_blocks(nb, 0, before, cols, lines, x, own, xg, yg, sum, y);
            for (int i = 0; i < nb; ++i) lines[i] += from * nb;
            add_blocks(nb, 0, 1, cols + from, lines, x, own, xg, yg, sum, y);
        }
        if (A->half || A->symmetric) {
            const int64_t last = A->half ? n : behind;
            for (int i = 0; i < nb; ++i) lines[i] += nb;
            add_blocks(nb, 1, last - from - 1, cols + from + 1, lines, x, own, xg, yg, sum, y);
            for (int i = 0; i < nb; ++i) lines[i] += (last - from - 1) * nb;
            add_blocks(nb, 0, n - last, cols + last, lines, x, own, xg, yg, sum, y);
        } else {
            add_blocks(nb, 0, n, cols, lines, x, own, xg, yg, sum, y);
        }
        for (int i = 0; i < nb; ++i) y[row * nb + i] += sum[i];
    }
    free(xg);
}

INLINE int64_t padded(int64_t width) { return (width + LINE - 1) / LINE * LINE; }

/* The relaxation's rows in single precision. Returns whether a number is not finite. */
INLINE int copy_rows(const int nb, const BlockRows *A, int64_t row, const int64_t *offsets, const int32_t *at, float *out)
{
    const int64_t begin = offsets[row], n = offsets[row + 1] - begin, ld = padded(n * nb);
    float sum = 0.0f;
    for (int i = 0; i < nb; ++i) {
        const double *from = A->values + A->row_start[row * nb + i];
        float *line = out + i * ld;
        for (int64_t a = 0; a < n; ++a)
            for (int j = 0; j < nb; ++j) {
                const float v = (float)from[(int64_t)at[begin + a] * nb + j];
                line[a * nb + j] = v;
                sum += v * 0.0f;
            }
        for (int64_t k = n * nb; k < ld; ++k) line[k] = 0.0f;
    }
    return sum != 0.0f;        /* NaN where a number isn't finite */
}

/* Inverse of a block with its diagonal scaled to one; where that is singular, of its diagonal. Rows of a zero diagonal
 * are zero. */
INLINE void invert(const int nb, const double *D, float *out)
{
    double a[BLOCK_MAX][2 * BLOCK_MAX], scale[BLOCK_MAX];
    int singular = 0;
    for (int i = 0; i < nb; ++i) scale[i] = D[i * nb + i] != 0.0 ? 1.0 / sqrt(fabs(D[i * nb + i])) : 0.0;
    for (int i = 0; i < nb; ++i)
        for (int j = 0; j < nb; ++j) {
            a[i][j] = scale[i] * D[i * nb + j] * scale[j] + (i == j && scale[i] == 0.0);
            a[i][nb + j] = i == j;
        }
    for (int k = 0; k < nb && !singular; ++k) {
        int best = k;
        for (int i = k + 1; i < nb; ++i)
            if (fabs(a[i][k]) > fabs(a[best][k])) best = i;
        singular = !(fabs(a[best][k]) > 1e-10);
        if (singular) break;
        for (int j = 0; j < 2 * nb; ++j) {
            const double kept = a[k][j];
            a[k][j] = a[best][j];
            a[best][j] = kept;
        }
        const double pivot = 1.0 / a[k][k];
        for (int j = 0; j < 2 * nb; ++j) a[k][j] *= pivot;
        for (int i = 0; i < nb; ++i) {
            const double factor = a[i][k];
            if (i == k || factor == 0.0) continue;
            for (int j = 0; j < 2 * nb; ++j) a[i][j] -= factor * a[k][j];
        }
    }
    for (int i = 0; i < nb; ++i)
        for (int j = 0; j < nb; ++j) {
            const double plain = i == j && D[i * nb + i] != 0.0 ? 1.0 / D[i * nb + i] : 0.0;
            out[i * nb + j] = (float)(singular ? plain : scale[i] * a[i][nb + j] * scale[j]);
        }
}

INLINE void fill_of(const int nb, const BlockRows *A, const Relaxation *S, double lift, int64_t *bad)
{
    for (int64_t row = 0; row < A->nodes; ++row) {
        double D[BLOCK_MAX * BLOCK_MAX], *added = S->added + row * nb;
        *bad += copy_rows(nb, A, row, S->low, S->low_at, S->low_rows + S->low_start[row]);
        *bad += copy_rows(nb, A, row, S->up, S->up_at, S->up_rows + S->up_start[row]);
        diagonal_block(A, nb, row, D);
        for (int i = 0; i < nb; ++i) {
            added[i] += lift * fabs(D[i * nb + i]);
            D[i * nb + i] += added[i];
        }
        invert(nb, D, S->inverse + row * nb * nb);
        for (int i = 0; i < nb * nb; ++i) *bad += !isfinite(D[i]) || !isfinite(S->inverse[row * nb * nb + i]);
    }
}

/* Rows are asked for in time: no processor does so by itself where they are met from the last to the first. */
INLINE void ask_for(const float *rows, int64_t numbers)
{
    for (int64_t k = 0; k < numbers; k += 2 * LINE) __builtin_prefetch(rows + k);
}

/* sum -= rows times x */
INLINE void subtract_row(const int nb, int64_t n, const int32_t *cols, const float *rows, const double *x, float *g,
                         double *sum)
{
    const int64_t ld = padded(n * nb);
    single_vec s[BLOCK_MAX];
    if (n == 0) return;
    for (int64_t a = 0; a < n; ++a)
        for (int j = 0; j < nb; ++j) g[a * nb + j] = (float)x[(int64_t)cols[a] * nb + j];
    for (int64_t k = n * nb; k < ld; ++k) g[k] = 0.0f;
    for (int i = 0; i < nb; ++i) s[i] = (single_vec){0.0f};
    for (int64_t k = 0; k < ld; k += LINE) {
        const single_vec v = *(const single_vec *)(g + k);
        for (int i = 0; i < nb; ++i) s[i] += *(const single_vec *)(rows + i * ld + k) * v;
    }
    for (int i = 0; i < nb; ++i) sum[i] -= single_total(s[i]);
}

/* given -= rows, transposed, times x of this row */
INLINE void give_row(const int nb, int64_t n, const int32_t *cols, const float *rows, const double *x, float *g, float *given)
{
    const int64_t ld = padded(n * nb);
    for (int64_t k = 0; k < ld; k += LINE) {
        single_vec v = *(const single_vec *)(rows + k) * (float)x[0];
        for (int i = 1; i < nb; ++i) v += *(const single_vec *)(rows + i * ld + k) * (float)x[i];
        *(single_vec *)(g + k) = v;
    }
    for (int64_t a = 0; a < n; ++a)
        for (int j = 0; j < nb; ++j) given[(int64_t)cols[a] * nb + j] -= g[a * nb + j];
}

enum { FROM_ZERO = 0, BACKWARD = 1, FORWARD = 2, REST = 3 };

/* FROM_ZERO: x = (D + U)^-1 b, from the last row to the first; BACKWARD, FORWARD: a sweep; REST: b = what the sweep before,
 * if it began with zero, leaves of it. D has what is added. Of symmetric matrices `given` is L x after FROM_ZERO and
 * BACKWARD, the latter needs what the sweep before has left there, and FORWARD begins anew. */
INLINE void relax_of(const int nb, int64_t nodes, const Relaxation *S, int how, double *b, double *x)
{
    float *g = (float *)vectors((size_t)(S->widest * nb + LINE));
    if (S->symmetric && (how == FROM_ZERO || how == FORWARD)) memset(S->given, 0, sizeof(float) * nodes * nb);
    for (int64_t k = 0; k < nodes; ++k) {
        const int64_t row = how == FROM_ZERO || how == BACKWARD ? nodes - 1 - k : k;
        const int64_t up = S->up[row], n = S->up[row + 1] - up;
        const float *rows = S->up_rows + S->up_start[row];
        double sum[BLOCK_MAX];
        if ((how == FROM_ZERO || how == BACKWARD) && row >= AHEAD)
            ask_for(S->up_rows + S->up_start[row - AHEAD], S->up_start[row - AHEAD + 1] - S->up_start[row - AHEAD]);
        for (int i = 0; i < nb; ++i) {
            sum[i] = how == REST ? 0.0 : b[row * nb + i];
            if (how != FROM_ZERO) sum[i] += S->added[row * nb + i] * x[row * nb + i];
            if (S->symmetric && how != FROM_ZERO) sum[i] += S->given[row * nb + i];
            if (S->symmetric && how == BACKWARD) S->given[row * nb + i] = 0.0f;
            if (!g) sum[i] = NAN;
        }
        if (g && how != FROM_ZERO)
            subtract_row(nb, S->low[row + 1] - S->low[row], S->low_cols + S->low[row], S->low_rows + S->low_start[row], x, g,
                         sum);
        if (g && how != REST) subtract_row(nb, n, S->up_cols + up, rows, x, g, sum);
        for (int i = 0; i < nb; ++i) {
            double v = how == REST ? sum[i] : 0.0;
            for (int j = 0; how != REST && j < nb; ++j) v += S->inverse[(row * nb + i) * nb + j] * sum[j];
            (how == REST ? b : x)[row * nb + i] = v;
        }
        if (g && S->symmetric && how != REST) give_row(nb, n, S->up_cols + up, rows, x + row * nb, g, S->given);
    }
    free(g);
}

/* r = b - A x in double precision, in some rows only. */
INLINE void rest_of(const int nb, const BlockRows *A, const Relaxation *S, int64_t count, const int64_t *rows,
                    const double *b, const double *x, double *r)
{
    for (int64_t c = 0; c < count; ++c) {
        const int64_t row = rows[c], n = A->offsets[row + 1] - A->offsets[row];
        const int32_t *cols = A->cols + A->offsets[row];
        double D[BLOCK_MAX * BLOCK_MAX], sum[BLOCK_MAX];
        diagonal_block(A, nb, row, D);
        for (int i = 0; i < nb; ++i) {
            sum[i] = b[row * nb + i];
            for (int j = 0; j < nb; ++j) sum[i] -= D[i * nb + j] * x[row * nb + j];
        }
        for (int64_t a = A->symmetric ? S->early[row] : 0; A->symmetric && a < S->early[row + 1]; ++a)
            for (int i = 0; i < nb; ++i)
                for (int j = 0; j < nb; ++j)
                    sum[i] -= block_entry(A, nb, S->early_cols[a], S->early_at[a], j, i) * x[(int64_t)S->early_cols[a] * nb + j];
        for (int64_t k = 0; k < n; ++k) {
            if (cols[k] == row || (A->symmetric && cols[k] < row)) continue;
            for (int i = 0; i < nb; ++i)
                for (int j = 0; j < nb; ++j) sum[i] -= block_entry(A, nb, row, k, i, j) * x[(int64_t)cols[k] * nb + j];
        }
        for (int i = 0; i < nb; ++i) r[row * nb + i] = sum[i];
    }
}

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

/* Defines polarmpm_call(...), which is call_of(block, ...) with the block's size as a constant. */
#define BY_BLOCK(call, result, declared, ...)                                                                         \
    FAST static __attribute__((noinline)) result call##_2 declared { return call##_of(2, __VA_ARGS__); }             \
    FAST static __attribute__((noinline)) result call##_3 declared { return call##_of(3, __VA_ARGS__); }             \
    FAST static __attribute__((noinline)) result call##_6 declared { return call##_of(6, __VA_ARGS__); }             \
    static result call##_any declared { return call##_of(A->block, __VA_ARGS__); }

#define BLOCK_CALL(call, ...)                                                                                         \
    (A->block == 6 ? call##_6(__VA_ARGS__) : A->block == 3 ? call##_3(__VA_ARGS__) : A->block == 2 ? call##_2(__VA_ARGS__) \
     : call##_any(__VA_ARGS__))

BY_BLOCK(product, void, (const BlockRows *A, const double *x, double *y), A, x, y)
BY_BLOCK(fill, void, (const BlockRows *A, const Relaxation *S, double lift, int64_t *bad), A, S, lift, bad)
BY_BLOCK(relax, void, (const BlockRows *A, const Relaxation *S, int how, double *b, double *x), A->nodes, S, how, b, x)
BY_BLOCK(coarsen, int, (const BlockRows *A, const Transfer *P, const BlockRows *C), A, P, C)

void polarmpm_block_product(const BlockRows *A, const double *x, double *y) { BLOCK_CALL(product, A, x, y); }

/* Returns whether there are numbers that aren't finite. */
int polarmpm_relaxation(const BlockRows *A, const Relaxation *S, double lift)
{
    int64_t bad = 0;
    BLOCK_CALL(fill, A, S, lift, &bad);
    return bad != 0;
}

void polarmpm_relax(const BlockRows *A, const Relaxation *S, int32_t how, double *b, double *x)
{
    BLOCK_CALL(relax, A, S, how, b, x);
}

void polarmpm_rest(const BlockRows *A, const Relaxation *S, int64_t count, const int64_t *rows, const double *b,
                   const double *x, double *r)
{
    rest_of(A->block, A, S, count, rows, b, x, r);
}

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

/* Unknowns that are coupled with others. */
void polarmpm_coupled(const BlockRows *A, uint8_t *coupled)
{
    const int nb = A->block;
    for (int64_t row = 0; row < A->nodes; ++row)
        for (int64_t b = A->offsets[row]; b < A->offsets[row + 1]; ++b)
            for (int i = 0; !(A->symmetric && A->cols[b] < row) && i < nb; ++i)
                for (int j = A->half && A->cols[b] == row ? i + 1 : 0; j < nb; ++j) {
                    if (A->cols[b] == row && i == j) continue;
                    if (coupled[row * nb + i] && coupled[(int64_t)A->cols[b] * nb + j]) continue;  /* stays unread */
                    if (block_entry(A, nb, row, b - A->offsets[row], i, j) == 0.0) continue;
                    coupled[row * nb + i] = 1;
                    coupled[(int64_t)A->cols[b] * nb + j] = 1;
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

SIZE_OF(BlockRows);
SIZE_OF(Relaxation);
SIZE_OF(Transfer);

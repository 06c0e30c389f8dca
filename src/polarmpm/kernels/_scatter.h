/* Sums of points' blocks in a group's dense matrix, and from there into the sparse matrix; shared by
 * the sums' units. */
#ifndef POLARMPM_SCATTER_H
#define POLARMPM_SCATTER_H

#include "_points.h"

enum { MODULI_MAX = 57 };       /* length of z and of all components' second derivatives, in space with rotations */

/* B^T A B of P points of a group, added to its dense matrix K[node][i][k][nv]; the first points of a group overwrite
 * what an earlier group has left. s holds their shapes, [P][shapes_of(second)][sv] vectors; A is [P][nz][nz].
 * With several points at once an entry of K is read and written once for all of them. Of a symmetric matrix blocks
 * right of the diagonal are summed, and where both nodes are of one vector only entries with i <= k (`mirror`).
 * `filled`: A and B have more rows, second derivatives of all components, behind z; `curved`, [P][PAIRS][sv], are those
 * of the shapes. */
INLINE void add_tangent(const int dim, const int rot, const int second, const int filled, int nv, int symmetric, const int P,
                        int first, int n, const double *A, const vec *s, const vec *curved, int sv, vec *K)
{
    const int nb = dim + rot, z = unknowns_of(dim, rot, second), shapes = shapes_of(second), pairs = pairs_of(dim);
    const int nz = filled ? z + nb * pairs : z;
    for (int k = 0; k < nb; ++k)
        for (int v = 0; v < nv; ++v) {
            const int left = v * WIDTH, right = n > left + WIDTH ? left + WIDTH : n;
            const int rows = symmetric && !v && !second && !filled ? end_slot(dim, rot, k) : nz;
            vec T[MANY][MODULI_MAX];  /* column k of A B for the nodes of vector v */
            for (int q = 0; q < P; ++q) {
                const vec *sq = s + q * shapes * sv + v;
                const double *column = A + q * nz * nz + gradient_slot(dim, rot, k);
                const double *value = A + q * nz * nz + value_slot(dim, rot, k);
                const double *grown = A + q * nz * nz + second_slot(dim, rot, k), *bent = A + q * nz * nz + z + k * pairs;
                for (int r = 0; r < rows; ++r) {
                    vec sum = column[r * nz] * sq[sv];
                    for (int j = 1; j < dim; ++j) sum += column[r * nz + j] * sq[(1 + j) * sv];
                    if (has_value(dim, second, k)) sum += value[r * nz] * sq[0];
                    for (int j = 0; second == SECOND && j < pairs; ++j) sum += grown[r * nz + j] * sq[(1 + dim + j) * sv];
                    for (int j = 0; filled && j < pairs; ++j) sum += bent[r * nz + j] * curved[(q * PAIRS + j) * sv + v];
                    T[q][r] = sum;
                }
            }
            for (int i = 0; i < nb; ++i) {
                const int row = gradient_slot(dim, rot, i), grown = second_slot(dim, rot, i), bent = z + i * pairs;
                const int end = !symmetric ? n : i > k ? left : right;
                for (int a = 0; a < end; ++a) {
                    vec *out = K + ((a * nb + i) * nb + k) * nv + v;
                    vec sum = first ? (vec){0} : *out;
                    for (int q = 0; q < P; ++q) {
                        const double *g = (const double *)(s + q * shapes * sv) + a;
                        for (int j = 0; j < dim; ++j) sum += g[(1 + j) * sv * WIDTH] * T[q][row + j];
                        if (has_value(dim, second, i)) sum += g[0] * T[q][value_slot(dim, rot, i)];
                        for (int j = 0; second == SECOND && j < pairs; ++j)
                            sum += g[(1 + dim + j) * sv * WIDTH] * T[q][grown + j];
                    }
                    *out = sum;
                }
                for (int from = 0; filled && from < pairs; from += 3)  /* as many rows of T as there are registers for */
                    for (int a = 0; a < end; ++a) {
                        vec *out = K + ((a * nb + i) * nb + k) * nv + v, sum = *out;
                        for (int q = 0; q < P; ++q) {
                            const double *h = (const double *)(curved + (q * PAIRS + from) * sv) + a;
                            for (int j = 0; j < 3; ++j) sum += h[j * sv * WIDTH] * T[q][bent + from + j];
                        }
                        *out = sum;
                    }
            }
        }
}

/* P is 1, 2 or MANY. */
INLINE void add_tangents(const int dim, const int rot, const int second, const int filled, int nv, int symmetric, int P, int first,
                         int n, const double *A, const vec *s, const vec *curved, int sv, vec *K)
{
    switch (P) {
    case 1: add_tangent(dim, rot, second, filled, nv, symmetric, 1, first, n, A, s, curved, sv, K); break;
    case 2: add_tangent(dim, rot, second, filled, nv, symmetric, 2, first, n, A, s, curved, sv, K); break;
    default: add_tangent(dim, rot, second, filled, nv, symmetric, MANY, first, n, A, s, curved, sv, K);
    }
}

/* B^T r of a point into the group's nodal forces, [component][sv] vectors. */
INLINE void add_residual(const int dim, const int rot, const int second, int nv, int sv, const vec *s, const double *r,
                         vec *f)
{
    for (int v = 0; v < nv; ++v) {
        for (int i = 0; i < dim + rot; ++i) {
            const double *gradient = r + gradient_slot(dim, rot, i);
            if (has_value(dim, second, i)) f[i * sv + v] += r[value_slot(dim, rot, i)] * s[v];
            for (int j = 0; j < dim; ++j) f[i * sv + v] += gradient[j] * s[(1 + j) * sv + v];
            for (int j = 0; second == SECOND && j < pairs_of(dim); ++j)
                f[i * sv + v] += r[second_slot(dim, rot, i) + j] * s[(1 + dim + j) * sv + v];
        }
    }
}

/* Where the pair (a, q) of a group's nodes goes: the row is the node with the smaller global number. The code of
 * node q in its group doesn't depend on a. */
typedef struct {
    int64_t column;            /* block column times block size */
    int32_t row, col;          /* local nodes */
    int32_t swapped;
    int32_t code;              /* distance from the group's lowest node, in a box of (2 reach + 1)^dim nodes */
} Place;

INLINE void set_codes(const Batch *b, const Matrix *M, const int32_t *c, Place *at)
{
    const int side = 2 * M->reach + 1;
    for (int i = 0, q = 0; i < c[0]; ++i)
        for (int j = 0; j < c[1]; ++j)
            for (int k = 0; k < (b->dim == 3 ? c[2] : 1); ++k, ++q)
                at[q].code = b->dim == 3 ? (i * side + j) * side + k : i * side + j;
}

INLINE void set_place(const int dim, const Matrix *M, const int32_t *nodes, Place *at, int a, int q, int nb)
{
    const int side = 2 * M->reach + 1, codes = dim == 3 ? side * side * side : side * side;
    const int swapped = M->symmetric && M->number[nodes[a]] > M->number[nodes[q]];
    const int r = swapped ? q : a, k = swapped ? a : q, code = at[k].code - at[r].code + codes / 2;
    at[q].column = (int64_t)M->place[(int64_t)nodes[r] * codes + code] * nb;
    at[q].row = nodes[r], at[q].col = nodes[k], at[q].swapped = swapped;
}

/* A pair with prescribed unknowns: their rows and columns stay out of the matrix, all but the diagonal, and
 * what their increments add to the residual of free unknowns goes to rhs. */
static void put_constrained(const Matrix *M, int nb, Place at, int diagonal, const double *K, int64_t istep,
                            int64_t jstep, double *rhs)
{
    const int64_t row = (int64_t)at.row * nb, col = (int64_t)at.col * nb;
    for (int i = 0; i < nb; ++i) {
        double *out = M->values + M->row_start[row + i] + at.column;
        for (int j = diagonal && M->half ? i : 0; j < nb; ++j) {
            const double value = K[i * istep + j * jstep];
            const int ri = M->fixed[row + i], cj = M->fixed[col + j];
            if (!(ri | cj) || (diagonal && i == j)) out[j] += value;
            if (M->lift && ri != cj) {
                if (cj) rhs[row + i] += value * M->lift[col + j];
                else if (M->half) rhs[col + j] += value * M->lift[row + i];
            }
        }
    }
}

/* What `add_tangent` has left out of a symmetric matrix: entries with i > j of nodes of the same vector. */
INLINE void mirror(const int nb, int n, int64_t cols, double *K)
{
    for (int q = 1; q < n; ++q)
        for (int a = q - q % WIDTH; a < q; ++a)
            for (int i = 1; i < nb; ++i)
                for (int j = 0; j < i; ++j)
                    K[((a * nb + i) * nb + j) * cols + q] = K[((q * nb + j) * nb + i) * cols + a];
}

/* The dense matrix of n nodes, of which `at` has the codes, into the sparse rows; entry (i, j) of the pair (a, q) stands
 * at K[((a nb + i) nb + j) cols + q]. */
INLINE void flush_nodes(const int dim, const Matrix *M, const int32_t *nodes, const int nb, int n, int nv, double *K,
                        Place *at, double *rhs)
{
    const int64_t cols = (int64_t)nv * WIDTH;
    int constrained = 0;
    for (int a = 0; a < n; ++a)
        for (int i = 0; i < nb; ++i) constrained |= M->fixed[(int64_t)nodes[a] * nb + i];
    for (int a = 0; a < n; ++a) {
        const double *Ka = K + (int64_t)a * nb * nb * cols;
        const int begin = M->half ? a : 0;
        int swapped = 0;
        for (int q = begin; q < n; ++q) {
            set_place(dim, M, nodes, at, a, q, nb);
            swapped |= at[q].swapped;
        }
        if (constrained || swapped) {
            for (int q = begin; q < n; ++q)
                put_constrained(M, nb, at[q], a == q, Ka + q, at[q].swapped ? cols : nb * cols,
                                at[q].swapped ? nb * cols : cols, rhs);
            continue;
        }
        for (int i = 0; i < nb; ++i) {
            double *out = M->values + M->row_start[(int64_t)nodes[a] * nb + i];
            for (int j = M->half ? i : 0; j < nb; ++j) out[at[a].column + j] += Ka[(i * nb + j) * cols + a];
            for (int q = begin; q < n; ++q) {
                if (q == a) continue;
                double *block = out + at[q].column;
                for (int j = 0; j < nb; ++j) block[j] += Ka[(i * nb + j) * cols + q];
            }
        }
    }
}

/* The same of a group. */
INLINE void flush_matrix(const Batch *b, const Matrix *M, int64_t g, const int nb, int n, int nv, double *K, Place *at,
                         double *rhs)
{
    if (M->half) mirror(nb, n, (int64_t)nv * WIDTH, K);
    set_codes(b, M, b->count + g * b->dim, at);
    flush_nodes(b->dim, M, b->nodes + b->node_offsets[g], nb, n, nv, K, at, rhs);
}

/* What the dense matrix of a group's n nodes makes of prescribed increments, at free unknowns; the sparse rows stay. */
INLINE void add_lifted(const Batch *b, const Matrix *M, int64_t g, const int nb, int n, int nv, double *K, double *rhs)
{
    const int64_t cols = (int64_t)nv * WIDTH;
    const int32_t *nodes = b->nodes + b->node_offsets[g];
    if (M->half) mirror(nb, n, cols, K);
    for (int a = 0; a < n; ++a)
        for (int i = 0; i < nb; ++i) {
            const int64_t row = (int64_t)nodes[a] * nb + i;
            for (int j = 0; j < nb; ++j)
                for (int q = M->half ? a : 0; q < n; ++q) {
                    const int64_t col = (int64_t)nodes[q] * nb + j;
                    const double value = K[((a * nb + i) * nb + j) * cols + q];
                    if ((M->half && q == a && j < i) || M->fixed[row] == M->fixed[col]) continue;
                    if (M->fixed[col]) rhs[row] += value * M->lift[col];
                    else if (M->half) rhs[col] += value * M->lift[row];
                }
        }
}

#endif

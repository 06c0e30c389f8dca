/* Sums of points' blocks in a group's dense matrix, and from there into the sparse matrix; shared by
 * the sums' units. */
#ifndef POLARMPM_SCATTER_H
#define POLARMPM_SCATTER_H

#include "_transpose.h"

enum {
    MODULI_MAX = 57,           /* length of z and of all components' second derivatives, in space with rotations */
    PACKED = 16                /* rows of shapes, in space with second gradients, and second derivatives once more */
};

/* Moduli of points: entry (r, c) of the q-th one, of n rows and columns, stands at A[q step + at[r n + c]], to be multiplied
 * by scale[q] (NULL: one). */
typedef struct {
    const double *A, *scale;
    const int32_t *at;
    int64_t step;
} Moduli;

INLINE Moduli later_moduli(Moduli m, int q)
{
    return (Moduli){m.A + q * m.step, m.scale ? m.scale + q : NULL, m.at, m.step};
}

/* Rows of B that belong to a component, each a row of the shapes; of those that aren't there, none is stored. */
INLINE int rows_of_shapes(const int dim, const int second, const int filled)
{
    return 1 + dim + ((second == SECOND) + filled) * pairs_of(dim);
}

/* Columns of A B that are computed at once: with the functions of WIDTH nodes as many sums as there are registers for. */
INLINE int columns_of(const int nb) { return nb % 3 ? 2 : 3; }

/* Shapes of P points with all that belongs to the nodes of a vector side by side, [vector][MANY][row], once as they are
 * and once times what moduli are to be multiplied by. */
INLINE void pack_shapes(const int dim, const int second, const int filled, int nv, int P, const double *scale, const vec *s,
                        const vec *curved, int sv, vec *rows, vec *scaled)
{
    const int all = rows_of_shapes(dim, second, filled), own = rows_of_shapes(dim, second, 0), shapes = shapes_of(second);
    for (int v = 0; v < nv; ++v)
        for (int q = 0; q < P; ++q) {
            const double by = scale ? scale[q] : 1.0;
            vec *to = rows + (v * MANY + q) * all, *times = scaled + (v * MANY + q) * all;
            for (int r = 0; r < own; ++r) to[r] = s[(q * shapes + r) * sv + v];
            for (int r = own; r < all; ++r) to[r] = curved[(q * PAIRS + r - own) * sv + v];
            for (int r = 0; r < all; ++r) times[r] = by * to[r];
        }
}

/* Rows `begin` to `end` of a column of A B, for the nodes of the vectors from `from` to `some`: T[row][step] and [vector].
 * `at` has the column's places in the moduli of its gradient, its value, its second derivatives, twice. */
INLINE void find_column(const int dim, const int second, const int filled, const int valued, const int from, const int some,
                        int begin, int end, int n, const double *A, const int32_t *const *at, const vec *s, const int step,
                        vec *T)
{
    const int pairs = pairs_of(dim), next = MANY * rows_of_shapes(dim, second, filled), grown = 1 + dim;
    const int bent = grown + (second == SECOND) * pairs;
    for (int r = begin; r < end; ++r)
        for (int v = from; v < some; ++v) {
            const vec *sv = s + v * next;
            vec sum = A[at[0][r * n]] * sv[1];
            for (int j = 1; j < dim; ++j) sum += A[at[0][r * n + j]] * sv[1 + j];
            if (valued) sum += A[at[1][r * n]] * sv[0];
            for (int j = 0; second == SECOND && j < pairs; ++j) sum += A[at[2][r * n + j]] * sv[grown + j];
            for (int j = 0; filled && j < pairs; ++j) sum += A[at[3][r * n + j]] * sv[bent + j];
            T[r * step + v] = sum;
        }
}

/* A B of P points, for `columns_of` components from k on and the nodes of `some` vectors: T[q][row][component][vector]. The
 * first vector needs rows before `end` only. */
INLINE void find_columns(const int dim, const int rot, const int second, const int filled, const int some, int P, int k,
                         int end, const int n, Moduli m, const vec *s, vec *T)
{
    const int z = unknowns_of(dim, rot, second), columns = columns_of(dim + rot), step = columns * some;
    for (int q = 0; q < P; ++q, s += rows_of_shapes(dim, second, filled), T += n * step)
        for (int c = 0; c < columns; ++c) {
            const double *A = m.A + q * m.step;
            const int32_t *const at[4] = {m.at + gradient_slot(dim, rot, k + c), m.at + value_slot(dim, rot, k + c),
                                          m.at + second_slot(dim, rot, k + c), m.at + z + (k + c) * pairs_of(dim)};
            vec *to = T + c * some;
            if (has_value(dim, second, k + c)) {
                find_column(dim, second, filled, 1, 0, some, 0, end, n, A, at, s, step, to);
                if (some > 1) find_column(dim, second, filled, 1, 1, some, end, n, n, A, at, s, step, to);
            } else {
                find_column(dim, second, filled, 0, 0, some, 0, end, n, A, at, s, step, to);
                if (some > 1) find_column(dim, second, filled, 0, 1, some, end, n, n, A, at, s, step, to);
            }
        }
}

/* B^T (A B) for component i of `nodes` nodes, and the components of T: adds to K[node][i][k][nv]. */
INLINE void add_block(const int dim, const int rot, const int second, const int filled, const int some, const int nodes, int P,
                      int i, int first, const int n, const vec *T, const double *s, int nv, vec *K)
{
    const int nb = dim + rot, pairs = pairs_of(dim), columns = columns_of(nb), step = columns * some, grown = 1 + dim;
    const int valued = has_value(dim, second, i), bent = grown + (second == SECOND) * pairs;
    vec sum[WIDTH][3];
    for (int a = 0; a < nodes; ++a)
        for (int c = 0; c < columns; ++c) sum[a][c] = first ? (vec){0} : K[(a * nb * nb + c) * nv];
#define ADD(shape, row)                                                                                               \
    for (int a = 0; a < nodes; ++a)                                                                                   \
        for (int c = 0; c < columns; ++c) sum[a][c] += s[(shape) * WIDTH + a] * T[(row) * step + c * some];
    for (int q = 0; q < P; ++q, T += n * step, s += rows_of_shapes(dim, second, filled) * WIDTH) {
        for (int j = 0; j < dim; ++j) ADD(1 + j, gradient_slot(dim, rot, i) + j)
        if (valued) ADD(0, value_slot(dim, rot, i))
        for (int j = 0; second == SECOND && j < pairs; ++j) ADD(grown + j, second_slot(dim, rot, i) + j)
        for (int j = 0; filled && j < pairs; ++j) ADD(bent + j, unknowns_of(dim, rot, second) + i * pairs + j)
    }
#undef ADD
    for (int a = 0; a < nodes; ++a)
        for (int c = 0; c < columns; ++c) K[(a * nb * nb + c) * nv] = sum[a][c];
}

/* The part of `add_tangents` for the nodes of `some` vectors from the vector v on. */
INLINE void add_columns(const int dim, const int rot, const int second, const int filled, const int some, int v, int nv,
                        int symmetric, int P, int first, int n, Moduli m, const vec *rows, const vec *scaled, vec *K)
{
    const int nb = dim + rot, columns = columns_of(nb), next = MANY * rows_of_shapes(dim, second, filled);
    const int nz = unknowns_of(dim, rot, second) + filled * nb * pairs_of(dim);
    vec T[MANY * MODULI_MAX * 6];
    for (int k = 0; k < nb; k += columns) {
        const int end = symmetric && !v && !second && !filled ? end_slot(dim, rot, k + columns - 1) : nz;
        find_columns(dim, rot, second, filled, some, P, k, end, nz, m, scaled + v * next, T);
        for (int w = 0; w < some; ++w)
            for (int i = 0; i < nb; ++i) {
                const int last = symmetric ? (v + w + (i < k + columns)) * WIDTH : n, all = last < n ? last : n;
                vec *to = K + (i * nb + k) * nv + v + w;
                for (int a = 0; a < all; a += WIDTH) {
                    const double *s = (const double *)(rows + a / WIDTH * next);
                    if (a + WIDTH <= all)
                        add_block(dim, rot, second, filled, some, WIDTH, P, i, first, nz, T + w, s, nv, to + a * nb * nb * nv);
                    else for (int b = a; b < all; ++b)
                        add_block(dim, rot, second, filled, some, 1, P, i, first, nz, T + w, s + b - a, nv, to + b * nb * nb * nv);
                }
            }
    }
}

/* B^T A B of P points in the plane, of few nodes with few unknowns: a column of K after the other, as there is little to
 * keep in registers. A is [P][nz][nz]. */
INLINE void add_few(const int dim, const int rot, const int second, int nv, int symmetric, const int P,
                        int first, int n, const double *A, const vec *s, int sv, vec *K)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), shapes = shapes_of(second), pairs = pairs_of(dim);
    for (int k = 0; k < nb; ++k)
        for (int v = 0; v < nv; ++v) {
            const int left = v * WIDTH, right = n > left + WIDTH ? left + WIDTH : n;
            const int rows = symmetric && !v && !second ? end_slot(dim, rot, k) : nz;
            vec T[MANY][MODULI_MAX];  /* column k of A B for the nodes of vector v */
            for (int q = 0; q < P; ++q) {
                const vec *sq = s + q * shapes * sv + v;
                const double *column = A + q * nz * nz + gradient_slot(dim, rot, k);
                const double *value = A + q * nz * nz + value_slot(dim, rot, k);
                const double *grown = A + q * nz * nz + second_slot(dim, rot, k);
                for (int r = 0; r < rows; ++r) {
                    vec sum = column[r * nz] * sq[sv];
                    for (int j = 1; j < dim; ++j) sum += column[r * nz + j] * sq[(1 + j) * sv];
                    if (has_value(dim, second, k)) sum += value[r * nz] * sq[0];
                    for (int j = 0; second == SECOND && j < pairs; ++j) sum += grown[r * nz + j] * sq[(1 + dim + j) * sv];
                    T[q][r] = sum;
                }
            }
            for (int i = 0; i < nb; ++i) {
                const int row = gradient_slot(dim, rot, i), grown = second_slot(dim, rot, i);
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
            }
        }
}

/* B^T A B of points of a group added to its dense matrix K[node][i][k][nv]; the first points of a group overwrite what an
 * earlier group has left. s holds their shapes, [point][shapes_of(second)][sv] vectors. An entry of K is read and
 * written once for MANY points. Of a symmetric matrix blocks right of the diagonal are summed, and where both nodes are of
 * one vector those entries that `mirror` needs, at least.
 * `filled`: A and B have more rows, second derivatives of all components, behind z; `curved`, [point][PAIRS][sv], are those
 * of the shapes. `packed`: room for 2 MANY PACKED nv vectors. */
INLINE void add_tangents(const int dim, const int rot, const int second, const int filled, int nv, int symmetric, int points,
                         int first, int n, Moduli m, const vec *s, const vec *curved, int sv, vec *packed, vec *K)
{
    vec *scaled = packed + MANY * PACKED * nv;
    if (dim == 2 && !filled && m.step > 1) {
        const int shapes = shapes_of(second) * sv;
        for (int p = 0, P; p < points; p += P, first = 0) {
            const double *A = m.A + p * m.step;
            P = points - p >= MANY ? MANY : points - p >= 2 ? 2 : 1;
            if (P == MANY) add_few(dim, rot, second, nv, symmetric, MANY, first, n, A, s + p * shapes, sv, K);
            else if (P == 2) add_few(dim, rot, second, nv, symmetric, 2, first, n, A, s + p * shapes, sv, K);
            else add_few(dim, rot, second, nv, symmetric, 1, first, n, A, s + p * shapes, sv, K);
        }
        return;
    }
    for (int p = 0; p < points; p += MANY, first = 0) {
        const int P = points - p < MANY ? points - p : MANY;
        const Moduli here = later_moduli(m, p);
        pack_shapes(dim, second, filled, nv, P, here.scale, s + p * shapes_of(second) * sv, filled ? curved + p * PAIRS * sv : NULL,
                    sv, packed, scaled);
        int v = 0;
        for (; v + 2 <= nv; v += 2)
            add_columns(dim, rot, second, filled, 2, v, nv, symmetric, P, first, n, here, packed, scaled, K);
        if (v < nv) add_columns(dim, rot, second, filled, 1, v, nv, symmetric, P, first, n, here, packed, scaled, K);
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

/* A row of the dense matrix, of a component of node a, into its sparse row, for the nodes from `begin` to n: with six
 * components a vector of nodes at once. */
INLINE void add_row(const int nb, int begin, int n, const double *K, int64_t cols, const Place *at, double *out)
{
    typedef double pair_t __attribute__((vector_size(16), aligned(8)));
    typedef int64_t places __attribute__((vector_size(8 * WIDTH)));
    for (int from = begin - begin % WIDTH; nb == 6 && from < n; from += WIDTH) {
        const vec *k = (const vec *)(K + from);
        const int64_t step = cols / WIDTH;
        const vec left = k[4 * step], right = k[5 * step];
        vec first[WIDTH], last[2];
        TRANSPOSE(k[0], k[step], k[2 * step], k[3 * step], first)
        last[0] = __builtin_shuffle(left, right, (places){0, 4, 1, 5});
        last[1] = __builtin_shuffle(left, right, (places){2, 6, 3, 7});
        for (int l = 0; l < WIDTH; ++l) {
            if (from + l < begin || from + l >= n) continue;
            double *block = out + at[from + l].column;
            *(row_t *)block += first[l];
            *(pair_t *)(block + WIDTH) += *(const pair_t *)((const double *)last + 2 * l);
        }
    }
    for (int q = begin; nb != 6 && q < n; ++q) {
        double *block = out + at[q].column;
        for (int j = 0; j < nb; ++j) block[j] += K[j * cols + q];
    }
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
            if (!M->half) add_row(nb, 0, a, Ka + i * nb * cols, cols, at, out);
            add_row(nb, a + 1, n, Ka + i * nb * cols, cols, at, out);
        }
    }
}

/* Asks for what `flush_matrix` of a group will add to, while there is other work to do. */
INLINE void prefetch_rows(const int dim, const Batch *b, const Matrix *M, int64_t g, const int nb, int n, Place *at)
{
    const int32_t *nodes = b->nodes + b->node_offsets[g];
    set_codes(b, M, b->count + g * b->dim, at);
    for (int a = 0; a < n; ++a) {
        const int64_t *row = M->row_start + (int64_t)nodes[a] * nb;
        for (int q = M->half ? a : 0; q < n; ++q) {
            set_place(dim, M, nodes, at, a, q, nb);
            for (int i = 0; i < nb; ++i) __builtin_prefetch(M->values + row[i] + at[q].column, 1, 2);
        }
    }
}

/* The dense matrix of a group into the sparse rows. */
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

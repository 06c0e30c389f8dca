/* Sums over material points: nodal values -> points, and points -> nodal vectors and sparse matrix.
 *
 * The material is a compiled kernel (see codegen.py) that treats LANES points in one call. Points are sorted
 * into groups that share one set of nodes, a box of `count` lattice nodes in each direction. A group adds up
 * its points in a small dense matrix and goes into the sparse matrix once. Within the dense matrix the
 * columns are ordered [component][node], so that the innermost loop runs over nodes with constant length.
 *
 * The file uses no Python header; native.py loads it with ctypes and mirrors the structures.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum {
    INTERFACE = 3,             /* raised with every change of a structure or signature, here and in native.py */
    LANES = 8,                 /* points in a kernel call */
    WIDTH = 4                  /* nodes in a vector */
};

typedef double vec __attribute__((vector_size(8 * WIDTH), aligned(8 * WIDTH)));
typedef void (*kernel_t)(const double *in, double *out);

#define INLINE static inline __attribute__((always_inline))
#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define FAST __attribute__((target_clones("fma", "default")))
#else
#define FAST
#endif

typedef struct {
    int32_t dim, rot;          /* space dimension, rotation components of a node */
    int32_t slots;             /* stored weights in each direction */
    int32_t nstate, nparam;
    int64_t npoints, ngroups;
    const double *weights;     /* [point][dim][value, gradient][slots] */
    const int32_t *count;      /* [group][dim] nodes in each direction */
    const double *state;       /* [point][nstate]; starts with the dim x dim frame */
    const double *param;       /* [nparam], the same for all points of a batch */
    const double *volume;      /* [point] reference volume */
    const int64_t *first;      /* [group + 1] first point */
    const int64_t *node_first; /* [group + 1] first entry of nodes */
    const int32_t *nodes;      /* local node numbers */
} Batch;

typedef struct {
    int32_t symmetric;         /* upper triangle only */
    int32_t reach;             /* largest lattice distance of coupled nodes */
    const int32_t *place;      /* [node][(2 reach + 1)^dim] block column in the node's row, -1: none */
    const int64_t *row_start;  /* [node * block + i] address of block column 0 */
    const int64_t *number;     /* [node] global number; the row of a pair has the smaller one */
    const uint8_t *fixed;      /* [node * block + i] */
    const double *lift;        /* prescribed increments of this iteration, or NULL */
    double *values;
} Matrix;

typedef struct {
    kernel_t kernel;           /* (z, state, param) -> residual [, upper triangle of the tangent] */
    kernel_t couple;           /* (w, m) -> residual, tangent; NULL without couples */
    const int32_t *couple_of;  /* [point] row of `couples`, -1: none */
    const double *couples;     /* [row][3] */
    const int32_t *block_of;   /* [point] row of `blocks`, -1: evaluate the kernel; NULL: kernel for all points */
    const double *blocks;      /* [row][nz (+ nz nz with tangent)] per volume, from the return mapping */
} Law;

INLINE int block_of(const Batch *b) { return b->dim + b->rot; }
INLINE int unknowns_of(int dim, int rot) { return dim * dim + rot * (1 + dim); }

static int nodes_of(const Batch *b, int64_t group)
{
    int n = 1;
    for (int d = 0; d < b->dim; ++d) n *= b->count[group * b->dim + d];
    return n;
}

static int largest_group(const Batch *b)
{
    int most = 1;
    for (int64_t g = 0; g < b->ngroups; ++g) {
        int n = nodes_of(b, g);
        if (n > most) most = n;
    }
    return most;
}

/* Weighting functions of a point and their gradients, [value, d/dx_1, ...][stride]; in the frame if given. */
INLINE void shape(const Batch *b, int64_t p, const int32_t *count, const double *frame, int stride, double *s)
{
    const int dim = b->dim, m = b->slots;
    const double *w = b->weights + p * dim * 2 * m;
    const int n2 = dim == 3 ? count[2] : 1;
    int a = 0;
    for (int i = 0; i < count[0]; ++i)
        for (int j = 0; j < count[1]; ++j) {
            const double v = w[i] * w[2 * m + j];
            const double dx = w[m + i] * w[2 * m + j], dy = w[i] * w[3 * m + j];
            for (int k = 0; k < n2; ++k, ++a) {
                double g[3];
                if (dim == 3) {
                    const double wz = w[4 * m + k];
                    s[a] = v * wz;
                    g[0] = dx * wz;
                    g[1] = dy * wz;
                    g[2] = v * w[5 * m + k];
                } else {
                    s[a] = v;
                    g[0] = dx;
                    g[1] = dy;
                }
                for (int c = 0; c < dim; ++c) {
                    double sum = frame ? 0.0 : g[c];
                    if (frame)
                        for (int d = 0; d < dim; ++d) sum += g[d] * frame[d * dim + c];
                    s[(1 + c) * stride + a] = sum;
                }
            }
        }
    for (int c = 0; c <= dim; ++c)
        for (int q = a; q < stride; ++q) s[c * stride + q] = 0.0;
}

/* z = (du/dx, w, dw/dx) of a point from nodal values x [node][block], written with a stride. */
INLINE void gather_point(int dim, int rot, int n, int stride, const double *s, const int32_t *nodes,
                         const double *x, double *z, int zstride)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot);
    double sum[21] = {0};
    for (int a = 0; a < n; ++a) {
        const double *xa = x + (int64_t)nodes[a] * nb;
        for (int i = 0; i < dim; ++i)
            for (int j = 0; j < dim; ++j) sum[dim * i + j] += xa[i] * s[(1 + j) * stride + a];
        for (int i = 0; i < rot; ++i) {
            sum[dim * dim + i] += xa[dim + i] * s[a];
            for (int j = 0; j < dim; ++j)
                sum[dim * dim + rot + dim * i + j] += xa[dim + i] * s[(1 + j) * stride + a];
        }
    }
    for (int r = 0; r < nz; ++r) z[r * zstride] = sum[r];
}

int polarmpm_interface(void) { return INTERFACE; }

/* Increments at the points: z [point][nz], in the grid's frame or that of the state, and, unless NULL,
 * interpolated values [point][block]. */
void polarmpm_gather(const Batch *b, const double *x, int32_t framed, double *z, double *value)
{
    const int nb = block_of(b), nz = unknowns_of(b->dim, b->rot);
    const int stride = largest_group(b);
    double *s = malloc(sizeof(double) * 4 * stride);
    for (int64_t g = 0; g < b->ngroups; ++g) {
        const int n = nodes_of(b, g);
        const int32_t *nodes = b->nodes + b->node_first[g];
        for (int64_t p = b->first[g]; p < b->first[g + 1]; ++p) {
            shape(b, p, b->count + g * b->dim, framed ? b->state + p * b->nstate : NULL, stride, s);
            gather_point(b->dim, b->rot, n, stride, s, nodes, x, z + p * nz, 1);
            for (int i = 0; value && i < nb; ++i) {
                double sum = 0.0;
                for (int a = 0; a < n; ++a) sum += s[a] * x[(int64_t)nodes[a] * nb + i];
                value[p * nb + i] = sum;
            }
        }
    }
    free(s);
}

/* Nodal sums of point values: out[node][c] += S f[point][c]. */
void polarmpm_spread(const Batch *b, const double *f, int32_t nc, double *out)
{
    const int stride = largest_group(b);
    double *s = malloc(sizeof(double) * 4 * stride);
    for (int64_t g = 0; g < b->ngroups; ++g) {
        const int n = nodes_of(b, g);
        const int32_t *nodes = b->nodes + b->node_first[g];
        for (int64_t p = b->first[g]; p < b->first[g + 1]; ++p) {
            shape(b, p, b->count + g * b->dim, NULL, stride, s);
            for (int a = 0; a < n; ++a)
                for (int c = 0; c < nc; ++c) out[(int64_t)nodes[a] * nc + c] += s[a] * f[p * nc + c];
        }
    }
    free(s);
}

/* Marks which lattice neighbours share a group with each node: mark[node][code of the distance]. */
void polarmpm_couple_nodes(const Batch *b, int32_t reach, uint8_t *mark)
{
    const int side = 2 * reach + 1, codes = b->dim == 3 ? side * side * side : side * side;
    for (int64_t g = 0; g < b->ngroups; ++g) {
        const int32_t *c = b->count + g * b->dim, *nodes = b->nodes + b->node_first[g];
        const int n = nodes_of(b, g), n2 = b->dim == 3 ? c[2] : 1;
        for (int a = 0; a < n; ++a)
            for (int q = 0; q < n; ++q) {
                int code = (q / (c[1] * n2) - a / (c[1] * n2) + reach) * side
                           + (q / n2 % c[1] - a / n2 % c[1] + reach);
                if (b->dim == 3) code = code * side + (q % n2 - a % n2 + reach);
                mark[(int64_t)nodes[a] * codes + code] = 1;
            }
    }
}

/* B^T A B of a point into the dense matrix of its group; s holds values and gradients [1 + dim][nv].
 * The first point of a group overwrites what an earlier group has left. */
INLINE void add_tangent(const int dim, const int rot, const int nv, const int symmetric, const int first, int n,
                        const double *A, const vec *s, vec *T, vec *K)
{
    const int nb = dim + rot, d2 = dim * dim, nz = d2 + rot * (1 + dim);
    const double *scalar = (const double *)s;
    for (int r = 0; r < nz; ++r) {
        const double *row = A + r * nz;
        for (int k = 0; k < dim; ++k)
            for (int v = 0; v < nv; ++v) {
                vec sum = row[dim * k] * s[nv + v];
                for (int j = 1; j < dim; ++j) sum += row[dim * k + j] * s[(1 + j) * nv + v];
                T[(r * nb + k) * nv + v] = sum;
            }
        for (int k = 0; k < rot; ++k)
            for (int v = 0; v < nv; ++v) {
                vec sum = row[d2 + k] * s[v];
                for (int j = 0; j < dim; ++j) sum += row[d2 + rot + dim * k + j] * s[(1 + j) * nv + v];
                T[(r * nb + dim + k) * nv + v] = sum;
            }
    }
    for (int a = 0; a < n; ++a) {
        const int begin = symmetric ? a / WIDTH : 0;
        double g[3];
        for (int j = 0; j < dim; ++j) g[j] = scalar[(1 + j) * nv * WIDTH + a];
        const double value = scalar[a];
        for (int i = 0; i < nb; ++i)
            for (int k = 0; k < nb; ++k) {
                vec *out = K + ((a * nb + i) * nb + k) * nv;
                for (int v = begin; v < nv; ++v) {
                    vec sum = first ? (vec){0} : out[v];
                    if (i < dim) {
                        for (int j = 0; j < dim; ++j) sum += g[j] * T[((dim * i + j) * nb + k) * nv + v];
                    } else {
                        const int q = i - dim;
                        sum += value * T[((d2 + q) * nb + k) * nv + v];
                        for (int j = 0; j < dim; ++j)
                            sum += g[j] * T[((d2 + rot + dim * q + j) * nb + k) * nv + v];
                    }
                    out[v] = sum;
                }
            }
    }
}

#define CASE_FIRST(D, R, NV, S)                                            \
    if (first) add_tangent(D, R, NV, S, 1, n, A, s, T, K);                 \
    else add_tangent(D, R, NV, S, 0, n, A, s, T, K)
#define CASE_NV(D, R, S)                                                   \
    switch (nv) {                                                          \
    case 1: CASE_FIRST(D, R, 1, S); break;                                 \
    case 2: CASE_FIRST(D, R, 2, S); break;                                 \
    case 3: CASE_FIRST(D, R, 3, S); break;                                 \
    case 5: CASE_FIRST(D, R, 5, S); break;                                 \
    case 7: CASE_FIRST(D, R, 7, S); break;                                 \
    default: CASE_FIRST(D, R, nv, S);                                      \
    }

INLINE void add_tangent_any(int dim, int rot, int nv, int symmetric, int first, int n, const double *A,
                            const vec *s, vec *T, vec *K)
{
    if (dim == 3 && rot == 3) {
        if (symmetric) { CASE_NV(3, 3, 1) } else { CASE_NV(3, 3, 0) }
    } else if (dim == 3) {
        if (symmetric) { CASE_NV(3, 0, 1) } else { CASE_NV(3, 0, 0) }
    } else if (rot == 1) {
        if (symmetric) { CASE_NV(2, 1, 1) } else { CASE_NV(2, 1, 0) }
    } else {
        if (symmetric) { CASE_NV(2, 0, 1) } else { CASE_NV(2, 0, 0) }
    }
}

/* B^T r of a point into the group's nodal forces [node][block]. */
INLINE void add_residual(int dim, int rot, int n, int stride, const double *s, const double *r, double *f)
{
    const int nb = dim + rot, d2 = dim * dim;
    for (int a = 0; a < n; ++a) {
        for (int i = 0; i < dim; ++i)
            for (int j = 0; j < dim; ++j) f[a * nb + i] += r[dim * i + j] * s[(1 + j) * stride + a];
        for (int i = 0; i < rot; ++i) {
            f[a * nb + dim + i] += r[d2 + i] * s[a];
            for (int j = 0; j < dim; ++j)
                f[a * nb + dim + i] += r[d2 + rot + dim * i + j] * s[(1 + j) * stride + a];
        }
    }
}

/* Where the pair (a, q) of a group's nodes goes: the row is the node with the smaller global number. */
typedef struct {
    int64_t column;            /* block column times block size */
    int32_t row, col;          /* local nodes */
    int32_t swapped;
} Place;

INLINE Place place_of(const Batch *b, const Matrix *M, const int32_t *nodes, const int32_t *c, int a, int q, int nb)
{
    const int side = 2 * M->reach + 1, codes = b->dim == 3 ? side * side * side : side * side;
    const int n2 = b->dim == 3 ? c[2] : 1, n12 = c[1] * n2;
    const int swapped = M->symmetric && M->number[nodes[a]] > M->number[nodes[q]];
    const int r = swapped ? q : a, k = swapped ? a : q;
    int code = (k / n12 - r / n12 + M->reach) * side + k / n2 % c[1] - r / n2 % c[1] + M->reach;
    if (b->dim == 3) code = code * side + k % n2 - r % n2 + M->reach;
    return (Place){(int64_t)M->place[(int64_t)nodes[r] * codes + code] * nb, nodes[r], nodes[k], swapped};
}

/* A pair with prescribed unknowns: their rows and columns stay out of the matrix, all but the diagonal, and
 * what their increments add to the residual of free unknowns goes to rhs. */
static void put_constrained(const Matrix *M, int nb, Place at, int diagonal, const double *K, int64_t istep,
                            int64_t jstep, double *rhs)
{
    const int64_t row = (int64_t)at.row * nb, col = (int64_t)at.col * nb;
    for (int i = 0; i < nb; ++i) {
        double *out = M->values + M->row_start[row + i] + at.column;
        for (int j = diagonal && M->symmetric ? i : 0; j < nb; ++j) {
            const double value = K[i * istep + j * jstep];
            const int ri = M->fixed[row + i], cj = M->fixed[col + j];
            if (!(ri | cj) || (diagonal && i == j)) out[j] += value;
            if (M->lift && ri != cj) {
                if (cj) rhs[row + i] += value * M->lift[col + j];
                else if (M->symmetric) rhs[col + j] += value * M->lift[row + i];
            }
        }
    }
}

/* The group's dense matrix into the sparse rows; entry (i, j) of the pair (a, q) stands at
 * K[((a nb + i) nb + j) cols + q]. */
INLINE void flush_matrix(const Batch *b, const Matrix *M, int64_t g, const int nb, int n, int nv, const double *K,
                         Place *at, double *rhs)
{
    const int32_t *c = b->count + g * b->dim, *nodes = b->nodes + b->node_first[g];
    const int64_t cols = (int64_t)nv * WIDTH;
    int constrained = 0;
    for (int a = 0; a < n; ++a)
        for (int i = 0; i < nb; ++i) constrained |= M->fixed[(int64_t)nodes[a] * nb + i];
    for (int a = 0; a < n; ++a) {
        const double *Ka = K + (int64_t)a * nb * nb * cols;
        const int begin = M->symmetric ? a : 0;
        int swapped = 0;
        for (int q = begin; q < n; ++q) {
            at[q] = place_of(b, M, nodes, c, a, q, nb);
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
            for (int j = M->symmetric ? i : 0; j < nb; ++j) out[at[a].column + j] += Ka[(i * nb + j) * cols + a];
            for (int q = begin; q < n; ++q) {
                if (q == a) continue;
                double *block = out + at[q].column;
                for (int j = 0; j < nb; ++j) block[j] += Ka[(i * nb + j) * cols + q];
            }
        }
    }
}

INLINE void flush_any(const Batch *b, const Matrix *M, int64_t g, int n, int nv, const double *K, Place *at,
                      double *rhs)
{
    switch (block_of(b)) {
    case 6: flush_matrix(b, M, g, 6, n, nv, K, at, rhs); break;
    case 3: flush_matrix(b, M, g, 3, n, nv, K, at, rhs); break;
    default: flush_matrix(b, M, g, block_of(b), n, nv, K, at, rhs);
    }
}

typedef struct {
    double *in, *out, *cin, *cout, *shapes, *A, *f;
    vec *s, *T, *K;
    Place *at;
} Work;

static void *vectors(size_t n)
{
    const size_t line = 8 * LANES;  /* what the kernels' vectors need, and no less than a vec */
    void *p = aligned_alloc(line, (n * sizeof(double) / line + 1) * line);
    if (p) memset(p, 0, n * sizeof(double));
    return p;
}

/* Evaluate LANES points from `start` on: shapes of each, then the kernels. Returns how many are real. */
INLINE int evaluate(const Batch *b, const Law *law, const double *x, int64_t start, int64_t *group, int stride,
                    int64_t *group_of, const Work *w)
{
    const int nz = unknowns_of(b->dim, b->rot), ns = b->nstate, np = b->nparam;
    int lanes = (int)(b->npoints - start < LANES ? b->npoints - start : LANES), coupled = 0, open = 0;
    for (int l = 0; l < LANES; ++l) {
        const int64_t p = start + (l < lanes ? l : lanes - 1);
        open |= !law->block_of || law->block_of[p] < 0;
        if (l < lanes) {
            while (p >= b->first[*group + 1]) ++*group;
            group_of[l] = *group;
            shape(b, p, b->count + *group * b->dim, b->state + p * ns, stride, w->shapes + l * 4 * stride);
        }
        gather_point(b->dim, b->rot, nodes_of(b, *group), stride, w->shapes + (l < lanes ? l : lanes - 1) * 4 * stride,
                     b->nodes + b->node_first[*group], x, w->in + l, LANES);
        for (int k = 0; k < ns; ++k) w->in[(nz + k) * LANES + l] = b->state[p * ns + k];
        for (int k = 0; k < np; ++k) w->in[(nz + ns + k) * LANES + l] = b->param[k];
        if (law->couple) {
            const int32_t row = law->couple_of[p];
            coupled |= l < lanes && row >= 0;
            for (int k = 0; k < 3; ++k) {
                w->cin[k * LANES + l] = w->in[(9 + k) * LANES + l];
                w->cin[(3 + k) * LANES + l] = row >= 0 ? law->couples[3 * row + k] : 0.0;
            }
        }
    }
    if (open) law->kernel(w->in, w->out);
    if (coupled) law->couple(w->cin, w->cout);
    return coupled ? -lanes : lanes;
}

/* What a point's virtual work multiplies, times its volume: r [nz] and, if wanted, w->A [nz][nz]; gradients in
 * the point's frame. */
INLINE void point_terms(const Batch *b, const Law *law, const Work *w, int64_t p, int l, int coupled, int tangent,
                        double *r)
{
    const int nz = unknowns_of(b->dim, b->rot);
    const int64_t row = law->block_of ? law->block_of[p] : -1;
    const double *block = row < 0 ? NULL : law->blocks + row * (nz + (tangent ? nz * nz : 0));
    for (int k = 0; k < nz; ++k) r[k] = b->volume[p] * (block ? block[k] : w->out[k * LANES + l]);
    if (coupled)
        for (int k = 0; k < 3; ++k) r[9 + k] += w->cout[k * LANES + l];
    if (!tangent) return;
    const double *upper = w->out + nz * LANES + l;
    if (block)
        for (int k = 0; k < nz * nz; ++k) w->A[k] = b->volume[p] * block[nz + k];
    else
        for (int i = 0, k = 0; i < nz; ++i)
            for (int j = i; j < nz; ++j, ++k)
                w->A[i * nz + j] = w->A[j * nz + i] = b->volume[p] * upper[k * LANES];
    if (coupled)
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) w->A[(9 + i) * nz + 9 + j] += w->cout[(3 + 3 * i + j) * LANES + l];
}

/* Memory for the evaluation of points and, with `scatter`, for sums of a group. Returns nonzero without memory. */
static int create_work(const Batch *b, int tangent, int scatter, int stride, Work *w)
{
    const int nb = block_of(b), nz = unknowns_of(b->dim, b->rot), most = scatter ? largest_group(b) : 0;
    const int matrix = tangent && scatter, outputs = nz + (tangent ? nz * (nz + 1) / 2 : 0);
    *w = (Work){.in = vectors((size_t)(nz + b->nstate + b->nparam) * LANES), .out = vectors((size_t)outputs * LANES),
                .cin = vectors(6 * LANES), .cout = vectors(12 * LANES),
                .shapes = vectors((size_t)LANES * 4 * stride), .s = vectors((size_t)4 * stride),
                .A = vectors((size_t)nz * nz),
                .f = vectors((size_t)most * nb), .T = vectors((size_t)nz * nb * stride),
                .K = vectors(matrix ? (size_t)most * nb * nb * stride : 1),
                .at = malloc(sizeof(Place) * (most + 1))};
    return !(w->in && w->out && w->cin && w->cout && w->shapes && w->s && w->A && w->f && w->T && w->K && w->at);
}

static void free_work(Work *w)
{
    free(w->in), free(w->out), free(w->cin), free(w->cout), free(w->shapes), free(w->s);
    free(w->A), free(w->f), free(w->T), free(w->K), free(w->at);
}

/* Residual (internal minus couples' work) added to `force`, tangent to M (NULL: residual only).
 * `rhs` takes what prescribed increments add to the residual of free unknowns.
 * Returns nonzero when memory ran out. */
FAST int polarmpm_assemble(const Batch *b, const Law *law, const Matrix *M, const double *x, double *force,
                           double *rhs)
{
    if (b->npoints == 0) return 0;
    const int dim = b->dim, rot = b->rot, nb = block_of(b);
    const int stride = (largest_group(b) + WIDTH - 1) / WIDTH * WIDTH;
    Work w;
    const int failed = create_work(b, M != NULL, 1, stride, &w);
    int64_t group = 0, group_of[LANES], open = -1;
    for (int64_t start = 0; start < b->npoints && !failed; start += LANES) {
        int lanes = evaluate(b, law, x, start, &group, stride, group_of, &w);
        const int coupled = lanes < 0;
        lanes = coupled ? -lanes : lanes;
        for (int l = 0; l < lanes; ++l) {
            const int64_t p = start + l, g = group_of[l];
            const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH;
            if (g != open) {
                memset(w.f, 0, sizeof(double) * n * nb);
                open = g;
            }
            const double *sp = w.shapes + l * 4 * stride;
            double r[21];
            point_terms(b, law, &w, p, l, coupled, M != NULL, r);
            add_residual(dim, rot, n, stride, sp, r, w.f);
            if (M) {
                for (int c = 0; c <= dim; ++c)
                    memcpy((double *)w.s + c * nv * WIDTH, sp + c * stride, sizeof(double) * nv * WIDTH);
                add_tangent_any(dim, rot, nv, M->symmetric, p == b->first[g], n, w.A, w.s, w.T, w.K);
            }
            if (p + 1 == b->first[g + 1]) {
                const int32_t *nodes = b->nodes + b->node_first[g];
                for (int a = 0; a < n; ++a)
                    for (int i = 0; i < nb; ++i) force[(int64_t)nodes[a] * nb + i] += w.f[a * nb + i];
                if (M) flush_any(b, M, g, n, nv, (const double *)w.K, w.at, rhs);
            }
        }
    }
    free_work(&w);
    return failed;
}

#include "_moments.h"
#include "_return.h"

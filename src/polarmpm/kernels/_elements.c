/* Sums over finite elements: residual and tangent of the points' kernels at quadrature points.
 *
 * All elements of a mesh have the same functions of the reference cell, in one table. What tells their shapes apart is a
 * small matrix at each quadrature point, the derivatives of the reference coordinates by the place, turned into the frame
 * in which the point's kernel takes gradients: by it the table becomes the point's weighting functions, and from there on
 * an element is what a group of material points is. */

#include "_work.h"

typedef struct {
    int32_t dim, rot;          /* space dimension, rotation components of a node */
    int32_t second;            /* AXIAL: a body of revolution; else 0 */
    int32_t nodes, points;     /* of an element: nodes, quadrature points */
    int32_t nstate, nparam;
    int64_t nelements;
    const double *table;       /* [quadrature point][value, d/dxi_1, ...][node] */
    const double *axes;        /* [element][quadrature point][xi_a][x_c] d xi_a / d x_c */
    const double *state;       /* [element][quadrature point][nstate] */
    const double *param;       /* [nparam] */
    const double *volume;      /* [element][quadrature point] reference volume */
    const int32_t *cells;      /* [element][node] local node numbers */
    const int32_t *columns;    /* [element][a][b] block column of node b in the row of node a; where only a half of the
                                * pairs is stored, b is the one with the larger global number */
} Elements;

/* What the sums over points read of a batch. */
static Batch as_batch(const Elements *e, const int32_t *count)
{
    return (Batch){.dim = e->dim, .rot = e->rot, .second = e->second, .orders = 2, .nstate = e->nstate, .nparam = e->nparam,
                   .npoints = e->nelements * e->points, .ngroups = 1, .count = count, .param = e->param,
                   .volume = e->volume};
}

/* The table for vectors, [quadrature point][1 + dim][sv]; NULL without memory. */
static vec *padded_table(const Elements *e, int sv)
{
    const int rows = e->points * (1 + e->dim), stride = sv * WIDTH;
    double *out = vectors((size_t)rows * stride);
    for (int r = 0; out && r < rows; ++r) memcpy(out + r * stride, e->table + r * e->nodes, sizeof(double) * e->nodes);
    return (vec *)out;
}

/* Functions of quadrature point k and their gradients by x, [value, d/dx_1, ...][sv]. */
INLINE void element_shape(const int dim, int nv, int sv, const vec *table, int k, const double *axes, vec *s)
{
    const vec *t = table + (int64_t)k * (1 + dim) * sv;
    for (int v = 0; v < nv; ++v) {
        s[v] = t[v];
        for (int c = 0; c < dim; ++c) {
            vec sum = t[sv + v] * axes[c];
            for (int a = 1; a < dim; ++a) sum += t[(1 + a) * sv + v] * axes[a * dim + c];
            s[(1 + c) * sv + v] = sum;
        }
    }
}

/* Evaluate LANES quadrature points from `start` on. Returns how many are real. */
INLINE int evaluate_elements(const int dim, const int rot, const int second, const Elements *e, const PointKernels *kernels,
                             const double *x, const vec *table, int64_t start, Work *w)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), ns = e->nstate, np = e->nparam, n = e->nodes, sv = w->sv;
    const int64_t npoints = e->nelements * e->points;
    const int lanes = (int)(npoints - start < LANES ? npoints - start : LANES);
    int open = 0;
    for (int l = 0; l < lanes; ++l) {
        const int64_t p = start + l, element = p / e->points;
        open |= !kernels->returned_of || kernels->returned_of[p] < 0;
        if (w->gathered != element) {
            gather_group(nb, n, sv, e->cells + element * n, x, w->x);
            if (kernels->before) gather_group(nb, n, sv, e->cells + element * n, kernels->before, w->before);
            w->gathered = element;
        }
        vec *s = w->shapes + (int64_t)l * SHAPES * sv;
        element_shape(dim, sv, sv, table, (int)(p - element * e->points), e->axes + p * dim * dim, s);
        interpolate(dim, rot, second, sv, sv, s, w->x, w->in + l, LANES);
        if (kernels->before) interpolate(dim, rot, second, sv, sv, s, w->before, w->in + (nz + ns + np) * LANES + l, LANES);
        for (int k = 0; k < ns; ++k) w->in[(nz + k) * LANES + l] = e->state[p * ns + k];
    }
    for (int l = lanes; l < LANES; ++l)  /* lanes without a point repeat the last one */
        for (int k = 0; k < (kernels->before ? 2 * nz : nz) + ns + np; ++k)
            w->in[k * LANES + l] = w->in[k * LANES + lanes - 1];
    if (open) kernels->kernel(w->in, w->out);
    return lanes;
}

/* An element's dense matrix into the sparse rows, as `flush_matrix` does it with a group's. Of symmetric sums the row of
 * a pair is the node with the smaller global number: elements have no order of their nodes in common. */
INLINE void flush_element(const Elements *e, const Matrix *M, int64_t element, const int nb, int nv, double *K,
                          double *rhs)
{
    const int n = e->nodes;
    const int32_t *nodes = e->cells + element * n, *columns = e->columns + element * n * n;
    const int64_t cols = (int64_t)nv * WIDTH;
    int constrained = 0;
    for (int a = 0; a < n; ++a)
        for (int i = 0; i < nb; ++i) constrained |= M->fixed[(int64_t)nodes[a] * nb + i];
    for (int a = 0; a < n; ++a)
        for (int q = M->half ? a : 0; q < n; ++q) {
            const int swapped = M->half && M->number[nodes[a]] > M->number[nodes[q]], r = swapped ? q : a;
            const int c = swapped ? a : q, half = M->half && a == q;
            const int64_t column = (int64_t)columns[r * n + c] * nb;
            const int64_t istep = swapped ? cols : nb * cols, jstep = swapped ? nb * cols : cols;
            const double *Kaq = K + (int64_t)a * nb * nb * cols + q;
            if (constrained) {
                const Place at = {.column = column, .row = nodes[r], .col = nodes[c], .swapped = swapped};
                put_constrained(M, nb, at, a == q, Kaq, istep, jstep, rhs);
                continue;
            }
            for (int i = 0; i < nb; ++i) {
                double *out = M->values + M->row_start[(int64_t)nodes[r] * nb + i] + column;
                for (int j = half ? i : 0; j < nb; ++j) out[j] += Kaq[i * istep + j * jstep];
            }
        }
}

INLINE void assemble_elements(const int dim, const int rot, const int second, const Elements *e, const Batch *b,
                              const PointKernels *kernels, const Matrix *M, const double *x, const vec *table,
                              double *force, double *rhs, Work *w)
{
    const int nb = dim + rot, n = e->nodes, sv = w->sv;
    for (int64_t start = 0; start < b->npoints; start += LANES) {
        const int lanes = evaluate_elements(dim, rot, second, e, kernels, x, table, start, w);
        for (int l = 0, end; l < lanes; l = end) {
            const int64_t element = (start + l) / e->points, first = element * e->points, last = first + e->points;
            end = (int)(last - start < lanes ? last - start : lanes);
            if (start + l == first) memset(w->f, 0, sizeof(vec) * nb * sv);
            for (int q = l; q < end; ++q) {
                double r[UNKNOWNS_MAX];
                point_terms(dim, rot, second, b, kernels, w, start + q, q, 0, M != NULL, r);
                add_residual(dim, rot, second, sv, sv, w->shapes + q * SHAPES * sv, r, w->f);
            }
            if (M) {
                const Moduli m = find_moduli(dim, rot, second, b, kernels, w, start, l, end, 0);
                add_tangents(dim, rot, second, 0, sv, M->half, end - l, start + l == first, n, m, w->shapes + l * SHAPES * sv, NULL, sv,
                             w->packed, w->K);
            }
            if (start + end < last) continue;
            const int32_t *nodes = e->cells + element * n;
            for (int a = 0; a < n; ++a)
                for (int i = 0; i < nb; ++i)
                    force[(int64_t)nodes[a] * nb + i] += ((const double *)w->f)[i * sv * WIDTH + a];
            if (M && M->half) mirror(nb, n, (int64_t)sv * WIDTH, (double *)w->K);
            if (M) flush_element(e, M, element, nb, sv, (double *)w->K, rhs);
        }
    }
}

SPECIALISED_PLAIN(assemble_elements, (const Elements *e, const Batch *b, const PointKernels *kernels, const Matrix *M,
                  const double *x, const vec *table, double *force, double *rhs, Work *w), e, b, kernels, M, x, table,
                  force, rhs, w)

/* Residual of elements added to `force`, tangent to M (NULL: residual only); `kernels` without couples, boxes and initial
 * stresses. `rhs` takes what prescribed increments add to the residual of free unknowns. Returns nonzero when memory ran
 * out. */
int polarmpm_assemble_elements(const Elements *e, const PointKernels *kernels, const Matrix *M, const double *x,
                               double *force, double *rhs)
{
    if (e->nelements == 0) return 0;
    const int32_t count[3] = {e->nodes, 1, 1};
    const Batch batch = as_batch(e, count), *b = &batch;
    Work w;
    int failed = create_work(b, M != NULL, 1, 0, &w);
    vec *table = failed ? NULL : padded_table(e, w.sv);
    failed |= !table;
    if (!failed) assemble_elements_sized(e, b, kernels, M, x, table, force, rhs, &w);
    free(table);
    free_work(&w);
    return failed;
}

INLINE void gather_elements(const int dim, const int rot, const int second, const Elements *e, const vec *table, const double *x,
                            double *z, double *value, Work *w)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), n = e->nodes, sv = w->sv;
    for (int64_t element = 0, p = 0; element < e->nelements; ++element) {
        gather_group(nb, n, sv, e->cells + element * n, x, w->x);
        for (int k = 0; k < e->points; ++k, ++p) {
            element_shape(dim, sv, sv, table, k, e->axes + p * dim * dim, w->shapes);
            interpolate(dim, rot, second, sv, sv, w->shapes, w->x, z + p * nz, 1);
            for (int i = 0; value && i < nb; ++i) value[p * nb + i] = dot(sv, w->x + i * sv, w->shapes);
        }
    }
}

SPECIALISED_PLAIN(gather_elements, (const Elements *e, const vec *table, const double *x, double *z, double *value,
                  Work *w), e, table, x, z, value, w)

/* Increments at the quadrature points: z [point][nz], by the elements' axes, and, unless NULL, interpolated values
 * [point][block]. Returns nonzero when memory ran out. */
int polarmpm_gather_elements(const Elements *e, const double *x, double *z, double *value)
{
    const int32_t count[3] = {e->nodes, 1, 1};
    const Batch b = as_batch(e, count);
    Work w;
    int failed = create_work(&b, 0, 0, 0, &w);
    vec *table = failed ? NULL : padded_table(e, w.sv);
    failed |= !table;
    if (!failed) gather_elements_sized(e, table, x, z, value, &w);
    free(table);
    free_work(&w);
    return failed;
}

INLINE void sum_element_modes(const int dim, const int rot, const int second, const Elements *e, const Patches *P, const vec *table,
                              const double *work, int64_t step, double *out, Work *w)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), n = e->nodes, sv = w->sv;
    const double *f = (const double *)w->f;
    for (int64_t element = 0, p = 0; element < e->nelements; ++element)
        for (int k = 0; k < e->points; ++k, ++p) {
            element_shape(dim, sv, sv, table, k, e->axes + p * dim * dim, w->shapes);
            for (int c = 0; c < P->scalars; ++c) {
                memset(w->f, 0, sizeof(vec) * nb * sv);
                add_residual(dim, rot, second, sv, sv, w->shapes, work + p * step + c * nz, w->f);
                for (int a = 0; a < P->functions; ++a) {
                    const double weight = e->volume[p] * P->values[p * P->functions + a];
                    double *mode = out + (element * P->modes + a * P->scalars + c) * nb * n;
                    for (int i = 0; i < nb; ++i)
                        for (int q = 0; q < n; ++q) mode[i * n + q] += weight * f[i * sv * WIDTH + q];
                }
            }
        }
}

SPECIALISED_PLAIN(sum_element_modes, (const Elements *e, const Patches *P, const vec *table, const double *work,
                  int64_t step, double *out, Work *w), e, P, table, work, step, out, w)

/* Vectors of the modes of elements as patches, see sum_patches, of one kind of work [point][step]; returns nonzero when
 * memory ran out. */
int polarmpm_element_vectors(const Elements *e, const Patches *P, const double *work, int64_t step, double *out)
{
    const int32_t count[3] = {e->nodes, 1, 1};
    const Batch b = as_batch(e, count);
    Work w;
    int failed = create_work(&b, 0, 1, 0, &w);
    vec *table = failed ? NULL : padded_table(e, w.sv);
    failed |= !table;
    if (!failed) sum_element_modes_sized(e, P, table, work, step, out, &w);
    free(table);
    free_work(&w);
    return failed;
}

/* Adds sum over the modes of g b^T + b h^T of each element to the matrix, as polarmpm_add_patches does. */
FAST int polarmpm_add_element_modes(const Elements *e, const Patches *P, const double *b, const double *g,
                                    const double *h, const Matrix *M, double *rhs)
{
    const int n = e->nodes, nb = e->dim + e->rot, nv = (n + WIDTH - 1) / WIDTH, cols = nv * WIDTH;
    double *K = vectors((size_t)n * nb * nb * cols);
    if (!K) return 1;
    for (int64_t element = 0; element < e->nelements; ++element) {
        memset(K, 0, sizeof(double) * n * nb * nb * cols);
        for (int k = 0; k < P->modes; ++k) {
            const int64_t at = (element * P->modes + k) * nb * n;
            const double *bk = b + at, *gk = g + at, *hk = h + at;
            for (int a = 0; a < n; ++a)
                for (int i = 0; i < nb; ++i)
                    for (int j = 0; j < nb; ++j) {
                        const double ga = gk[i * n + a], ba = bk[i * n + a];
                        double *row = K + (int64_t)((a * nb + i) * nb + j) * cols;
                        for (int q = M->half ? a : 0; q < n; ++q) row[q] += ga * bk[j * n + q] + ba * hk[j * n + q];
                    }
        }
        flush_element(e, M, element, nb, nv, K, rhs);
    }
    free(K);
    return 0;
}

/* Numbers the nodes that share an element with each node, in the order in which they are met: code [element][a][b] of
 * node b among those of node a. With `half` only of pairs whose first node has the smaller global number, -1 for the
 * others. `incident` lists (element * nodes + a) node by node, node i's from start[i] on. Returns the largest number of
 * neighbours of a node, -1 without memory. */
int polarmpm_couple_elements(int64_t nnodes, int32_t nodes, const int32_t *cells, const int64_t *number, int32_t half,
                             const int64_t *start, const int64_t *incident, int32_t *code)
{
    int32_t *met_by = malloc(sizeof(int32_t) * (nnodes + 1)), *as = malloc(sizeof(int32_t) * (nnodes + 1));
    int most = met_by && as ? 0 : -1;
    for (int64_t i = 0; most >= 0 && i < nnodes; ++i) met_by[i] = -1;
    for (int64_t i = 0; most >= 0 && i < nnodes; ++i) {
        int count = 0;
        for (int64_t k = start[i]; k < start[i + 1]; ++k) {
            const int64_t element = incident[k] / nodes;
            const int32_t *other = cells + element * nodes;
            int32_t *out = code + incident[k] * nodes;
            for (int q = 0; q < nodes; ++q) {
                const int32_t j = other[q];
                if (half && number[j] < number[i]) {
                    out[q] = -1;
                    continue;
                }
                if (met_by[j] != (int32_t)i) met_by[j] = (int32_t)i, as[j] = count++;
                out[q] = as[j];
            }
        }
        if (count > most) most = count;
    }
    free(met_by), free(as);
    return most;
}

SIZE_OF(Elements);

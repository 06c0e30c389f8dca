/* Sums over material points: nodal values -> points, and points -> nodal vectors and sparse matrix.
 *
 * The material is a compiled kernel (see codegen.py) that treats LANES points in one call. Points are sorted
 * into groups that share one set of nodes, a box of `count` lattice nodes in each direction. A group adds up
 * its points in a small dense matrix and goes into the sparse matrix once. Within the dense matrix the
 * columns are ordered [component][node], so that the innermost loop runs over nodes with constant length.
 *
 * The file uses no Python header; native.py loads it with ctypes.
 */
#include "_points.h"

int polarmpm_interface(void) { return INTERFACE; }

/* Where z holds a component (axis < 0), its derivative along an axis, or (axis - dim) one of its second derivatives, -1:
 * nowhere; for the test of _layout.h. */
int polarmpm_slot(int32_t dim, int32_t rot, int32_t second, int32_t component, int32_t axis)
{
    if (axis >= dim) return second == SECOND && component < dim ? second_slot(dim, rot, component) + axis - dim : -1;
    if (axis >= 0) return gradient_slot(dim, rot, component) + axis;
    return has_value(dim, second, component) ? value_slot(dim, rot, component) : -1;
}

int polarmpm_unknowns(int32_t dim, int32_t rot, int32_t second) { return unknowns_of(dim, rot, second); }

/* Nodal sums of point values: out[node][c] += S f[point][c]. */
void polarmpm_spread(const Batch *b, const double *f, int32_t nc, double *out)
{
    const int stride = largest_group(b);
    double *s = malloc(sizeof(double) * SHAPES * stride);
    for (int64_t g = 0; g < b->ngroups; ++g) {
        const int n = nodes_of(b, g);
        const int32_t *nodes = b->nodes + b->node_offsets[g];
        for (int64_t p = b->offsets[g]; p < b->offsets[g + 1]; ++p) {
            shape(b->dim, b, p, b->count + g * b->dim, NULL, stride, s);
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
        const int32_t *c = b->count + g * b->dim, *nodes = b->nodes + b->node_offsets[g];
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

/* Columns of the scalar rows of block rows: nodes' block columns cols[offsets[I]..offsets[I + 1]], ascending, in
 * symmetric matrices from the diagonal on. */
void polarmpm_scalar_columns(int64_t nodes, const int64_t *offsets, const int64_t *cols, int32_t block,
                             int32_t symmetric, int32_t *out)
{
    for (int64_t node = 0; node < nodes; ++node)
        for (int i = 0; i < block; ++i)
            for (int64_t k = offsets[node]; k < offsets[node + 1]; ++k)
                for (int j = symmetric && k == offsets[node] ? i : 0; j < block; ++j)
                    *out++ = (int32_t)(cols[k] * block + j);
}

#include "_scatter.h"
#include "_boxes.h"

typedef struct {
    double *in, *out, *cin, *cout, *iin, *iout, *A;
    vec *shapes, *x, *before, *f, *K;  /* shapes [lane][shapes_of(second)][sv], nodal values [component][sv] of a group */
    vec *raw;                          /* what second_shape needs */
    Place *at;
    int sv;                            /* vectors of the nodes of the largest group */
    int64_t gathered;                  /* the group of which x and before are; -1: none */
    BoxWork boxes;                     /* without memory where no point has a box */
} Work;

INLINE void gather_group(const int nb, int n, int sv, const int32_t *nodes, const double *x, vec *out)
{
    double *to = (double *)out;
    for (int i = 0; i < nb; ++i) {
        for (int a = 0; a < n; ++a) to[i * sv * WIDTH + a] = x[(int64_t)nodes[a] * nb + i];
        for (int a = n; a < sv * WIDTH; ++a) to[i * sv * WIDTH + a] = 0.0;
    }
}

/* The initial stresses' part, of LANES points whose z and frames stand in w->in. */
INLINE void evaluate_initial(const int dim, const int rot, const int second, const PointKernels *kernels, int64_t start,
                             int lanes, const Work *w)
{
    const int known = unknowns_of(dim, rot, second) + dim * dim, n = kernels->ninitial;
    memcpy(w->iin, w->in, sizeof(double) * known * LANES);
    for (int l = 0; l < LANES; ++l) {
        const double *stress = kernels->initial_stress + (start + (l < lanes ? l : lanes - 1)) * n;
        for (int k = 0; k < n; ++k) w->iin[(known + k) * LANES + l] = stress[k];
    }
    kernels->initial(w->iin, w->iout);
}

INLINE int lanes_from(const Batch *b, int64_t start)
{
    return (int)(b->npoints - start < LANES ? b->npoints - start : LANES);
}

/* What the kernels read of LANES points from `start` on, of which `lanes_from` are real: shapes of each, then z and the
 * state. */
INLINE void gather_lanes(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                         const double *x, int64_t start, int64_t *group, int64_t *group_of, Work *w)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), ns = b->nstate, np = b->nparam, sv = w->sv;
    const int lanes = lanes_from(b, start);
    BoxWork *boxes = &w->boxes;
    for (int l = 0; l < lanes; ++l) {
        const int64_t p = start + l;
        while (p >= b->offsets[*group + 1]) ++*group;
        group_of[l] = *group;
        const int n = nodes_of(b, *group);
        const int32_t *count = b->count + *group * dim;
        vec *s = w->shapes + (int64_t)l * shapes_of(second) * sv;
        shape(dim, b, p, count, b->state + p * ns, sv * WIDTH, (double *)s);
        if (second == SECOND) second_shape(dim, b, p, count, b->state + p * ns, n, sv, w->raw, s);
        if (kernels->box_axes) find_curved(dim, rot, b, kernels, p, count, n, sv, l, boxes);
        for (int k = 0; k < ns; ++k) w->in[(nz + k) * LANES + l] = b->state[p * ns + k];
    }
    for (int l = 0; l < lanes; ++l) {
        const int64_t g = group_of[l];
        const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH;
        const int32_t *nodes = b->nodes + b->node_offsets[g];
        if (w->gathered != g) {
            gather_group(nb, n, sv, nodes, x, w->x);
            if (kernels->before) gather_group(nb, n, sv, nodes, kernels->before, w->before);
            w->gathered = g;
        }
        const vec *s = w->shapes + (int64_t)l * shapes_of(second) * sv;
        interpolate(dim, rot, second, nv, sv, s, w->x, w->in + l, LANES);
        if (kernels->before)
            interpolate(dim, rot, second, nv, sv, s, w->before, w->in + (nz + ns + np) * LANES + l, LANES);
        if (kernels->box_axes) {
            gather_curved(dim, rot, nv, sv, w->x, l, boxes, boxes->h);
            if (kernels->before) gather_curved(dim, rot, nv, sv, w->before, l, boxes, boxes->h_before);
        }
    }
    for (int l = lanes; l < LANES; ++l) {  /* lanes without a point repeat the last one */
        for (int k = 0; k < nz + ns; ++k) w->in[k * LANES + l] = w->in[k * LANES + lanes - 1];
        for (int k = nz + ns + np; kernels->before && k < 2 * nz + ns + np; ++k)
            w->in[k * LANES + l] = w->in[k * LANES + lanes - 1];
    }
    for (int l = lanes; kernels->box_hoop && l < LANES; ++l)
        for (int k = 0; k < dim; ++k) boxes->hoop[k][l] = boxes->hoop[k][lanes - 1];
    if (kernels->box_axes) {
        find_along(dim, w->in + nz * LANES, boxes);
        find_zk(dim, rot, second, kernels, start, lanes, w->in, boxes->h, boxes, boxes->zk);
        find_arched(dim, rot, second, boxes->h, boxes, boxes->arched);
        const double *before = w->in + (nz + ns + np) * LANES;
        if (kernels->before) find_zk(dim, rot, second, kernels, start, lanes, before, boxes->h_before, boxes, boxes->before);
        if (kernels->before) find_arched(dim, rot, second, boxes->h_before, boxes, boxes->arched_before);
    }
}

/* Evaluate LANES points from `start` on, and their boxes. */
INLINE void evaluate(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                     const double *x, int64_t start, int64_t *group, int64_t *group_of, Work *w, int *coupled)
{
    const int turn = value_slot(dim, rot, dim);  /* rotations in z; couples do work in space only */
    const int lanes = lanes_from(b, start);
    int open = 0;
    *coupled = 0;
    gather_lanes(dim, rot, second, b, kernels, x, start, group, group_of, w);
    for (int l = 0; l < lanes; ++l) open |= !kernels->returned_of || kernels->returned_of[start + l] < 0;
    for (int l = 0; kernels->couple && l < LANES; ++l) {
        const int32_t row = kernels->couple_of[start + (l < lanes ? l : lanes - 1)];
        *coupled |= row >= 0;
        for (int k = 0; k < SPIN; ++k) {
            w->cin[k * LANES + l] = w->in[(turn + k) * LANES + l];
            w->cin[(SPIN + k) * LANES + l] = row >= 0 ? kernels->couples[SPIN * row + k] : 0.0;
        }
    }
    if (open || (kernels->box_axes && !kernels->box_kernel)) kernels->kernel(w->in, w->out);
    else if (kernels->box_kernel) kernels->box_kernel(w->in, w->out);  /* points that yield: the boxes' residual alone */
    if (kernels->box_kernel) evaluate_boxes(dim, rot, second, b, kernels, w->in, w->out, &w->boxes);
    if (kernels->box_store)
        store_boxes(dim, rot, second, w->in, w->out, &w->boxes, kernels->box_store + start / LANES * stored_of(dim, rot, second));
    if (*coupled) kernels->couple(w->cin, w->cout);
    if (kernels->initial) evaluate_initial(dim, rot, second, kernels, start, lanes, w);
}

SPECIALISED(evaluate, (const Batch *b, const PointKernels *kernels, const double *x, int64_t start, int64_t *group,
            int64_t *group_of, Work *w, int *coupled), b, kernels, x, start, group, group_of, w, coupled)

/* What a point's virtual work multiplies, times its volume: r [nz] and, if wanted, A [nz][nz]; gradients in
 * the point's frame. */
INLINE void point_terms(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                        const Work *w, int64_t p, int l, int coupled, double *r, double *A)
{
    const int nz = unknowns_of(dim, rot, second), turn = value_slot(dim, rot, dim);
    const int64_t row = kernels->returned_of ? kernels->returned_of[p] : -1;
    const double *block = row < 0 ? NULL : kernels->returned + row * (nz + (A ? nz * nz : 0)), volume = b->volume[p];
    for (int k = 0; k < nz; ++k) r[k] = volume * (block ? block[k] : w->out[k * LANES + l]);
    for (int k = 0; kernels->initial && k < nz; ++k) r[k] += volume * w->iout[k * LANES + l];
    if (coupled)
        for (int k = 0; k < SPIN; ++k) r[turn + k] += w->cout[k * LANES + l];
    if (!A) return;
    const double *upper = w->out + nz * LANES + l;
    if (block)
        for (int k = 0; k < nz * nz; ++k) A[k] = volume * block[nz + k];
    else
        for (int i = 0; i < nz; ++i)
            for (int j = i; j < nz; ++j, upper += LANES) A[i * nz + j] = A[j * nz + i] = volume * *upper;
    const double *more = w->iout + nz * LANES + l;
    for (int i = 0; kernels->initial && i < nz; ++i)
        for (int j = i; j < nz; ++j, more += LANES) {
            A[i * nz + j] += volume * *more;
            if (j > i) A[j * nz + i] += volume * *more;
        }
    if (coupled)
        for (int i = 0; i < SPIN; ++i)
            for (int j = 0; j < SPIN; ++j)
                A[(turn + i) * nz + turn + j] += w->cout[(SPIN * (1 + i) + j) * LANES + l];
}

/* Memory for the evaluation of points, with `scatter` for sums of a group, with `boxes` (2: for their whole tangent) for
 * the points' boxes. Returns nonzero without memory. */
static int create_work(const Batch *b, int tangent, int scatter, int boxes, Work *w)
{
    const int nb = block_size(b), nz = unknowns_of(b->dim, b->rot, b->second), largest = largest_group(b);
    const int most = scatter ? largest : 0, outputs = nz + (tangent ? nz * (nz + 1) / 2 : 0);
    const size_t sv = (largest + WIDTH - 1) / WIDTH, stride = sv * WIDTH, inputs = 2 * nz + b->nstate + b->nparam;
    *w = (Work){.in = vectors(inputs * LANES), .out = vectors((size_t)outputs * LANES),
                .cin = vectors(2 * SPIN * LANES), .cout = vectors(SPIN * (1 + SPIN) * LANES),
                .iin = vectors((nz + b->dim * b->dim + INITIAL_MAX) * LANES), .iout = vectors((size_t)outputs * LANES),
                .A = vectors((size_t)LANES * nz * nz),
                .shapes = vectors(LANES * shapes_of(b->second) * stride),
                .raw = vectors(b->second == SECOND ? (3 + PAIRS) * stride : 1), .x = vectors(nb * stride), .before = vectors(nb * stride),
                .f = vectors(nb * stride), .K = vectors(tangent && scatter ? most * nb * nb * stride : 1),
                .at = malloc(sizeof(Place) * (most + 1)), .sv = (int)sv, .gathered = -1};
    if (!(w->in && w->out && w->cin && w->cout && w->iin && w->iout && w->A && w->shapes && w->raw && w->x && w->before && w->f && w->K && w->at))
        return 1;
    for (int k = 0; k < b->nparam; ++k)
        for (int l = 0; l < LANES; ++l) w->in[(nz + b->nstate + k) * LANES + l] = b->param[k];
    return boxes && create_boxes(b, w->sv, scatter, boxes > 1, &w->boxes);
}

static void free_work(Work *w)
{
    free(w->in), free(w->out), free(w->cin), free(w->cout), free(w->iin), free(w->iout), free(w->A);
    free(w->shapes), free(w->raw), free(w->x), free(w->before), free(w->f), free(w->K), free(w->at);
    free_boxes(&w->boxes);
}

INLINE void gather(const int dim, const int rot, const int second, const Batch *b, const double *x, int32_t framed,
                   double *z, double *value, Work *w)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), sv = w->sv;
    for (int64_t g = 0; g < b->ngroups; ++g) {
        const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH;
        gather_group(nb, n, sv, b->nodes + b->node_offsets[g], x, w->x);
        for (int64_t p = b->offsets[g]; p < b->offsets[g + 1]; ++p) {
            const double *frame = framed ? b->state + p * b->nstate : NULL;
            shape(dim, b, p, b->count + g * dim, frame, sv * WIDTH, (double *)w->shapes);
            if (second == SECOND) second_shape(dim, b, p, b->count + g * dim, frame, n, sv, w->raw, w->shapes);
            interpolate(dim, rot, second, nv, sv, w->shapes, w->x, z + p * nz, 1);
            for (int i = 0; value && i < nb; ++i) value[p * nb + i] = dot(nv, w->x + i * sv, w->shapes);
        }
    }
}

SPECIALISED(gather, (const Batch *b, const double *x, int32_t framed, double *z, double *value, Work *w), b, x,
            framed, z, value, w)

/* Increments at the points: z [point][nz], in the grid's frame or that of the state, and, unless NULL,
 * interpolated values [point][block]. Returns nonzero when memory ran out. */
int polarmpm_gather(const Batch *b, const double *x, int32_t framed, double *z, double *value)
{
    Work w;
    const int failed = create_work(b, 0, 0, 0, &w);
    if (!failed) gather_sized(b, x, framed, z, value, &w);
    free_work(&w);
    return failed;
}

/* Points l .. end of these lanes, all of group g: their work into the group's sums. */
INLINE void add_points(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                       const Matrix *M, const Work *w, int64_t start, int64_t g, int l, int end, int coupled)
{
    const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH, nz = unknowns_of(dim, rot, second), sv = w->sv;
    const int shapes = shapes_of(second);
    for (int q = l; q < end; ++q) {
        double r[UNKNOWNS_MAX];
        point_terms(dim, rot, second, b, kernels, w, start + q, q, coupled, r, M ? w->A + q * nz * nz : NULL);
        if (kernels->box_kernel) {
            const double weight = b->volume[start + q] * kernels->box_share[start + q] / 6.0;
            add_sides(dim, rot, second, nv, sv, &w->boxes, weight, q, r, w->f);
        }
        add_residual(dim, rot, second, nv, sv, w->shapes + q * shapes * sv, r, w->f);
    }
    for (int P; M && l < end; l += P) {
        P = end - l >= MANY ? MANY : end - l >= 2 ? 2 : 1;
        add_tangents(dim, rot, second, nv, M->half, P, start + l == b->offsets[g], n, w->A + l * nz * nz,
                     w->shapes + l * shapes * sv, sv, w->K);
    }
}

INLINE void assemble(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                     const Matrix *M, const double *x, double *force, double *rhs, Work *w)
{
    const int nb = dim + rot;
    int64_t group = 0, group_of[LANES];
    for (int64_t start = 0; start < b->npoints; start += LANES) {
        int coupled;
        const int lanes = lanes_from(b, start);
        evaluate_sized(b, kernels, x, start, &group, group_of, w, &coupled);
        if (kernels->box_kernel) collect_sides(dim, rot, second, kernels, &w->boxes);
        for (int l = 0, end; l < lanes; l = end) {
            const int64_t g = group_of[l];
            for (end = l + 1; end < lanes && group_of[end] == g; ++end) {}
            if (start + l == b->offsets[g]) memset(w->f, 0, sizeof(vec) * nb * w->sv);
            add_points(dim, rot, second, b, kernels, M, w, start, g, l, end, coupled);
            if (start + end < b->offsets[g + 1]) continue;
            const int32_t *nodes = b->nodes + b->node_offsets[g];
            const int n = nodes_of(b, g);
            for (int a = 0; a < n; ++a)
                for (int i = 0; i < nb; ++i)
                    force[(int64_t)nodes[a] * nb + i] += ((const double *)w->f)[i * w->sv * WIDTH + a];
            if (M) flush_matrix(b, M, g, nb, n, (n + WIDTH - 1) / WIDTH, (double *)w->K, w->at, rhs);
        }
    }
}

SPECIALISED(assemble, (const Batch *b, const PointKernels *kernels, const Matrix *M, const double *x, double *force,
            double *rhs, Work *w), b, kernels, M, x, force, rhs, w)

/* Residual (internal minus couples' work) added to `force`, tangent to M (NULL: residual only).
 * `rhs` takes what prescribed increments add to the residual of free unknowns.
 * Returns nonzero when memory ran out. */
int polarmpm_assemble(const Batch *b, const PointKernels *kernels, const Matrix *M, const double *x, double *force,
                      double *rhs)
{
    if (b->npoints == 0) return 0;
    Work w;
    const int failed = create_work(b, M != NULL, 1, kernels->box_axes != NULL, &w);
    if (!failed) assemble_sized(b, kernels, M, x, force, rhs, &w);
    free_work(&w);
    return failed;
}

/* scale B^T A B of points l .. end of these lanes, all of group g, with the moduli of `out` and shapes [lane]. */
INLINE void add_box_moduli(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Matrix *M,
                           const Work *w, const double *out, const vec *shapes, double scale, int k, double sign, int first, int64_t start,
                           int64_t g, int l, int end)
{
    const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH, nz = unknowns_of(dim, rot, second), sv = w->sv;
    for (int q = l; q < end; ++q) {
        const double on_side = second == AXIAL && sign != 0.0 ? SIDE_WEIGHT(&w->boxes, k, sign)[q] : 1.0;
        const double weight = scale * on_side * b->volume[start + q] * kernels->box_share[start + q];
        const double *upper = out + nz * LANES + q;
        double *A = w->A + q * nz * nz;
        for (int i = 0; i < nz; ++i)
            for (int j = i; j < nz; ++j, upper += LANES) A[i * nz + j] = A[j * nz + i] = weight * *upper;
    }
    for (int P; l < end; l += P) {
        P = end - l >= MANY ? MANY : end - l >= 2 ? 2 : 1;
        add_tangents(dim, rot, second, nv, M->half, P, first && start + l == b->offsets[g], n, w->A + l * nz * nz,
                     shapes + l * shapes_of(second) * sv, sv, w->K);
    }
}

/* The tangent of the boxes of points l .. end of these lanes into their group's sums; see polarmpm_assemble_boxes. */
INLINE void add_boxes(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Matrix *M,
                      int32_t whole, const Work *w, int64_t start, int64_t g, int l, int end)
{
    const BoxWork *boxes = &w->boxes;
    const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH, sv = w->sv, nz = unknowns_of(dim, rot, second);
    const int outputs = nz + nz * (nz + 1) / 2;
    for (int q = l; q < end; ++q) side_shapes(dim, rot, second, kernels, nv, sv, w->shapes + (int64_t)q * shapes_of(second) * sv, q, boxes);
    if (whole)
        add_box_moduli(dim, rot, second, b, kernels, M, w, w->out, w->shapes, -dim / 3.0, 0, 0.0, 1, start, g, l, end);
    for (int k = 0; k < dim; ++k) {
        const vec *side = boxes->sides + (int64_t)k * LANES * shapes_of(second) * sv;
        if (!whole) {
            add_box_moduli(dim, rot, second, b, kernels, M, w, w->out, side, 1.0 / 3.0, 0, 0.0, k == 0, start, g, l, end);
            continue;
        }
        for (int down = 0; down < 2; ++down) {
            move_shapes(second, sv, w->shapes, side, down ? -1.0 : 1.0, l, end, boxes->moved);
            add_box_moduli(dim, rot, second, b, kernels, M, w, boxes->moduli + (2 * k + down) * outputs * LANES, boxes->moved,
                           1.0 / 6.0, k, down ? -1.0 : 1.0, 0, start, g, l, end);
        }
    }
}

/* Whether a group has nodes that are still to be moved as prescribed. */
static int is_lifted(const Batch *b, const Matrix *M, int64_t g, int nb)
{
    const int32_t *nodes = b->nodes + b->node_offsets[g];
    for (int a = 0; a < nodes_of(b, g); ++a)
        for (int i = 0; i < nb; ++i)
            if (M->lift[(int64_t)nodes[a] * nb + i] != 0.0) return 1;
    return 0;
}

INLINE void assemble_boxes(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Matrix *M,
                           int32_t whole, int32_t lift_only, const double *x, double *rhs, Work *w)
{
    int64_t group = 0, group_of[LANES];
    int lifted[LANES];
    for (int64_t start = 0; start < b->npoints; start += LANES) {
        int coupled;
        const int lanes = lanes_from(b, start);
        if (lift_only) {
            int some = 0;
            int64_t g = group;
            for (int l = 0; l < lanes; ++l) {
                const int64_t before = g;
                while (start + l >= b->offsets[g + 1]) ++g;
                if (!l || g > before) some |= lifted[l] = is_lifted(b, M, g, dim + rot);
                else lifted[l] = lifted[l - 1];
            }
            if (!some) continue;
        }
        evaluate_sized(b, kernels, x, start, &group, group_of, w, &coupled);
        int simple[LANES], large = 0;
        for (int l = 0; whole && l < lanes; ++l)
            large |= !(simple[l] = is_simple(second, kernels, start + l));
        if (large) {
            evaluate_sides(dim, rot, second, b, kernels, w->in, &w->boxes);
            simplify_sides(dim, rot, second, simple, lanes, w->out, &w->boxes);
        }
        for (int l = 0, end; l < lanes; l = end) {
            const int64_t g = group_of[l];
            for (end = l + 1; end < lanes && group_of[end] == g; ++end) {}
            if (lift_only && !lifted[l]) continue;
            add_boxes(dim, rot, second, b, kernels, M, large, w, start, g, l, end);
            if (start + end < b->offsets[g + 1]) continue;
            const int n = nodes_of(b, g);
            if (lift_only) add_lifted(b, M, g, dim + rot, n, (n + WIDTH - 1) / WIDTH, (double *)w->K, rhs);
            else flush_matrix(b, M, g, dim + rot, n, (n + WIDTH - 1) / WIDTH, (double *)w->K, w->at, rhs);
        }
    }
}

SPECIALISED(assemble_boxes, (const Batch *b, const PointKernels *kernels, const Matrix *M, int32_t whole,
            int32_t lift_only, const double *x, double *rhs, Work *w), b, kernels, M, whole, lift_only, x, rhs, w)

/* The tangent of the boxes to M: `whole`, or what their sides' strains add while the moduli are those of the points; the
 * latter also of points whose boxes count for little. The
 * kernel is that of the elastic energy. `rhs` as in polarmpm_assemble; with `lift_only` nothing else is summed. Returns
 * nonzero when memory ran out. */
int polarmpm_assemble_boxes(const Batch *b, const PointKernels *kernels, const Matrix *M, int32_t whole,
                            int32_t lift_only, const double *x, double *rhs)
{
    if (b->npoints == 0) return 0;
    Work w;
    const int failed = create_work(b, 1, 1, 1 + whole, &w);
    if (!failed) assemble_boxes_sized(b, kernels, M, whole, lift_only, x, rhs, &w);
    free_work(&w);
    return failed;
}

INLINE void gather_boxes(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const double *x,
                         double *z, double *zk, double *bent, Work *w)
{
    const int nz = unknowns_of(dim, rot, second);
    int64_t group = 0, group_of[LANES];
    for (int64_t start = 0; start < b->npoints; start += LANES) {
        gather_lanes(dim, rot, second, b, kernels, x, start, &group, group_of, w);
        for (int l = 0; l < lanes_from(b, start); ++l) {
            const int64_t p = start + l;
            for (int i = 0; i < nz; ++i) z[p * nz + i] = w->in[i * LANES + l];
            for (int i = 0; i < dim * nz; ++i) zk[p * dim * nz + i] = w->boxes.zk[i * LANES + l];
            for (int k = 0; bent && k < dim; ++k)
                for (int v = 0; v < values_of(rot, second); ++v) bent[(p * dim + k) * BENT + v] = w->boxes.arched[k * BENT + v][l];
        }
    }
}

SPECIALISED(gather_boxes, (const Batch *b, const PointKernels *kernels, const double *x, double *z, double *zk,
            double *bent, Work *w), b, kernels, x, z, zk, bent, w)

/* z [point][nz] in the frame of the state, and its derivatives along the half axes, zk [point][dim][nz]; of bodies of
 * revolution also the quadratic parts of its values, bent [point][dim][BENT]. Returns nonzero when memory ran out. */
int polarmpm_gather_boxes(const Batch *b, const PointKernels *kernels, const double *x, double *z, double *zk, double *bent)
{
    Work w;
    const int failed = create_work(b, 0, 0, 1, &w);
    if (!failed) gather_boxes_sized(b, kernels, x, z, zk, bent, &w);
    free_work(&w);
    return failed;
}

INLINE void box_work(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const double *from,
                     const double *to, const double *from_store, const double *to_store, double *inside, double *whole, Work *w,
                     double *room)
{
    const int size = stored_of(dim, rot, second), nz = unknowns_of(dim, rot, second), sides = stored_sides(dim, rot, second);
    int64_t group = 0, group_of[LANES];
    for (int64_t start = 0; start < b->npoints; start += LANES) {
        const double *given[2] = {from_store, to_store}, *x[2] = {from, to};
        const loose_t *at[2];
        for (int end = 0; end < 2; ++end) {
            at[end] = (const loose_t *)(given[end] ? given[end] + start / LANES * size : room + end * size);
            if (given[end]) continue;
            int coupled;
            int64_t first = group;
            evaluate_sized(b, kernels, x[end], start, &first, group_of, w, &coupled);
            w->gathered = -1;  /* the same group at other nodal values */
            store_boxes(dim, rot, second, w->in, w->out, &w->boxes, room + end * size);
            if (end) group = first;
        }
        loose_t at_point = {0}, in_box = {0};  /* z and what it does work on at the point; z_k and so on in its box */
        for (int i = 0; i < nz; ++i) {
            const loose_t moved = at[1][i] - at[0][i];
            at_point += moved * (at[1][nz + i] - at[0][nz + i]);
            in_box += moved * (at[1][2 * nz + i] - at[0][2 * nz + i]);
        }
        for (int i = 3 * nz; i < 3 * nz + sides; ++i)
            in_box += (at[1][i] - at[0][i]) * (at[1][sides + i] - at[0][sides + i]);
        for (int l = 0; l < lanes_from(b, start); ++l) {
            const double volume = b->volume[start + l], weight = volume * kernels->box_share[start + l] / 6.0;
            inside[start + l] = weight * in_box[l];
            whole[start + l] = volume * at_point[l] + weight * in_box[l];
        }
    }
}

SPECIALISED(box_work, (const Batch *b, const PointKernels *kernels, const double *from, const double *to, const double *from_store,
            const double *to_store, double *inside, double *whole, Work *w, double *room), b, kernels, from, to, from_store,
            to_store, inside, whole, w, room)

/* Numbers that `box_store` takes for LANES points. */
int polarmpm_stored(const Batch *b) { return stored_of(b->dim, b->rot, b->second); }

/* Of each point, the work of the change of its elastic stresses on the increments between two nodal states, and what of
 * it is done inside its box: (z' - z)(R' - R), twice the energy of the change where that is linear. What a `box_store` has
 * taken in these states isn't evaluated again; NULL: nothing. Returns nonzero when memory ran out. */
int polarmpm_box_work(const Batch *b, const PointKernels *kernels, const double *from, const double *to, const double *from_store,
                      const double *to_store, double *inside, double *whole)
{
    if (b->npoints == 0) return 0;
    Work w;
    double *room = vectors(2 * (size_t)stored_of(b->dim, b->rot, b->second));
    const int failed = create_work(b, 0, 0, 1, &w) || !room;
    if (!failed) box_work_sized(b, kernels, from, to, from_store, to_store, inside, whole, &w, room);
    free_work(&w);
    free(room);
    return failed;
}

/* The other half of symmetric sums whose rows are whole. Pairs: local nodes, and block columns of (row, col) and of
 * (col, row) in their rows; each node with itself, too. */
void polarmpm_mirror(const Matrix *M, int32_t nb, int64_t pairs, const int32_t *row, const int32_t *col,
                     const int32_t *there, const int32_t *back)
{
    for (int64_t p = 0; p < pairs; ++p)
        for (int i = 0; i < nb; ++i) {
            const double *from = M->values + M->row_start[(int64_t)row[p] * nb + i] + (int64_t)there[p] * nb;
            for (int j = row[p] == col[p] ? i + 1 : 0; j < nb; ++j)
                M->values[M->row_start[(int64_t)col[p] * nb + j] + (int64_t)back[p] * nb + i] = from[j];
        }
}

#include "_elements.h"
#include "_patches.h"
#include "_moments.h"
#include "_measures.h"

SIZE_OF(Batch);
SIZE_OF(Matrix);
SIZE_OF(PointKernels);
SIZE_OF(Elements);
SIZE_OF(Patches);

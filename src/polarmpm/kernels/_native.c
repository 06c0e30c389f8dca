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

#include "_work.h"

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

/* Shapes of LANES points, for sums of their tangents. */
INLINE void find_shapes(const int dim, const int second, const Batch *b, int64_t start, const int64_t *group_of, const Work *w)
{
    for (int l = 0; l < lanes_from(b, start); ++l) {
        const int64_t p = start + l;
        const double *frame = b->state + p * b->nstate;
        const int32_t *count = b->count + group_of[l] * dim;
        const int n = nodes_of(b, group_of[l]);
        vec *s = w->shapes + (int64_t)l * shapes_of(second) * w->sv;
        shape(dim, b, p, count, frame, w->sv * WIDTH, (double *)s);
        if (second == SECOND) second_shape(dim, b, p, count, frame, n, w->sv, w->raw, s);
        if (w->shaped > 1) find_curved(dim, b, p, count, n, w->sv, l, &w->boxes);
    }
}

/* What the kernels read of LANES points from `start` on, of which `lanes_from` are real: z and the state; and where
 * tangents are summed, shapes of each. */
INLINE void gather_lanes(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                         const double *x, int64_t start, int64_t *group, int64_t *group_of, Work *w)
{
    const int nz = unknowns_of(dim, rot, second), lanes = lanes_from(b, start), filled = kernels->box_axes != NULL;
    const int curved = second == SECOND || filled;
    BoxWork *boxes = &w->boxes;
    lanes_t *in = (lanes_t *)w->in, *state = in + nz, *before = state + b->nstate + b->nparam;
    for (int l = 0; l < LANES; ++l) {
        while (start + l >= b->offsets[*group + 1] && l < lanes) ++*group;
        group_of[l] = *group;
    }
    if (w->shaped) find_shapes(dim, second, b, start, group_of, w);
    rows_to_lanes(b->state, start, lanes, b->nstate, state);
    rows_to_lanes(b->weights, start, lanes, dim * b->orders * b->slots, w->weights);
    if (w->gathered != group_of[0] || w->gathered != group_of[LANES - 1]) {
        pad_groups(dim + rot, b, group_of, x, w->room, w->nodal);
        if (kernels->before) pad_groups(dim + rot, b, group_of, kernels->before, w->room, w->nodal_before);
        w->gathered = group_of[0] == group_of[LANES - 1] ? group_of[0] : -1;
    }
    if (filled) {
        find_axes(dim, kernels, start, lanes, boxes);
        find_along(dim, (const double *)state, boxes);
    }
    derive_lanes(b, curved, w->weights, w->nodal, w->rows);
    put_rows(dim, rot, second, curved, w->rows, state, in);
    if (filled) {
        take_curved(dim, rot, w->rows, boxes->h);
        find_zk(dim, rot, second, kernels, start, lanes, w->in, boxes->h, boxes, boxes->zk);
        find_arched(dim, rot, second, boxes->h, boxes, boxes->arched);
    }
    if (!kernels->before) return;
    derive_lanes(b, curved, w->weights, w->nodal_before, w->rows);
    put_rows(dim, rot, second, curved, w->rows, state, before);
    if (filled) {
        take_curved(dim, rot, w->rows, boxes->h_before);
        find_zk(dim, rot, second, kernels, start, lanes, (const double *)before, boxes->h_before, boxes, boxes->before);
        find_arched(dim, rot, second, boxes->h_before, boxes, boxes->arched_before);
    }
}

SPECIALISED(gather_lanes, (const Batch *b, const PointKernels *kernels, const double *x, int64_t start, int64_t *group,
            int64_t *group_of, Work *w), b, kernels, x, start, group, group_of, w)

/* Evaluate LANES points from `start` on, and their boxes. */
INLINE void evaluate(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                     const double *x, int64_t start, int64_t *group, int64_t *group_of, Work *w, int *coupled)
{
    const int turn = value_slot(dim, rot, dim);  /* rotations in z; couples do work in space only */
    const int lanes = lanes_from(b, start);
    int open = 0;
    *coupled = 0;
    gather_lanes_sized(b, kernels, x, start, group, group_of, w);
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

/* What the virtual work of LANES points multiplies, times their volumes, [nz]; gradients in the points' frames. */
INLINE void lane_residuals(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Work *w,
                           int64_t start, int coupled, int tangent, lanes_t *r)
{
    const int nz = unknowns_of(dim, rot, second), turn = value_slot(dim, rot, dim), lanes = lanes_from(b, start);
    const lanes_t *out = (const lanes_t *)w->out, *initial = (const lanes_t *)w->iout, *couples = (const lanes_t *)w->cout;
    lanes_t volume = {0}, share = {0};
    for (int l = 0; l < lanes; ++l) volume[l] = b->volume[start + l];
    for (int k = 0; k < nz; ++k) r[k] = volume * out[k];
    for (int l = 0; kernels->returned_of && l < lanes; ++l) {
        const int64_t row = kernels->returned_of[start + l];
        for (int k = 0; row >= 0 && k < nz; ++k) r[k][l] = volume[l] * kernels->returned[row * (nz + (tangent ? nz * nz : 0)) + k];
    }
    for (int k = 0; kernels->initial && k < nz; ++k) r[k] += volume * initial[k];
    for (int k = 0; coupled && k < SPIN; ++k) r[turn + k] += couples[k];
    if (!kernels->box_kernel) return;
    for (int l = 0; l < lanes; ++l) share[l] = kernels->box_share[start + l];
    share *= volume / 6.0;
    add_sides(dim, rot, second, &w->boxes, &share, r);
}

INLINE void gather(const int dim, const int rot, const int second, const Batch *b, const double *x, int32_t framed,
                   double *z, double *value, Work *w)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), curved = second == SECOND;
    const PointKernels none = {0};
    int64_t group = 0, group_of[LANES];
    lanes_t own[UNKNOWNS_MAX], values[2 * SPIN], identity[3 * 3 + 3 * PAIRS] = {{0}};
    for (int d = 0; d < dim; ++d) identity[d * dim + d] += 1.0;
    for (int64_t start = 0; start < b->npoints; start += LANES) {
        const int lanes = lanes_from(b, start);
        gather_lanes_sized(b, &none, x, start, &group, group_of, w);
        if (!framed) put_rows(dim, rot, second, curved, w->rows, identity, own);
        lanes_to_rows(framed ? (const lanes_t *)w->in : own, nz, lanes, nz, z + start * nz);
        for (int i = 0; value && i < nb; ++i) values[i] = w->rows[i * rows_of(dim, curved)];
        if (value) lanes_to_rows(values, nb, lanes, nb, value + start * nb);
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

/* Called, not compiled into each of the loops: they take minutes to compile. */
INLINE void sum_tangents(const int dim, const int rot, const int second, const Batch *b, int symmetric, int points, int first, int n,
                         Moduli m, const vec *s, const Work *w)
{
    add_tangents(dim, rot, second, 0, (n + WIDTH - 1) / WIDTH, symmetric, points, first, n, m, s, NULL, w->sv, w->packed, w->K);
}

SPECIALISED(sum_tangents, (const Batch *b, int symmetric, int points, int first, int n, Moduli m, const vec *s, const Work *w), b,
            symmetric, points, first, n, m, s, w)

/* Points l .. end of these lanes, all of group g: their tangents into the group's sums. */
INLINE void add_points(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                       const Matrix *M, const Work *w, int64_t start, int64_t g, int l, int end, int coupled)
{
    const Moduli m = find_moduli(dim, rot, second, b, kernels, w, start, l, end, coupled);
    sum_tangents_sized(b, M->half, end - l, start + l == b->offsets[g], nodes_of(b, g), m, w->shapes + l * shapes_of(second) * w->sv, w);
}

/* Nodal forces of LANES points, from what the kernels have given. */
INLINE void find_forces(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, int64_t start,
                        int coupled, int tangent, const Work *w)
{
    const int curved = second == SECOND || kernels->box_kernel;
    const lanes_t *frame = (const lanes_t *)w->in + unknowns_of(dim, rot, second);
    lanes_t r[UNKNOWNS_MAX];
    if (kernels->box_kernel) collect_sides(dim, rot, second, kernels, &w->boxes);
    lane_residuals(dim, rot, second, b, kernels, w, start, coupled, tangent, r);
    take_rows(dim, rot, second, curved, r, kernels->box_kernel ? w->boxes.bent : NULL, frame, w->rows);
    spread_lanes(b, curved, w->weights, w->rows, w->forces);
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
        find_forces(dim, rot, second, b, kernels, start, coupled, M != NULL, w);
        for (int l = 0, end; l < lanes; l = end) {
            const int64_t g = group_of[l];
            const int n = nodes_of(b, g);
            for (end = l + 1; end < lanes && group_of[end] == g; ++end) {}
            add_lanes(w->forces, nb * padded_nodes(b), l, end, start + l == b->offsets[g], w->sums);
            if (dim == 3 && M && start + end >= b->offsets[g + 1]) prefetch_rows(dim, b, M, g, nb, n, w->at);
            if (M) add_points(dim, rot, second, b, kernels, M, w, start, g, l, end, coupled);
            if (start + end < b->offsets[g + 1]) continue;
            flush_lanes(nb, b, g, w->sums, force);
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

/* The tangent of the boxes of points l .. end of these lanes, all of group g, into the group's sums: what `find_whole` has
 * found. */
INLINE void add_whole(const int dim, const int rot, const int second, const Batch *b, const Matrix *M, const Work *w, int first, int64_t g,
                      int l, int end)
{
    const BoxWork *boxes = &w->boxes;
    const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH, sv = w->sv;
    const Moduli m = {(const double *)boxes->whole + l, NULL, boxes->at, 1};
    add_tangents(dim, rot, second, 1, nv, M->half, end - l, first, n, m, w->shapes + l * shapes_of(second) * sv,
                 boxes->curved + l * PAIRS * sv, sv, w->packed, w->K);
}

/* The same while the sides have the moduli of the points: sum_k B_k^T A B_k / 3. */
INLINE void add_alike(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Matrix *M,
                      const Work *w, int first, int64_t start, int64_t g, int l, int end)
{
    const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH, nz = unknowns_of(dim, rot, second), sv = w->sv;
    const int64_t size = (int64_t)shapes_of(second) * sv;
    double weight[LANES];
    for (int q = l; q < end; ++q) {
        weight[q - l] = b->volume[start + q] * kernels->box_share[start + q] / 3.0;
        side_shapes(dim, rot, second, kernels, nv, sv, w->shapes + q * size, q, &w->boxes);
    }
    const Moduli m = {w->out + nz * LANES + l, weight, w->upper, 1};
    for (int k = 0; k < dim; ++k, first = 0)
        sum_tangents_sized(b, M->half, end - l, first, n, m, w->boxes.sides + (k * LANES + l) * size, w);
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
            lanes_t weight = {0};
            for (int l = 0; l < lanes; ++l) weight[l] = b->volume[start + l] * kernels->box_share[start + l] / 6.0;
            find_whole(dim, rot, second, kernels, w->out, &weight, &w->boxes);
        }
        for (int l = 0, end; l < lanes; l = end) {
            const int64_t g = group_of[l];
            for (end = l + 1; end < lanes && group_of[end] == g; ++end) {}
            if (lift_only && !lifted[l]) continue;
            const int first = start + l == b->offsets[g];
            if (large) add_whole(dim, rot, second, b, M, w, first, g, l, end);
            else add_alike(dim, rot, second, b, kernels, M, w, first, start, g, l, end);
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
    w.shaped = 2;
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
        gather_lanes_sized(b, kernels, x, start, &group, group_of, w);
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

/* What a kernel (z, state, param) -> outputs gives at the points, and what their boxes add: to it, weight (sum_k [R(z + z_k)
 * + R(z - z_k)] - 2 dim R(z)), and times the derivatives along the half axes, weight [R(z + z_k) - R(z - z_k)].
 * frames [row][dim][dim][dim]: what the first entries of the state change by along the half axes, or NULL.
 * here, even [row][nout], odd [row][dim][nout] or NULL. Returns nonzero when memory ran out. */
FAST int polarmpm_box_means(kernel_t kernel, int64_t rows, int32_t dim, int32_t nz, int32_t nstate, int32_t nparam,
                            const double *z, const double *zk, const double *state, const double *frames, const double *param,
                            const double *weight, int32_t nout, double *here, double *even, double *odd)
{
    double *in = vectors((size_t)(nz + nstate + nparam) * LANES), *out = vectors((size_t)nout * LANES);
    double *up = vectors((size_t)nout * LANES), *down = vectors((size_t)nout * LANES), *sums = vectors((size_t)nout * LANES);
    const int failed = !(in && out && up && down && sums);
    for (int k = 0; k < nparam && !failed; ++k)
        for (int l = 0; l < LANES; ++l) in[(nz + nstate + k) * LANES + l] = param[k];
    for (int64_t start = 0; start < rows && !failed; start += LANES) {
        const int lanes = (int)(rows - start < LANES ? rows - start : LANES);
        int64_t of[LANES];
        for (int l = 0; l < LANES; ++l) {
            of[l] = start + (l < lanes ? l : lanes - 1);
            for (int k = 0; k < nz; ++k) in[k * LANES + l] = z[of[l] * nz + k];
            for (int k = 0; k < nstate; ++k) in[(nz + k) * LANES + l] = state[of[l] * nstate + k];
        }
        kernel(in, out);
        for (int k = 0; k < nout * LANES; ++k) sums[k] = -2.0 * dim * out[k];
        for (int s = 0; s < dim; ++s) {
            for (int sign = 1; sign > -2; sign -= 2) {
                for (int l = 0; l < LANES; ++l)
                    for (int k = 0; k < nz; ++k)
                        in[k * LANES + l] = z[of[l] * nz + k] + sign * zk[(of[l] * dim + s) * nz + k];
                for (int l = 0; frames && l < LANES; ++l)
                    for (int k = 0; k < dim * dim; ++k)
                        in[(nz + k) * LANES + l] = state[of[l] * nstate + k] + sign * frames[(of[l] * dim + s) * dim * dim + k];
                kernel(in, sign > 0 ? up : down);
            }
            for (int l = 0; frames && l < LANES; ++l)
                for (int k = 0; k < dim * dim; ++k) in[(nz + k) * LANES + l] = state[of[l] * nstate + k];
            for (int k = 0; k < nout * LANES; ++k) sums[k] += up[k] + down[k];
            for (int l = 0; odd && l < lanes; ++l)
                for (int k = 0; k < nout; ++k)
                    odd[(of[l] * dim + s) * nout + k] = weight[of[l]] * (up[k * LANES + l] - down[k * LANES + l]);
        }
        for (int l = 0; l < lanes; ++l)
            for (int k = 0; k < nout; ++k) {
                here[of[l] * nout + k] = out[k * LANES + l];
                even[of[l] * nout + k] = weight[of[l]] * sums[k * LANES + l];
            }
    }
    free(in), free(out), free(up), free(down), free(sums);
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

#include "_moments.h"
#include "_measures.h"

SIZE_OF(Batch);
SIZE_OF(Matrix);
SIZE_OF(PointKernels);

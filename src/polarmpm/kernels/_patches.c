/* Sums over the points of patches: scalars of which few functions a patch stand for the points' own values
 * (assembly/patches.py).
 *
 * A patch has `modes` vectors of its nodes for each kind of derivative, [patch][mode][component][node]; a mode is one of
 * its functions times one of the points' scalars. */
#include "_work.h"

INLINE void sum_moments(const int functions, const int nc, const int32_t *patch, int64_t npoints, const double *volume,
                        const double *phi, const double *values, double *out)
{
    for (int64_t p = 0, end; p < npoints; p = end) {  /* points of a patch mostly stand one after the other */
        double *sums = out + (int64_t)patch[p] * functions * nc;
        for (end = p; end < npoints && patch[end] == patch[p]; ++end, values += nc, phi += functions)
            for (int a = 0; a < functions; ++a) {
                const double weight = volume[end] * phi[a];
                for (int c = 0; c < nc; ++c) sums[a * nc + c] += weight * values[c];
            }
    }
}

/* Sums over the points of each patch, out [patch][function][c] += V0 phi values [point][c], with the patches' functions or
 * others phi [point][functions]. */
void polarmpm_patch_moments(const Patches *P, int64_t npoints, int32_t functions, const double *volume, const double *phi,
                            int32_t nc, const double *values, double *out)
{
    if (functions == 1 && nc == 1) sum_moments(1, 1, P->patch, npoints, volume, phi, values, out);
    else if (functions == 3 && nc == 1) sum_moments(3, 1, P->patch, npoints, volume, phi, values, out);
    else sum_moments(functions, nc, P->patch, npoints, volume, phi, values, out);
}

INLINE void evaluate_functions(const int functions, const int nc, const int32_t *patch, int64_t npoints, const double *phi,
                               const double *factors, double *out)
{
    for (int64_t p = 0; p < npoints; ++p, out += nc, phi += functions) {
        const double *from = factors + (int64_t)patch[p] * functions * nc;
        for (int c = 0; c < nc; ++c) {
            double sum = phi[0] * from[c];
            for (int a = 1; a < functions; ++a) sum += phi[a] * from[a * nc + c];
            out[c] = sum;
        }
    }
}

/* out [point][c] = sum of functions phi [point][functions] times factors [patch][function][c]. */
void polarmpm_patch_values(const Patches *P, int64_t npoints, int32_t functions, const double *phi, int32_t nc,
                           const double *factors, double *out)
{
    if (functions == 1 && nc == 1) evaluate_functions(1, 1, P->patch, npoints, phi, factors, out);
    else if (functions == 3 && nc == 1) evaluate_functions(3, 1, P->patch, npoints, phi, factors, out);
    else evaluate_functions(functions, nc, P->patch, npoints, phi, factors, out);
}

INLINE void sum_matrices(const int functions, const int m, const Patches *P, int64_t npoints, const double *volume,
                         const double *matrices, double *out)
{
    const int modes = functions * m;
    for (int64_t p = 0; p < npoints; ++p, matrices += m * m) {
        const double *phi = P->values + p * functions;
        double *to = out + (int64_t)P->patch[p] * modes * modes;
        for (int a = 0; a < functions; ++a)
            for (int c = 0; c < m; ++c)
                for (int e = 0; e < functions; ++e)
                    for (int d = 0; d < m; ++d)
                        to[(a * m + c) * modes + e * m + d] += volume[p] * phi[a] * phi[e] * matrices[c * m + d];
    }
}

/* Sums over the points of each patch, out [patch][mode][mode] += V0 phi_a phi_b M, of matrices M [point][scalar][scalar]. */
void polarmpm_patch_matrices(const Patches *P, int64_t npoints, const double *volume, const double *matrices, double *out)
{
    if (P->functions == 1 && P->scalars == 1) sum_matrices(1, 1, P, npoints, volume, matrices, out);
    else if (P->functions == 3 && P->scalars == 1) sum_matrices(3, 1, P, npoints, volume, matrices, out);
    else sum_matrices(P->functions, P->scalars, P, npoints, volume, matrices, out);
}

/* Adds the sums of points that share a group and a patch, [kind][mode][component and padded node, to `size`], to the
 * patch's vectors. */
INLINE void flush_modes(const int nb, const Batch *b, const Patches *P, int32_t kinds, int64_t g, int64_t p, int size,
                        const double *sums, double *out)
{
    const int64_t patch = P->patch[p], first = P->offsets[patch], nodes = P->offsets[patch + 1] - first;
    const int64_t length = P->offsets[P->npatches] * nb * P->modes;
    const int32_t *c = b->count + g * b->dim;
    const int m = b->slots, all = padded_nodes(b), last = b->dim == 3 ? c[2] : 1;
    for (int kind = 0; kind < kinds; ++kind) {
        double *mode = out + kind * length + first * nb * P->modes;
        for (int k = 0; k < P->modes; ++k, sums += size)
            for (int n = 0; n < nb; ++n, mode += nodes) {
                const int32_t *map = P->maps + P->map_of[p];
                for (int i = 0; i < c[0]; ++i)
                    for (int j = 0; j < c[1]; ++j) {
                        const double *from = sums + n * all + (b->dim == 3 ? (i * m + j) * m : i * m + j);
                        for (int q = 0; q < last; ++q) mode[*map++] += from[q];
                    }
            }
    }
}

/* Nodal forces of LANES points of which this does work on z, of the point's scalar c, in rows [lane][size]. */
INLINE void mode_forces(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                        int64_t start, int lanes, const double *work, int64_t step, const double *sides, const double *bent,
                        int64_t axes, const lanes_t *frame, int size, double *rows, Work *w)
{
    const int nz = unknowns_of(dim, rot, second), curved = sides != NULL;
    BoxWork *boxes = &w->boxes;
    lanes_t own[UNKNOWNS_MAX], *r = curved ? (lanes_t *)boxes->sums : own;
    steps_to_lanes(work, start, lanes, step, nz, r);
    if (curved) {
        for (int k = 0; k < dim; ++k) {
            steps_to_lanes(sides + k * axes * nz, start, lanes, dim * axes * nz, nz, r + (1 + k) * nz);
            if (second == AXIAL)
                steps_to_lanes(bent + k * axes * BENT, start, lanes, dim * axes * BENT, BENT, boxes->both + k * BENT);
        }
        collect_sides(dim, rot, second, kernels, boxes);
    }
    take_rows(dim, rot, second, curved, r, curved ? boxes->bent : NULL, frame, w->rows);
    spread_lanes(b, curved, w->weights, w->rows, w->forces);
    lanes_to_rows(w->forces, (dim + rot) * padded_nodes(b), lanes, size, rows);
}

/* Adds the rows of lanes l .. end, times V0 phi_a, to the sums of each function; `first`: to nothing. */
INLINE void add_modes(const Batch *b, const Patches *P, int32_t kinds, int64_t start, int l, int end, int first, int size,
                      const double *rows, double *sums)
{
    for (int kind = 0; kind < kinds; ++kind)
        for (int c = 0; c < P->scalars; ++c, rows += LANES * size)
            for (int a = 0; a < P->functions; ++a) {
                vec *sum = (vec *)(sums + (int64_t)(kind * P->modes + a * P->scalars + c) * size);
                double weight[LANES];
                for (int q = l; q < end; ++q) weight[q] = b->volume[start + q] * P->values[(start + q) * P->functions + a];
                for (int v = 0; v < size / WIDTH; ++v) {
                    vec total = first ? (vec){0} : sum[v];
                    for (int q = l; q < end; ++q) total += weight[q] * ((const vec *)(rows + q * size))[v];
                    sum[v] = total;
                }
            }
}

/* Residuals of the points' scalars, per volume: out += V0 phi_a B^T work, for function a and scalar c as mode
 * a scalars + c, of several kinds of work, each [point][step], of which the first are [scalar][z]. `sides`: the same at the
 * derivatives along the half axes of the points' boxes, [kind][point][axis][scalar][z], or NULL; `bent`: at the values'
 * quadratic parts, of bodies of revolution, [kind][point][axis][scalar][BENT]. */
INLINE void sum_patches(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Patches *P,
                        int32_t kinds, const double *const *work, const int64_t *step, const double *sides, const double *bent,
                        double *out, int size, double *rows, double *sums, Work *w)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), m = P->scalars;
    lanes_t *frame = (lanes_t *)w->in;
    int64_t group = 0, group_of[LANES];
    int first = 1;
    for (int64_t start = 0; start < b->npoints; start += LANES) {
        const int lanes = lanes_from(b, start);
        for (int l = 0; l < lanes; ++l) {
            while (start + l >= b->offsets[group + 1]) ++group;
            group_of[l] = group;
        }
        steps_to_lanes(b->state, start, lanes, b->nstate, dim * dim, frame);
        rows_to_lanes(b->weights, start, lanes, dim * b->orders * b->slots, w->weights);
        if (sides) {
            find_axes(dim, kernels, start, lanes, &w->boxes);
            find_along(dim, (const double *)frame, &w->boxes);
        }
        for (int kind = 0; kind < kinds; ++kind)
            for (int c = 0; c < m; ++c) {
                const int64_t at = kind * b->npoints * dim * m + c;
                mode_forces(dim, rot, second, b, kernels, start, lanes, work[kind] + c * nz, step[kind],
                            sides ? sides + at * nz : NULL, bent ? bent + at * BENT : NULL, m, frame, size,
                            rows + (int64_t)(kind * m + c) * LANES * size, w);
            }
        for (int l = 0, end; l < lanes; l = end) {
            const int64_t g = group_of[l], patch = P->patch[start + l];
            for (end = l + 1; end < lanes && group_of[end] == g && P->patch[start + end] == patch; ++end) {}
            add_modes(b, P, kinds, start, l, end, first, size, rows, sums);
            first = start + end == b->offsets[g + 1] || P->patch[start + end] != patch;
            if (first) flush_modes(nb, b, P, kinds, g, start + l, size, sums, out);
        }
    }
}

SPECIALISED_PLAIN(sum_patches, (const Batch *b, const PointKernels *kernels, const Patches *P, int32_t kinds,
                  const double *const *work, const int64_t *step, const double *sides, const double *bent, double *out, int size,
                  double *rows, double *sums, Work *w), b, kernels, P, kinds, work, step, sides, bent, out, size, rows, sums, w)

/* Vectors of the patches' modes [kind][patch], see sum_patches; returns nonzero when memory ran out. */
int polarmpm_patch_vectors(const Batch *b, const PointKernels *kernels, const Patches *P, int32_t kinds, const double *const *work,
                           const int64_t *step, const double *sides, const double *bent, double *out)
{
    if (b->npoints == 0) return 0;
    const int size = (block_size(b) * padded_nodes(b) + WIDTH - 1) / WIDTH * WIDTH;
    Work w;
    int failed = create_work(b, 0, 1, sides != NULL, &w);
    double *rows = vectors((size_t)kinds * P->scalars * LANES * size), *sums = vectors((size_t)kinds * P->modes * size);
    failed |= !rows || !sums;
    if (!failed) sum_patches_sized(b, kernels, P, kinds, work, step, sides, bent, out, size, rows, sums, &w);
    free(rows), free(sums);
    free_work(&w);
    return failed;
}

/* force[node] += sum of the patches' vectors times factors [patch][mode]. */
void polarmpm_patch_forces(const Patches *P, int32_t nb, const double *vectors_of, const double *factor, double *force)
{
    for (int64_t p = 0; p < P->npatches; ++p) {
        const int64_t first = P->offsets[p], n = P->offsets[p + 1] - first;
        const double *v = vectors_of + first * nb * P->modes;
        for (int k = 0; k < P->modes; ++k)
            for (int i = 0; i < nb; ++i, v += n)
                for (int64_t q = 0; q < n; ++q)
                    force[(int64_t)P->nodes[first + q] * nb + i] += factor[p * P->modes + k] * v[q];
    }
}

/* out [patch][mode] = the patches' vectors times nodal values x. */
void polarmpm_patch_products(const Patches *P, int32_t nb, const double *vectors_of, const double *x, double *out)
{
    for (int64_t p = 0; p < P->npatches; ++p) {
        const int64_t first = P->offsets[p], n = P->offsets[p + 1] - first;
        const double *v = vectors_of + first * nb * P->modes;
        for (int k = 0; k < P->modes; ++k) {
            double sum = 0.0;
            for (int i = 0; i < nb; ++i, v += n)
                for (int64_t q = 0; q < n; ++q) sum += v[q] * x[(int64_t)P->nodes[first + q] * nb + i];
            out[p * P->modes + k] = sum;
        }
    }
}

/* Marks which lattice neighbours share a patch with each node, as polarmpm_couple_nodes does of groups. */
void polarmpm_couple_patches(const Patches *P, int32_t dim, int32_t reach, uint8_t *mark)
{
    const int side = 2 * reach + 1, codes = dim == 3 ? side * side * side : side * side;
    for (int64_t p = 0; p < P->npatches; ++p)
        for (int64_t a = P->offsets[p]; a < P->offsets[p + 1]; ++a)
            for (int64_t q = P->offsets[p]; q < P->offsets[p + 1]; ++q)
                mark[(int64_t)P->nodes[a] * codes + P->codes[q] - P->codes[a] + codes / 2] = 1;
}

/* Vectors of a patch's modes, of n nodes, side by side: [mode][component][nv]. */
INLINE void pad_modes(int rows, int n, int nv, const double *from, vec *out)
{
    for (int k = 0; k < rows; ++k, from += n, out += nv) {
        out[nv - 1] = (vec){0};
        memcpy(out, from, sizeof(double) * n);
    }
}

/* K [node][i][j][nv] = sum over the modes of g b^T + b h^T; with `half` not left of the diagonal's vectors. */
INLINE void multiply_modes(const int nb, int modes, int n, int nv, int half, const vec *b, const vec *g, const vec *h, vec *K)
{
    const int64_t mode = (int64_t)nb * nv;
    for (int a = 0; a < n; ++a)
        for (int i = 0; i < nb; ++i)
            for (int j = 0; j < nb; ++j, K += nv)
                for (int v = half ? a / WIDTH : 0; v < nv; ++v) {
                    vec sum = {0};
                    for (int k = 0; k < modes; ++k) {
                        const int64_t row = k * mode + i * nv, column = k * mode + j * nv + v;
                        sum += ((const double *)(g + row))[a] * b[column] + ((const double *)(b + row))[a] * h[column];
                    }
                    K[v] = sum;
                }
}

INLINE void add_patches(const int dim, const int nb, const Patches *P, const double *b, const double *g, const double *h,
                        const Matrix *M, double *rhs, int most, vec *room, Place *at)
{
    const int64_t size = (int64_t)P->modes * nb * most;
    vec *bs = room, *gs = bs + size, *hs = gs + size, *K = hs + size;
    for (int64_t p = 0; p < P->npatches; ++p) {
        const int64_t first = P->offsets[p], block = first * nb * P->modes;
        const int n = (int)(P->offsets[p + 1] - first), nv = (n + WIDTH - 1) / WIDTH, rows = P->modes * nb;
        pad_modes(rows, n, nv, b + block, bs);
        pad_modes(rows, n, nv, g + block, gs);
        pad_modes(rows, n, nv, h + block, hs);
        multiply_modes(nb, P->modes, n, nv, M->half, bs, gs, hs, K);
        for (int q = 0; q < n; ++q) at[q].code = P->codes[first + q];
        flush_nodes(dim, M, P->nodes + first, nb, n, nv, (double *)K, at, rhs);
    }
}

#define OF_BLOCKS(name, dim, nb)                                                                                      \
    FAST static __attribute__((noinline)) void name(const Patches *P, const double *b, const double *g, const double *h, \
                                                    const Matrix *M, double *rhs, int most, vec *room, Place *at)      \
    {                                                                                                                 \
        add_patches(dim, nb, P, b, g, h, M, rhs, most, room, at);                                                     \
    }

OF_BLOCKS(add_patches_22, 2, 2)
OF_BLOCKS(add_patches_23, 2, 3)
OF_BLOCKS(add_patches_33, 3, 3)
OF_BLOCKS(add_patches_36, 3, 6)

/* Adds sum over the modes of g b^T + b h^T of each patch to the matrix. `rhs` as in polarmpm_assemble. Returns nonzero
 * when memory ran out. */
int polarmpm_add_patches(const Patches *P, int32_t dim, int32_t nb, const double *b, const double *g, const double *h,
                         const Matrix *M, double *rhs)
{
    int64_t most = 0;
    for (int64_t p = 0; p < P->npatches; ++p)
        if (P->offsets[p + 1] - P->offsets[p] > most) most = P->offsets[p + 1] - P->offsets[p];
    if (!most) return 0;
    const int nv = (int)(most + WIDTH - 1) / WIDTH;
    vec *room = vectors((size_t)(3 * P->modes * nb + most * nb * nb) * nv * WIDTH);
    Place *at = malloc(sizeof(Place) * most);
    const int failed = !room || !at;
    if (!failed)
        (dim == 3 ? nb == 3 ? add_patches_33 : add_patches_36 : nb == 2 ? add_patches_22 : add_patches_23)(P, b, g, h, M, rhs, nv, room, at);
    free(room), free(at);
    return failed;
}

SIZE_OF(Patches);

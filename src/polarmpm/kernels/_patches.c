/* Sums over the points of patches: scalars of which few functions a patch stand for the points' own values
 * (assembly/patches.py).
 *
 * A patch has `modes` vectors of its nodes for each kind of derivative, [patch][mode][component][node]; a mode is one of
 * its functions times one of the points' scalars. */
#include "_work.h"

/* Adds the sums of points that share a group and a patch, [kind][mode][component][sv], to the patch's vectors. */
INLINE void flush_modes(const int nb, const Patches *P, int32_t kinds, int64_t p, int n, int sv, const vec *sums, double *out)
{
    const int64_t patch = P->patch[p], first = P->offsets[patch], size = P->offsets[patch + 1] - first;
    const int64_t length = P->offsets[P->npatches] * nb * P->modes;
    const int32_t *map = P->maps + P->map_of[p];
    for (int kind = 0; kind < kinds; ++kind) {
        double *mode = out + kind * length + first * nb * P->modes;
        for (int k = 0; k < P->modes * nb; ++k, mode += size, sums += sv)
            for (int q = 0; q < n; ++q) mode[map[q]] += ((const double *)sums)[q];
    }
}

/* Residuals of the points' scalars, per volume: out += V0 phi_a B^T work, for function a and scalar c as mode
 * a scalars + c, of several kinds of work, [kind][point][scalar][z]. `sides`: the same at the derivatives along the half
 * axes of the points' boxes, [kind][point][axis][scalar][z], or NULL; `bent`: at the values' quadratic parts, of bodies of
 * revolution. */
INLINE void sum_patches(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Patches *P,
                        int32_t kinds, const double *work, const double *sides, const double *bent, double *out, vec *sums, Work *w)
{
    const int nb = dim + rot, nz = unknowns_of(dim, rot, second), sv = w->sv, stride = sv * WIDTH;
    for (int64_t g = 0; g < b->ngroups; ++g) {
        const int n = nodes_of(b, g), nv = (n + WIDTH - 1) / WIDTH;
        const int32_t *count = b->count + g * dim;
        for (int64_t p = b->offsets[g], end = b->offsets[g + 1]; p < end; ++p) {
            if (p == b->offsets[g] || P->patch[p] != P->patch[p - 1])
                memset(sums, 0, sizeof(vec) * kinds * P->modes * nb * sv);
            shape(dim, b, p, count, b->state + p * b->nstate, stride, (double *)w->shapes);
            if (sides) {
                find_axes(dim, kernels, p, 1, &w->boxes);
                find_curved(dim, b, p, count, n, sv, 0, &w->boxes);
                for (int k = 0; k < dim * dim; ++k) w->in[k * LANES] = b->state[p * b->nstate + k];
                find_along(dim, w->in, &w->boxes);
                side_shapes(dim, rot, second, kernels, nv, sv, w->shapes, 0, &w->boxes);
            }
            for (int kind = 0; kind < kinds; ++kind)
                for (int c = 0; c < P->scalars; ++c) {
                    const int64_t row = kind * b->npoints + p, lowest = kind * P->modes + c;
                    memset(w->f, 0, sizeof(vec) * nb * sv);
                    add_residual(dim, rot, second, nv, sv, w->shapes, work + (row * P->scalars + c) * nz, w->f);
                    for (int k = 0; sides && k < dim; ++k) {
                        const vec *side = w->boxes.sides + (int64_t)k * LANES * SHAPES * sv;
                        const int64_t at = (row * dim + k) * P->scalars + c;
                        add_residual(dim, rot, second, nv, sv, side, sides + at * nz, w->f);
                        add_arched(dim, rot, second, nv, sv, side, bent + at * BENT, w->f);
                    }
                    for (int a = 0; a < P->functions; ++a) {
                        const double weight = b->volume[p] * P->values[p * P->functions + a];
                        vec *sum = sums + (lowest + a * P->scalars) * nb * sv;
                        for (int i = 0; i < nb; ++i)
                            for (int v = 0; v < nv; ++v) sum[i * sv + v] += weight * w->f[i * sv + v];
                    }
                }
            if (p + 1 == end || P->patch[p + 1] != P->patch[p]) flush_modes(nb, P, kinds, p, n, sv, sums, out);
        }
    }
}

SPECIALISED_PLAIN(sum_patches, (const Batch *b, const PointKernels *kernels, const Patches *P, int32_t kinds, const double *work,
                  const double *sides, const double *bent, double *out, vec *sums, Work *w), b, kernels, P, kinds, work, sides, bent, out,
                  sums, w)

/* Vectors of the patches' modes [kind][patch], see sum_patches; returns nonzero when memory ran out. */
int polarmpm_patch_vectors(const Batch *b, const PointKernels *kernels, const Patches *P, int32_t kinds, const double *work,
                           const double *sides, const double *bent, double *out)
{
    if (b->npoints == 0) return 0;
    Work w;
    int failed = create_work(b, 0, 1, sides != NULL, &w);
    vec *sums = failed ? NULL : vectors((size_t)kinds * P->modes * block_size(b) * w.sv * WIDTH);
    failed |= !sums;
    if (!failed) sum_patches_sized(b, kernels, P, kinds, work, sides, bent, out, sums, &w);
    free(sums);
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

/* Adds sum over the modes of g b^T + b h^T of each patch to the matrix. `rhs` as in polarmpm_assemble. Returns nonzero
 * when memory ran out. */
FAST int polarmpm_add_patches(const Patches *P, int32_t dim, int32_t nb, const double *b, const double *g, const double *h,
                              const Matrix *M, double *rhs)
{
    int64_t most = 0;
    for (int64_t p = 0; p < P->npatches; ++p)
        if (P->offsets[p + 1] - P->offsets[p] > most) most = P->offsets[p + 1] - P->offsets[p];
    if (!most) return 0;
    const size_t stride = (most + WIDTH - 1) / WIDTH * WIDTH;
    double *K = vectors(most * nb * nb * stride);
    Place *at = malloc(sizeof(Place) * most);
    const int failed = !K || !at;
    for (int64_t p = 0; p < P->npatches && !failed; ++p) {
        const int64_t first = P->offsets[p], block = first * nb * P->modes;
        const int n = (int)(P->offsets[p + 1] - first), nv = (n + WIDTH - 1) / WIDTH;
        const int64_t cols = (int64_t)nv * WIDTH;
        memset(K, 0, sizeof(double) * n * nb * nb * cols);
        for (int k = 0; k < P->modes; ++k) {
            const double *bk = b + block + (int64_t)k * nb * n, *gk = g + block + (int64_t)k * nb * n;
            const double *hk = h + block + (int64_t)k * nb * n;
            for (int a = 0; a < n; ++a)
                for (int i = 0; i < nb; ++i) {
                    const double ga = gk[i * n + a], ba = bk[i * n + a];
                    for (int j = 0; j < nb; ++j) {
                        double *row = K + ((int64_t)(a * nb + i) * nb + j) * cols;
                        for (int q = M->half ? a : 0; q < n; ++q) row[q] += ga * bk[j * n + q] + ba * hk[j * n + q];
                    }
                }
        }
        for (int q = 0; q < n; ++q) at[q].code = P->codes[first + q];
        flush_nodes(dim, M, P->nodes + first, nb, n, nv, K, at, rhs);
    }
    free(K), free(at);
    return failed;
}

SIZE_OF(Patches);

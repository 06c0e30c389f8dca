/* Points' moments for the projection on a quadrature space (assembly/projection.py), which needs cells' own functions: no
 * point has second gradients then; a part of _native.c. */
#include "_points.h"

/* Work of gradients in a point's frame T -> work of gradients with respect to x~: r_ik = sum_j r_ij T_kj. */
INLINE void pull_back(const Batch *b, const double *frame, double *r, int step)
{
    const int dim = b->dim;
    for (int i = 0; i < block_size(b); ++i) {
        double *row = r + gradient_slot(dim, b->rot, i) * step, old[3] = {0};
        for (int j = 0; j < dim; ++j) old[j] = row[j * step];
        for (int k = 0; k < dim; ++k) {
            double sum = 0.0;
            for (int j = 0; j < dim; ++j) sum += old[j] * frame[k * dim + j];
            row[k * step] = sum;
        }
    }
}

/* What the virtual work of the points multiplies, times their volumes, for z of gradients with respect to x~:
 * residual [point][nz] and (unless NULL) tangent, [point][nz][nz], or its upper triangle where it is symmetric.
 * Returns nonzero when memory ran out. */
FAST int polarmpm_moments(const Batch *b, const PointKernels *kernels, const double *x, int32_t symmetric,
                          double *residual, double *tangent)
{
    if (b->npoints == 0) return 0;
    const int nz = unknowns_of(b->dim, b->rot, b->second), size = symmetric ? nz * (nz + 1) / 2 : nz * nz;
    Work w;
    const int failed = create_work(b, tangent != NULL, 0, 0, &w);
    int64_t group = 0, group_of[LANES];
    for (int64_t start = 0; start < b->npoints && !failed; start += LANES) {
        int coupled;
        const int lanes = lanes_from(b, start);
        evaluate_sized(b, kernels, x, start, &group, group_of, &w, &coupled);
        for (int l = 0; l < lanes; ++l) {
            const int64_t p = start + l;
            const double *frame = b->state + p * b->nstate;
            point_terms(b->dim, b->rot, b->second, b, kernels, &w, p, l, coupled, tangent != NULL, residual + p * nz);
            pull_back(b, frame, residual + p * nz, 1);
            if (!tangent) continue;
            point_moduli(b->dim, b->rot, b->second, b, kernels, &w, p, l, coupled, w.A);
            for (int i = 0; i < nz; ++i) pull_back(b, frame, w.A + i * nz, 1);
            for (int j = 0; j < nz; ++j) pull_back(b, frame, w.A + j, nz);
            double *out = tangent + p * size;
            for (int i = 0; i < nz; ++i)
                for (int j = symmetric ? i : 0; j < nz; ++j) *out++ = w.A[i * nz + j];
        }
    }
    free_work(&w);
    return failed;
}

/* out[place[point][k]][c] += weight[point][k] moments[point][c], for k < nk and c < nc. */
FAST void polarmpm_project(int64_t npoints, int32_t nk, int32_t nc, const int32_t *place, const double *weight,
                           const double *moments, double *out)
{
    for (int64_t p = 0; p < npoints; ++p)
        for (int k = 0; k < nk; ++k) {
            double *restrict row = out + (int64_t)place[p * nk + k] * nc;
            const double *restrict m = moments + p * nc;
            const double L = weight[p * nk + k];
            for (int c = 0; c < nc; ++c) row[c] += L * m[c];
        }
}

/* Add to sums over cells, [cell][1 + dim][1 + dim + parts], what fits of linear functions need: moments of volumes, and of
 * values [point][parts], with 1 and the place within the cell [point][dim]. */
void polarmpm_fit_sums(int64_t npoints, int32_t dim, int32_t parts, const int64_t *cell, const double *volume,
                       const double *within, const double *value, double *sums)
{
    const int na = dim + 1, nb = na + parts;
    for (int64_t p = 0; p < npoints; ++p) {
        double linear[4] = {1.0}, *to = sums + cell[p] * na * nb;
        for (int k = 0; k < dim; ++k) linear[1 + k] = within[p * dim + k];
        for (int a = 0; a < na; ++a, to += nb) {
            const double share = volume[p] * linear[a];
            for (int b = 0; b < na; ++b) to[b] += share * linear[b];
            for (int b = 0; b < parts; ++b) to[na + b] += share * value[p * parts + b];
        }
    }
}

/* At points the means of the functions `fitted` [node][1 + dim][parts] of their cells' corners, nodes `at`
 * [cell][2^dim]: `smooth` [point][parts]. */
void polarmpm_fit_values(int64_t npoints, int32_t dim, int32_t parts, const int64_t *cell, const double *within,
                         const int64_t *corner, const int64_t *at, const double *fitted, double *smooth)
{
    const int corners = 1 << dim;
    for (int64_t p = 0; p < npoints; ++p) {
        double *to = smooth + p * parts;
        for (int i = 0; i < parts; ++i) to[i] = 0.0;
        for (int c = 0; c < corners; ++c) {
            const double *f = fitted + at[cell[p] * corners + c] * (1 + dim) * parts;
            double share = 1.0;
            for (int k = 0; k < dim; ++k) {
                const double x = within[p * dim + k];
                share *= corner[c * dim + k] ? x : 1.0 - x;
            }
            for (int i = 0; i < parts; ++i) {
                double there = f[i];
                for (int k = 0; k < dim; ++k)
                    there += (within[p * dim + k] - (double)corner[c * dim + k]) * f[(1 + k) * parts + i];
                to[i] += share * there;
            }
        }
    }
}

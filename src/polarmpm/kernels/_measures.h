/* What Newton's method measures convergence by; a part of _native.c. */
#include "_points.h"

/* Sums over the unknowns [node][block] of a rank's own nodes: squares of out-of-balance forces, and of internal ones that
 * are to be balanced, both as forces; work of the former on the last correction (NULL: zero), and of the latter on the
 * increments; and the largest increment of components from `dim` on, which are rotations.
 * `balance`: out-of-balance forces where others act along with them; NULL: the residual, at unknowns that aren't fixed. */
void polarmpm_measures(int64_t nodes, int32_t block, int32_t dim, const double *residual, const double *balance,
                       const uint8_t *fixed, const double *external, const double *correction, const double *x,
                       const double *as_force, double *sums)
{
    double out = 0.0, loads = 0.0, work = 0.0, done = 0.0, most = 0.0;
    for (int64_t node = 0; node < nodes; ++node)
        for (int i = 0; i < block; ++i) {
            const int64_t k = node * block + i;
            const double r = balance ? balance[k] : fixed[k] ? 0.0 : residual[k], total = external[k] + (residual[k] - r);
            out += r * as_force[i] * (r * as_force[i]);
            loads += total * as_force[i] * (total * as_force[i]);
            done += total * x[k];
            if (correction) work += r * correction[k];
            if (i >= dim && fabs(x[k]) > most) most = fabs(x[k]);
        }
    sums[0] = out, sums[1] = loads, sums[2] = work, sums[3] = done, sums[4] = most;
}

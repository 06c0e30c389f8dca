/* Return mapping of points that yield (forms/returnmapping.py); the last part of _native.c.
 *
 * Local unknowns X solve r(X; inputs) = 0 by Newton's method with step halving, LANES points at a time. The
 * consistent tangent is ds/dz - ds/dX (dr/dX)^-1 dr/dz (implicit function theorem). All of the derivatives come
 * from compiled kernels (forms/plastic.py). */
#include "_points.h"

typedef struct {
    kernel_t local;            /* (inputs, X) -> r [nx], dr/dX [nx][nx] */
    kernel_t stress;           /* (inputs, X) -> s [nz] */
    kernel_t moduli;           /* (inputs, X) -> s [nz], ds/dz [nz][nz], ds/dX [nz][nx], dr/dz [nx][nz] */
    const double *row_scale;   /* [nx] factors that make residuals strains */
    double tolerance;          /* norm of the residual that is good enough */
    double loose;              /* norm that is accepted where rounding ends the iteration */
    int32_t nin, nx, nz, most; /* inputs without X, sizes, iterations allowed */
} Return;

enum { LOCAL_MAX = 24, DERIVED_MAX = UNKNOWNS_MAX + 4 };  /* unknowns, with projected scalars */

/* LU factors with partial pivoting in place; returns nonzero if a pivot vanishes. */
static int factor(int n, double *A, int *pivot)
{
    for (int k = 0; k < n; ++k) {
        int p = k;
        for (int i = k + 1; i < n; ++i)
            if (fabs(A[i * n + k]) > fabs(A[p * n + k])) p = i;
        pivot[k] = p;
        if (!(fabs(A[p * n + k]) > 0.0) || !isfinite(A[p * n + k])) return 1;
        if (p != k)
            for (int j = 0; j < n; ++j) {
                const double t = A[k * n + j];
                A[k * n + j] = A[p * n + j];
                A[p * n + j] = t;
            }
        for (int i = k + 1; i < n; ++i) {
            const double l = A[i * n + k] /= A[k * n + k];
            if (l != 0.0)
                for (int j = k + 1; j < n; ++j) A[i * n + j] -= l * A[k * n + j];
        }
    }
    return 0;
}

/* Solve for m right-hand sides B [n][m] in place. */
static void back_substitute(int n, const double *A, const int *pivot, int m, double *B)
{
    for (int k = 0; k < n; ++k) {
        const int p = pivot[k];
        if (p != k)
            for (int j = 0; j < m; ++j) {
                const double t = B[k * m + j];
                B[k * m + j] = B[p * m + j];
                B[p * m + j] = t;
            }
    }
    for (int k = 0; k < n; ++k)
        for (int i = k + 1; i < n; ++i) {
            const double l = A[i * n + k];
            if (l != 0.0)
                for (int j = 0; j < m; ++j) B[i * m + j] -= l * B[k * m + j];
        }
    for (int k = n - 1; k >= 0; --k) {
        const double inverse = 1.0 / A[k * n + k];
        for (int j = 0; j < m; ++j) B[k * m + j] *= inverse;
        for (int i = 0; i < k; ++i) {
            const double u = A[i * n + k];
            if (u != 0.0)
                for (int j = 0; j < m; ++j) B[i * m + j] -= u * B[k * m + j];
        }
    }
}

typedef struct {
    double X[LOCAL_MAX], step[LOCAL_MAX], norm, length;
    int iterations, done, failed;
} Local;

/* Scaled residual and matrix of a lane. */
static double read_lane(const Return *R, const double *out, int l, double *r, double *C)
{
    const int n = R->nx;
    double sum = 0.0;
    for (int i = 0; i < n; ++i) {
        r[i] = R->row_scale[i] * out[i * LANES + l];
        sum += r[i] * r[i];
        for (int j = 0; j < n; ++j) C[i * n + j] = R->row_scale[i] * out[(n + i * n + j) * LANES + l];
    }
    return sqrt(sum);
}

/* One iteration of a lane after an evaluation at its trial X; writes the next trial X to in. */
static void iterate(const Return *R, Local *p, const double *out, double *in, int l)
{
    const int n = R->nx;
    double r[LOCAL_MAX], C[LOCAL_MAX * LOCAL_MAX];
    int pivot[LOCAL_MAX];
    const double norm = read_lane(R, out, l, r, C);
    const int first = p->iterations == 0;
    double *x = in + (int64_t)R->nin * LANES + l;
    /* a long step must gain much: near the apex of a cone one that turns the flow round may gain a little */
    const double gain = p->length > 0.05 ? 0.5 : 1e-4;
    if (first || norm < (1.0 - gain * p->length) * p->norm) {
        for (int i = 0; i < n; ++i) p->X[i] = x[i * LANES];
        p->norm = norm;
        if (norm <= R->tolerance) {
            p->done = 1;
            return;
        }
        if (!isfinite(norm) || factor(n, C, pivot)) {
            p->done = p->failed = 1;
            return;
        }
        for (int i = 0; i < n; ++i) p->step[i] = -r[i];
        back_substitute(n, C, pivot, 1, p->step);
        p->length = 1.0;
    } else {
        p->length *= 0.5;
    }
    if (p->length < 1e-4 || ++p->iterations > R->most) {
        p->done = 1;
        p->failed = !(p->norm <= R->loose);
        for (int i = 0; i < n; ++i) x[i * LANES] = p->X[i];
        return;
    }
    for (int i = 0; i < n; ++i) x[i * LANES] = p->X[i] + p->length * p->step[i];
}

/* s and the consistent tangent of a lane; local and moduli were evaluated at its X. */
static int condense(const Return *R, const double *local, const double *moduli, int l, double *returned)
{
    const int nz = R->nz, n = R->nx;
    double r[LOCAL_MAX], C[LOCAL_MAX * LOCAL_MAX], T[LOCAL_MAX * DERIVED_MAX];
    int pivot[LOCAL_MAX];
    read_lane(R, local, l, r, C);
    const double *sz = moduli + nz * LANES + l, *sx = sz + nz * nz * LANES, *rz = sx + nz * n * LANES;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < nz; ++j) T[i * nz + j] = R->row_scale[i] * rz[(i * nz + j) * LANES];
    if (factor(n, C, pivot)) return 1;
    back_substitute(n, C, pivot, nz, T);
    for (int i = 0; i < nz; ++i) returned[i] = moduli[i * LANES + l];
    double *A = returned + nz;
    for (int i = 0; i < nz; ++i)
        for (int j = 0; j < nz; ++j) {
            double sum = sz[(i * nz + j) * LANES];
            for (int k = 0; k < n; ++k) sum -= sx[(i * n + k) * LANES] * T[k * nz + j];
            A[i * nz + j] = sum;
        }
    return 0;
}

/* Solve for X [point][nx] from its initial values, and write what is returned, [point][nz (+ nz nz with tangent)].
 * status: 0 solved, 1 not; iterations: evaluations of the local residual. Returns nonzero without memory. */
int polarmpm_return(const Return *R, int64_t npoints, const double *inputs, int32_t tangent, double *X,
                    double *returned, int8_t *status, int32_t *iterations)
{
    const int nin = R->nin, n = R->nx, nz = R->nz, size = nz + (tangent ? nz * nz : 0);
    if (n > LOCAL_MAX || nz > DERIVED_MAX) return 2;
    double *in = vectors((size_t)(nin + n) * LANES), *out = vectors((size_t)(n + n * n) * LANES);
    double *work = vectors((size_t)(nz + nz * nz + 2 * nz * n) * LANES);
    const int failed = !(in && out && work);
    for (int64_t start = 0; start < npoints && !failed; start += LANES) {
        const int lanes = (int)(npoints - start < LANES ? npoints - start : LANES);
        Local lane[LANES];
        for (int l = 0; l < LANES; ++l) {
            const int64_t p = start + (l < lanes ? l : lanes - 1);
            for (int k = 0; k < nin; ++k) in[k * LANES + l] = inputs[p * nin + k];
            for (int k = 0; k < n; ++k) in[(nin + k) * LANES + l] = X[p * n + k];
            lane[l] = (Local){.length = 1.0};
        }
        for (int open = 1; open;) {
            R->local(in, out);
            open = 0;
            for (int l = 0; l < lanes; ++l) {
                if (!lane[l].done) iterate(R, &lane[l], out, in, l);
                open |= !lane[l].done;
            }
        }
        R->local(in, out);     /* lanes that went back to an earlier X */
        if (tangent) R->moduli(in, work);
        else R->stress(in, work);
        for (int l = 0; l < lanes; ++l) {
            const int64_t p = start + l;
            double *own = returned + p * size;
            for (int k = 0; k < n; ++k) X[p * n + k] = lane[l].X[k];
            iterations[p] = lane[l].iterations;
            status[p] = (int8_t)lane[l].failed;
            if (lane[l].failed) continue;
            if (tangent) status[p] = (int8_t)condense(R, out, work, l, own);
            else
                for (int i = 0; i < nz; ++i) own[i] = work[i * LANES + l];
        }
    }
    free(in), free(out), free(work);
    return failed;
}

/* A kernel for rows of inputs, given in arrays of columns [row][width], -> [row][nout]. Returns nonzero without
 * memory. */
int polarmpm_evaluate(kernel_t kernel, int64_t rows, int32_t arrays, const int32_t *width, const double *const *array,
                      int32_t nout, double *outputs)
{
    int nin = 0;
    for (int b = 0; b < arrays; ++b) nin += width[b];
    double *in = vectors((size_t)nin * LANES), *out = vectors((size_t)nout * LANES);
    const int failed = !(in && out);
    for (int64_t start = 0; start < rows && !failed; start += LANES) {
        const int lanes = (int)(rows - start < LANES ? rows - start : LANES);
        double *to = in;
        for (int b = 0; b < arrays; to += width[b++] * LANES)
            for (int l = 0; l < LANES; ++l) {
                const double *row = array[b] + (start + (l < lanes ? l : lanes - 1)) * width[b];
                for (int k = 0; k < width[b]; ++k) to[k * LANES + l] = row[k];
            }
        kernel(in, out);
        for (int l = 0; l < lanes; ++l)
            for (int k = 0; k < nout; ++k) outputs[(start + l) * nout + k] = out[k * LANES + l];
    }
    free(in), free(out);
    return failed;
}

/* Return mapping of points that yield (forms/returnmapping.py).
 *
 * Local unknowns X solve r(X; inputs) = 0 by Newton's method with step halving, LANES points at a time. The
 * consistent tangent is ds/dz - ds/dX (dr/dX)^-1 dr/dz (implicit function theorem). All of the derivatives come
 * from compiled kernels (forms/plastic.py). LANES systems of equations are solved at once, with the same rows as
 * pivots; a lane that doesn't bear them is solved by itself. */
#include "_transpose.h"

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

#define PIVOT 0.1                /* least share of a column's largest entry that is a pivot without a search */
#define LEAST 1e-3               /* least share that the pivot of all lanes may have in one of them */

typedef struct {
    lanes_t X[LOCAL_MAX], step[LOCAL_MAX], r[LOCAL_MAX];
    lanes_t C[LOCAL_MAX * LOCAL_MAX], T[LOCAL_MAX * DERIVED_MAX];
    double norm[LANES], length[LANES];
    int iterations[LANES], done[LANES], failed[LANES];
} Lanes;

/* Macros: before AVX-512 functions don't pass vectors of this length alike everywhere. */
#define MAGNITUDE(a) ((lanes_t)((mask_t)(a) & INT64_MAX))
#define CHOOSE(c, a, b) ((lanes_t)(((c) & (mask_t)(a)) | (~(c) & (mask_t)(b))))

INLINE void put_mask(const int *which, mask_t *m)
{
    for (int l = 0; l < LANES; ++l) (*m)[l] = which[l] ? -1 : 0;
}

INLINE int least_share(const lanes_t *entry, const lanes_t *largest, const int *which, double share)
{
    for (int l = 0; l < LANES; ++l)
        if (which[l] && !(fabs((*entry)[l]) >= share * (*largest)[l])) return 0;
    return 1;
}

/* The row of column k that is the pivot of all lanes in `which`; a lane in which it is small leaves them. */
INLINE int common_pivot(int n, const lanes_t *A, int k, int *which)
{
    lanes_t largest = MAGNITUDE(A[k * n + k]);
    for (int i = k + 1; i < n; ++i) {
        const lanes_t a = MAGNITUDE(A[i * n + k]);
        largest = CHOOSE(largest > a, largest, a);
    }
    for (int l = 0; l < LANES; ++l) which[l] &= largest[l] > 0.0 && isfinite(largest[l]);
    if (least_share(&A[k * n + k], &largest, which, PIVOT)) return k;
    int best = k;
    double most = -1.0;
    for (int i = k; i < n; ++i) {
        double least = INFINITY;
        for (int l = 0; l < LANES; ++l)
            if (which[l]) least = fmin(least, fabs(A[i * n + k][l]) / largest[l]);
        if (least > most) most = least, best = i;
    }
    for (int l = 0; l < LANES; ++l) which[l] &= fabs(A[best * n + k][l]) >= LEAST * largest[l];
    return best;
}

INLINE void swap_rows(int columns, lanes_t *A, int k, int p)
{
    for (int j = 0; p != k && j < columns; ++j) {
        const lanes_t t = A[k * columns + j];
        A[k * columns + j] = A[p * columns + j];
        A[p * columns + j] = t;
    }
}

/* Solve C B = B for m right-hand sides [n][m] in place, C being overwritten, in the lanes of `which`; those that don't
 * bear the common pivots leave it. */
INLINE void solve_lanes(int n, lanes_t *C, int m, lanes_t *B, int *which)
{
    for (int k = 0; k < n; ++k) {
        const int p = common_pivot(n, C, k, which);
        swap_rows(n, C, k, p);
        swap_rows(m, B, k, p);
        const lanes_t inverse = 1.0 / C[k * n + k];
        for (int i = k + 1; i < n; ++i) {
            const lanes_t l = C[i * n + k] * inverse;
            for (int j = k + 1; j < n; ++j) C[i * n + j] -= l * C[k * n + j];
            for (int j = 0; j < m; ++j) B[i * m + j] -= l * B[k * m + j];
        }
    }
    for (int k = n - 1; k >= 0; --k) {
        const lanes_t inverse = 1.0 / C[k * n + k];
        for (int j = 0; j < m; ++j) B[k * m + j] *= inverse;
        for (int i = 0; i < k; ++i) {
            const lanes_t u = C[i * n + k];
            for (int j = 0; j < m; ++j) B[i * m + j] -= u * B[k * m + j];
        }
    }
}

/* The same for one lane, with pivots of its own, from scaled rows of `local`; nonzero if there is no solution. */
static int solve_lane(const Return *R, const lanes_t *local, int l, int m, const lanes_t *given, lanes_t *B)
{
    const int n = R->nx;
    double C[LOCAL_MAX * LOCAL_MAX], T[LOCAL_MAX * DERIVED_MAX];
    int pivot[LOCAL_MAX];
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < n; ++j) C[i * n + j] = R->row_scale[i] * local[n + i * n + j][l];
        for (int j = 0; j < m; ++j) T[i * m + j] = R->row_scale[i] * given[i * m + j][l];
    }
    if (factor(n, C, pivot)) return 1;
    back_substitute(n, C, pivot, m, T);
    for (int i = 0; i < n * m; ++i) B[i][l] = T[i];
    return 0;
}

/* Solve (dr/dX) B = given [n][m] in the lanes of `which`; those without a solution leave it. */
INLINE void solve_local(const Return *R, Lanes *w, const lanes_t *local, int m, const lanes_t *given, lanes_t *B,
                        int *which)
{
    const int n = R->nx;
    int together[LANES];
    for (int i = 0; i < n; ++i) {
        const double scale = R->row_scale[i];
        for (int j = 0; j < n; ++j) w->C[i * n + j] = scale * local[n + i * n + j];
        for (int j = 0; j < m; ++j) B[i * m + j] = scale * given[i * m + j];
    }
    memcpy(together, which, sizeof together);
    solve_lanes(n, w->C, m, B, together);
    for (int l = 0; l < LANES; ++l)
        if (which[l] && !together[l]) which[l] = !solve_lane(R, local, l, m, given, B);
}

/* An iteration of the open lanes after an evaluation at their trial x, which becomes the next one. Returns 1 if lanes
 * are still open, and sets `behind` where x has gone back to an earlier X. */
FAST static __attribute__((noinline)) int advance(const Return *R, Lanes *w, const lanes_t *local, lanes_t *x,
                                                   int *behind)
{
    const int n = R->nx;
    int accepted[LANES], turned[LANES], moved[LANES], back[LANES], open = 0;
    lanes_t squares = {0.0}, length;
    for (int i = 0; i < n; ++i) {
        const lanes_t r = R->row_scale[i] * local[i];
        squares += r * r;
    }
    for (int l = 0; l < LANES; ++l) {
        const double norm = sqrt(squares[l]);
        /* a long step must gain much: near the apex of a cone one that turns the flow round may gain a little */
        const double gain = w->length[l] > 0.05 ? 0.5 : 1e-4;
        accepted[l] = !w->done[l] && (w->iterations[l] == 0 || norm < (1.0 - gain * w->length[l]) * w->norm[l]);
        if (accepted[l]) {
            w->norm[l] = norm;
            w->done[l] = norm <= R->tolerance;
            if (!isfinite(norm)) w->done[l] = w->failed[l] = 1;
        }
        turned[l] = accepted[l] && !w->done[l];
        open |= turned[l];
    }
    mask_t take, turn, move, return_;
    put_mask(accepted, &take);
    for (int i = 0; i < n; ++i) w->X[i] = CHOOSE(take, x[i], w->X[i]);
    if (open) {
        int solved[LANES];
        memcpy(solved, turned, sizeof solved);
        solve_local(R, w, local, 1, local, w->r, solved);
        for (int l = 0; l < LANES; ++l)
            if (turned[l] && !solved[l]) w->done[l] = w->failed[l] = 1;
        put_mask(solved, &turn);
        for (int i = 0; i < n; ++i) w->step[i] = CHOOSE(turn, -w->r[i], w->step[i]);
    }
    open = 0;
    for (int l = 0; l < LANES; ++l) {
        back[l] = 0;
        if (!w->done[l]) {
            w->length[l] = accepted[l] ? 1.0 : 0.5 * w->length[l];
            if (w->length[l] < 1e-4 || ++w->iterations[l] > R->most) {
                w->done[l] = back[l] = 1;
                w->failed[l] = !(w->norm[l] <= R->loose);
            }
        }
        moved[l] = !w->done[l];
        open |= moved[l];
        *behind |= back[l];
        length[l] = w->length[l];
    }
    put_mask(moved, &move);
    put_mask(back, &return_);
    for (int i = 0; i < n; ++i)
        x[i] = CHOOSE(move, w->X[i] + length * w->step[i], CHOOSE(return_, w->X[i], x[i]));
    return open;
}

/* ds/dz of the open lanes of `which`, in place: ds/dz - ds/dX T. */
FAST static __attribute__((noinline)) void condense(const Return *R, Lanes *w, const lanes_t *local, lanes_t *moduli,
                                                     int *which)
{
    const int nz = R->nz, n = R->nx;
    lanes_t *sz = moduli + nz;
    const lanes_t *sx = sz + nz * nz, *rz = sx + nz * n;
    solve_local(R, w, local, nz, rz, w->T, which);
    for (int i = 0; i < nz; ++i)
        for (int j = 0; j < nz; j += 4) {  /* four columns at a time stay in registers */
            const int some = nz - j < 4 ? nz - j : 4;
            lanes_t sum[4] = {{0.0}};
            for (int k = 0; k < n; ++k) {
                const lanes_t a = sx[i * n + k], *t = w->T + k * nz + j;
                if (some == 4) sum[0] += a * t[0], sum[1] += a * t[1], sum[2] += a * t[2], sum[3] += a * t[3];
                else for (int c = 0; c < some; ++c) sum[c] += a * t[c];
            }
            for (int c = 0; c < some; ++c) sz[i * nz + j + c] -= sum[c];
        }
}

/* Solve for X [row][width] of n rows of the inputs, from its initial values, and write what is returned, [row][room]:
 * nz (+ nz nz with tangent) numbers. status: 0 solved, 1 not; iterations: evaluations of the local residual; both [n].
 * Returns nonzero without memory. */
int polarmpm_return(const Return *R, int64_t n, const int64_t *rows, const double *inputs, int32_t tangent,
                    int32_t width, double *X, int32_t room, double *returned, int8_t *status, int32_t *iterations)
{
    const int nin = R->nin, nx = R->nx, nz = R->nz, size = nz + (tangent ? nz * nz : 0);
    if (nx > LOCAL_MAX || nz > DERIVED_MAX) return 2;
    lanes_t *in = vectors((size_t)(nin + nx) * LANES), *local = vectors((size_t)(nx + nx * nx) * LANES);
    lanes_t *work = vectors((size_t)(nz + nz * nz + 2 * nz * nx) * LANES);
    Lanes *w = vectors(sizeof(Lanes) / sizeof(double));
    const int failed = !(in && local && work && w);
    for (int64_t start = 0; start < n && !failed; start += LANES) {
        const int lanes = (int)(n - start < LANES ? n - start : LANES);
        int behind = 0, which[LANES];
        for (int l = 0; l < LANES; ++l) {
            const int64_t p = rows[start + (l < lanes ? l : lanes - 1)];
            for (int k = 0; k < nin; ++k) in[k][l] = inputs[p * nin + k];
            for (int k = 0; k < nx; ++k) in[nin + k][l] = X[p * width + k];
            w->norm[l] = 0.0, w->length[l] = 1.0;
            w->iterations[l] = w->failed[l] = 0, w->done[l] = l >= lanes;
        }
        do R->local((const double *)in, (double *)local);
        while (advance(R, w, local, in + nin, &behind));
        if (behind) R->local((const double *)in, (double *)local);
        for (int l = 0; l < LANES; ++l) which[l] = l < lanes && !w->failed[l];
        (tangent ? R->moduli : R->stress)((const double *)in, (double *)work);
        if (tangent) condense(R, w, local, work, which);
        for (int l = 0; l < lanes; ++l) {
            const int64_t p = rows[start + l];
            for (int k = 0; k < nx; ++k) X[p * width + k] = w->X[k][l];
            iterations[start + l] = w->iterations[l];
            status[start + l] = (int8_t)!which[l];
            for (int i = 0; which[l] && i < size; ++i) returned[p * room + i] = work[i][l];
        }
    }
    free(in), free(local), free(work), free(w);
    return failed;
}

/* A kernel for rows of inputs, given in arrays of columns [row][width], -> [row][nout]. Returns nonzero without
 * memory. */
FAST int polarmpm_evaluate(kernel_t kernel, int64_t rows, int32_t arrays, const int32_t *width, const double *const *array,
                           int32_t nout, double *outputs)
{
    int nin = 0;
    for (int b = 0; b < arrays; ++b) nin += width[b];
    lanes_t *in = vectors((size_t)nin * LANES), *out = vectors((size_t)nout * LANES);
    const int failed = !(in && out);
    for (int64_t start = 0; start < rows && !failed; start += LANES) {
        const int lanes = (int)(rows - start < LANES ? rows - start : LANES);
        lanes_t *to = in;
        for (int b = 0; b < arrays; to += width[b++]) rows_to_lanes(array[b], start, lanes, width[b], to);
        kernel((const double *)in, (double *)out);
        lanes_to_rows(out, nout, lanes, nout, outputs + start * nout);
    }
    free(in), free(out);
    return failed;
}

SIZE_OF(Return);

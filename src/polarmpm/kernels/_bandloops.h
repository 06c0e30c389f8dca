/* Factors and solutions in vectors of PIECES numbers; a part of _band.c, which includes it for each width that processors
 * have: the compiler keeps wider vectors in memory. */
#define VECTOR SIZED_AS(vector)
#define NEAR SIZED_AS(near)
#define MASK SIZED_AS(mask)

typedef double VECTOR __attribute__((vector_size(8 * PIECES), aligned(8 * PIECES)));
typedef int64_t MASK __attribute__((vector_size(8 * PIECES), aligned(8 * PIECES)));
typedef double NEAR __attribute__((vector_size(8 * PIECES), aligned(8), may_alias));  /* at any place */

/* Take the products of the panel's R columns of L and rows of U off T rows of one of the triangles behind them, from row and
 * column j of these on: rows of `from` times factors out of `by`. Vectors end where rows end; what they hold of the rows
 * before, where they begin, stays. */
INLINE void SIZED_AS(take_off_rows)(const int T, int R, int64_t j, int64_t length, const double *const *by, const double *const *from,
                          double *const *to)
{
    MASK count;
    double f[PANEL][TILE];
    for (int l = 0; l < PIECES; ++l) count[l] = l;
    for (int r = 0; r < PANEL; ++r)
        for (int t = 0; t < T; ++t) f[r][t] = r < R ? by[r][j + t] : 0.0;
    int64_t k = length - (length - j + PIECES - 1) / PIECES * PIECES;
    for (; k < j + T - 1; k += PIECES) {
        VECTOR left[TILE];
        for (int t = 0; t < T; ++t) {
            VECTOR sum = f[0][t] * *(const NEAR *)(from[0] + k);
            for (int r = 1; r < PANEL; ++r) sum += f[r][t] * *(const NEAR *)(from[r] + k);
            const MASK inside = count + k >= j + t;
            left[t] = *(const NEAR *)(to[t] + k) - (VECTOR)((MASK)sum & inside);
        }
        for (int t = T - 1; t >= 0; --t) *(NEAR *)(to[t] + k) = left[t];  /* a row begins where the one before ends */
    }
    for (; k < length; k += PIECES) {
        VECTOR left[TILE];
        for (int t = 0; t < T; ++t) left[t] = *(const NEAR *)(to[t] + k);
        for (int r = 0; r < PANEL; ++r) {
            const VECTOR row = *(const NEAR *)(from[r] + k);
            for (int t = 0; t < T; ++t) left[t] -= f[r][t] * row;
        }
        for (int t = 0; t < T; ++t) *(NEAR *)(to[t] + k) = left[t];
    }
}

/* The same of all rows behind rows i to i + R. */
INLINE void SIZED_AS(take_off)(int R, int64_t i, const int64_t *begin, int64_t length, const double *L, const double *U, double *out)
{
    const double *by[PANEL], *from[PANEL];
    for (int r = 0; r < PANEL; ++r) {
        const int64_t at = begin[i + (r < R ? r : 0)] + R - (r < R ? r : 0);  /* column i + R */
        from[r] = U + at, by[r] = L + at;
    }
    int64_t j = 0;
    for (; j + TILE <= length; j += TILE) {
        double *to[TILE];
        for (int t = 0; t < TILE; ++t) to[t] = out + begin[i + R + j + t] - (j + t);
        SIZED_AS(take_off_rows)(TILE, R, j, length, by, from, to);
    }
    for (; j < length; ++j) {
        double *to[1] = {out + begin[i + R + j] - j};
        SIZED_AS(take_off_rows)(1, R, j, length, by, from, to);
    }
}

/* Complete row i of U, and column i of L; their diagonal becomes what a solution is multiplied by. Returns nonzero where there
 * is no pivot. */
INLINE int SIZED_AS(finish_row)(int64_t i, const int64_t *begin, double *U, double *L)
{
    double *row = U + begin[i], *column = L ? L + begin[i] : row;
    const int64_t length = begin[i + 1] - begin[i];
    const double pivot = row[0];
    if (!(fabs(pivot) < INFINITY) || pivot == 0.0 || (!L && pivot < 0.0)) return 1;
    const double inverse = 1.0 / (L ? pivot : sqrt(pivot));
    row[0] = inverse;
    for (int64_t k = 1; k < length; ++k) column[k] *= inverse;
    if (L) column[0] = 1.0;
    return 0;
}

/* See polarmpm_band_factor. */
ALONE static int SIZED_AS(factor)(int64_t n, int32_t block, int32_t symmetric, const int64_t *begin, int64_t entries,
                              const int64_t *place, const double *values, double shift, double *factor)
{
    double *U = factor, *L = symmetric ? NULL : factor + begin[n];
    memset(factor, 0, sizeof(double) * begin[n] * (symmetric ? 1 : 2));
    for (int64_t k = 0; k < entries; ++k) factor[place[k]] = values[k];
    for (int64_t i = 0; i < n; ++i) U[begin[i]] *= 1.0 + shift;
    const int64_t rows = rows_of_panel(block);
    for (int64_t i = 0; i < n; i += rows) {
        const int R = (int)(n - i < rows ? n - i : rows);
        const int64_t length = begin[i + 1] - begin[i];
        for (int r = 0; r < R; ++r) {
            if (SIZED_AS(finish_row)(i + r, begin, U, L)) return 1;
            const double *row = U + begin[i + r], *column = L ? L + begin[i + r] : row;
            for (int s = r + 1; s < R; ++s) {
                double *restrict to = U + begin[i + s];
                for (int64_t k = 0; k < length - s; ++k) to[k] -= column[s - r] * row[s - r + k];
                if (!L) continue;
                to = L + begin[i + s];
                for (int64_t k = 1; k < length - s; ++k) to[k] -= row[s - r] * column[s - r + k];
            }
        }
        SIZED_AS(take_off)(R, i, begin, length - R, L ? L : U, U, U);
        if (L) SIZED_AS(take_off)(R, i, begin, length - R, U, L, L);
    }
    return 0;
}

/* See polarmpm_band_solve. */
ALONE static void SIZED_AS(solve)(int64_t n, int32_t block, int32_t symmetric, const int32_t *position, const int64_t *begin,
                              const double *factor, const double *right, double *work, double *out)
{
    const double *U = factor, *L = symmetric ? U : factor + begin[n];
    for (int64_t i = 0; i < n; ++i) work[(int64_t)position[i / block] * block + i % block] = right[i];
    const int64_t rows = rows_of_panel(block), panels = (n + rows - 1) / rows;
    for (int64_t i = 0; i < n; i += rows) {
        const int R = (int)(n - i < rows ? n - i : rows);
        const double *from[PANEL];
        double value[PANEL] = {0.0}, *restrict behind = work + i + R;
        for (int r = 0; r < R; ++r) {
            const double *column = L + begin[i + r];
            value[r] = work[i + r] *= column[0];
            for (int s = r + 1; s < R; ++s) work[i + s] -= column[s - r] * value[r];
        }
        for (int r = 0; r < PANEL; ++r) from[r] = L + begin[i + (r < R ? r : 0)] + R - (r < R ? r : 0);
        for (int64_t k = 0; k < begin[i + 1] - begin[i] - R; ++k) {
            double sum = behind[k];
            for (int r = 0; r < PANEL; ++r) sum -= value[r] * from[r][k];
            behind[k] = sum;
        }
    }
    for (int64_t panel = panels - 1; panel >= 0; --panel) {
        const int64_t i = panel * rows;
        const int R = (int)(n - i < rows ? n - i : rows);
        const int64_t length = begin[i + 1] - begin[i] - R;
        const double *from[PANEL], *behind = work + i + R;
        VECTOR sum[PANEL] = {{0.0}};
        double rest[PANEL] = {0.0};
        int64_t k = 0;
        for (int r = 0; r < PANEL; ++r) from[r] = U + begin[i + (r < R ? r : 0)] + R - (r < R ? r : 0);
        for (; k + PIECES <= length; k += PIECES) {
            const VECTOR x = *(const NEAR *)(behind + k);
            for (int r = 0; r < PANEL; ++r) sum[r] += *(const NEAR *)(from[r] + k) * x;
        }
        for (; k < length; ++k)
            for (int r = 0; r < PANEL; ++r) rest[r] += from[r][k] * behind[k];
        for (int r = R - 1; r >= 0; --r) {
            const double *row = U + begin[i + r];
            double left = work[i + r] - rest[r];
            for (int l = 0; l < PIECES; ++l) left -= sum[r][l];
            for (int s = r + 1; s < R; ++s) left -= row[s - r] * work[i + s];
            work[i + r] = left * row[0];
        }
    }
    for (int64_t i = 0; i < n; ++i) out[i] = work[(int64_t)position[i / block] * block + i % block];
}

#undef VECTOR
#undef NEAR
#undef MASK

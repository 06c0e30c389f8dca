/* Factors of small matrices whose unknowns, in a good order, are coupled to near ones only, as those of slender bodies; a
 * part of _native.c. Matrices have a symmetric pattern, and rows (`block` for a node) in compressed storage, whose upper
 * triangle is enough where they are symmetric. Rows of the factor's upper triangle U, and columns of its lower one L, go from
 * the diagonal to the last entry that the factor has; of symmetric matrices L is the transpose of U, and isn't stored. There
 * is no pivoting: who solves looks at what is left. */
#ifndef POLARMPM_BAND_H
#define POLARMPM_BAND_H

#include "_points.h"

/* Rows are completed in panels of as many nodes as have up to PANEL unknowns; rows of a panel end at the same column. */
enum { PANEL = 6, TILE = 4 };

static int64_t rows_of_panel(int32_t block) { return block <= PANEL ? PANEL / block * block : 1; }

/* Visit nodes, neighbours of visited ones next, from `first` on; returns how many are in `order` then. */
static int64_t spread_from(int64_t first, const int64_t *start, const int32_t *near, int64_t count, int32_t *order,
                           uint8_t *seen)
{
    int64_t at = count;
    order[count++] = (int32_t)first, seen[first] = 1;
    for (; at < count; ++at)
        for (int64_t k = start[order[at]]; k < start[order[at] + 1]; ++k)
            if (!seen[near[k]]) seen[near[k]] = 1, order[count++] = near[k];
    return count;
}

/* An order of nodes in which neighbours are near each other (E. Cuthill, J. McKee 1969; reversed), and where the factor's rows begin,
 * begin[n + 1]. Returns nonzero without memory. */
int polarmpm_band_order(int64_t nodes, int32_t block, const int64_t *indptr, const int32_t *indices, int32_t *position,
                        int64_t *begin)
{
    const int64_t n = nodes * block;
    int64_t *start = calloc(nodes + 2, sizeof(int64_t)), count = 0, total = 0;
    int32_t *order = malloc(sizeof(int32_t) * (nodes + 1)), *last = malloc(sizeof(int32_t) * (nodes + 1));
    uint8_t *seen = calloc(nodes + 1, 1);
    int32_t *near = malloc(sizeof(int32_t) * (2 * (indptr[n] / block) + 2));
    if (!start || !order || !last || !seen || !near) total = -1;
    for (int pass = 0; pass < 2 && !total; ++pass) {  /* numbers of neighbours, then the neighbours */
        for (int64_t i = 0; i < nodes; ++i)
            for (int64_t k = indptr[i * block]; k < indptr[i * block + 1]; k += block) {
                const int64_t j = indices[k] / block;
                if (j <= i) continue;
                if (!pass) ++start[i + 2], ++start[j + 2];
                else near[start[i + 1]++] = (int32_t)j, near[start[j + 1]++] = (int32_t)i;
            }
        for (int64_t i = 2; !pass && i < nodes + 2; ++i) start[i] += start[i - 1];
    }
    for (int64_t i = 0; i < nodes && !total; ++i) {
        if (seen[i]) continue;
        int64_t first = i;
        for (int k = 0; k < 2; ++k) {  /* twice to the far end */
            const int64_t end = spread_from(first, start, near, count, order, seen);
            first = order[end - 1];
            for (int64_t q = count; q < end; ++q) seen[order[q]] = 0;
        }
        count = spread_from(first, start, near, count, order, seen);
    }
    for (int64_t q = 0; q < nodes && !total; ++q) position[order[q]] = (int32_t)(nodes - 1 - q);
    if (!total) {
        for (int64_t q = 0; q < nodes; ++q) {
            const int64_t i = order[nodes - 1 - q];  /* the node at place q */
            last[q] = (int32_t)(q && last[q - 1] > q ? last[q - 1] : q);
            for (int64_t k = start[i]; k < start[i + 1]; ++k)
                if (position[near[k]] > last[q]) last[q] = position[near[k]];
        }
        const int64_t some = rows_of_panel(block) / block;
        for (int64_t q = nodes - 2; q >= 0 && some > 1; --q)
            if ((q + 1) % some) last[q] = last[q + 1];
        for (int64_t q = 0; q < nodes; ++q)
            for (int c = 0; c < block; ++c) {
                begin[q * block + c] = total;
                total += (last[q] + 1) * (int64_t)block - (q * block + c);
            }
        begin[n] = total;
    }
    free(start), free(order), free(last), free(seen), free(near);
    return total < 0;
}

/* Where the entries of scalar rows stand in the factor, U and behind it, of matrices that aren't symmetric, L. */
void polarmpm_band_places(int64_t n, int32_t block, int32_t symmetric, const int64_t *indptr, const int32_t *indices,
                          const int32_t *position, const int64_t *begin, int64_t *place)
{
    for (int64_t i = 0; i < n; ++i)
        for (int64_t k = indptr[i]; k < indptr[i + 1]; ++k) {
            const int64_t p = (int64_t)position[i / block] * block + i % block;
            const int64_t q = (int64_t)position[indices[k] / block] * block + indices[k] % block;
            place[k] = p <= q ? begin[p] + q - p : (symmetric ? 0 : begin[n]) + begin[q] + p - q;
        }
}

typedef double near_t __attribute__((vector_size(8 * LANES), aligned(8), may_alias));  /* lanes_t at any place */

/* Take the products of the panel's R columns of L and rows of U off T rows of one of the triangles behind them, from row and
 * column j of these on: rows of `from` times factors out of `by`. Vectors end where rows end; what they hold of the rows
 * before, where they begin, stays. */
INLINE void take_off_rows(const int T, int R, int64_t j, int64_t length, const double *const *by, const double *const *from,
                          double *const *to)
{
    const mask_t count = {0, 1, 2, 3, 4, 5, 6, 7};
    double f[PANEL][TILE];
    for (int r = 0; r < PANEL; ++r)
        for (int t = 0; t < T; ++t) f[r][t] = r < R ? by[r][j + t] : 0.0;
    int64_t k = length - (length - j + LANES - 1) / LANES * LANES;
    for (; k < j + T - 1; k += LANES) {
        lanes_t left[TILE];
        for (int t = 0; t < T; ++t) {
            lanes_t sum = f[0][t] * *(const near_t *)(from[0] + k);
            for (int r = 1; r < PANEL; ++r) sum += f[r][t] * *(const near_t *)(from[r] + k);
            const mask_t inside = count + k >= j + t;
            left[t] = *(const near_t *)(to[t] + k) - (lanes_t)((mask_t)sum & inside);
        }
        for (int t = T - 1; t >= 0; --t) *(near_t *)(to[t] + k) = left[t];  /* a row begins where the one before ends */
    }
    for (; k < length; k += LANES) {
        lanes_t left[TILE];
        for (int t = 0; t < T; ++t) left[t] = *(const near_t *)(to[t] + k);
        for (int r = 0; r < PANEL; ++r) {
            const lanes_t row = *(const near_t *)(from[r] + k);
            for (int t = 0; t < T; ++t) left[t] -= f[r][t] * row;
        }
        for (int t = 0; t < T; ++t) *(near_t *)(to[t] + k) = left[t];
    }
}

/* The same of all rows behind rows i to i + R. */
INLINE void take_off(int R, int64_t i, const int64_t *begin, int64_t length, const double *L, const double *U, double *out)
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
        take_off_rows(TILE, R, j, length, by, from, to);
    }
    for (; j < length; ++j) {
        double *to[1] = {out + begin[i + R + j] - j};
        take_off_rows(1, R, j, length, by, from, to);
    }
}

/* Complete row i of U, and column i of L; their diagonal becomes what a solution is multiplied by. Returns nonzero where there
 * is no pivot. */
INLINE int finish_row(int64_t i, const int64_t *begin, double *U, double *L)
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

/* Factors of a matrix whose diagonal is larger by a share `shift`: Cholesky's where it is symmetric, else L U, L behind U.
 * LANES numbers in front of `factor` are read. Returns nonzero where it isn't definite, or a pivot is zero. */
FAST int polarmpm_band_factor(int64_t n, int32_t block, int32_t symmetric, const int64_t *begin, int64_t entries,
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
            if (finish_row(i + r, begin, U, L)) return 1;
            const double *row = U + begin[i + r], *column = L ? L + begin[i + r] : row;
            for (int s = r + 1; s < R; ++s) {
                double *restrict to = U + begin[i + s];
                for (int64_t k = 0; k < length - s; ++k) to[k] -= column[s - r] * row[s - r + k];
                if (!L) continue;
                to = L + begin[i + s];
                for (int64_t k = 1; k < length - s; ++k) to[k] -= row[s - r] * column[s - r + k];
            }
        }
        take_off(R, i, begin, length - R, L ? L : U, U, U);
        if (L) take_off(R, i, begin, length - R, U, L, L);
    }
    return 0;
}

/* Solution of a system by its factors; `work`: n numbers. */
FAST void polarmpm_band_solve(int64_t n, int32_t block, int32_t symmetric, const int32_t *position, const int64_t *begin,
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
        lanes_t sum[PANEL] = {{0.0}};
        double rest[PANEL] = {0.0};
        int64_t k = 0;
        for (int r = 0; r < PANEL; ++r) from[r] = U + begin[i + (r < R ? r : 0)] + R - (r < R ? r : 0);
        for (; k + LANES <= length; k += LANES) {
            const lanes_t x = *(const near_t *)(behind + k);
            for (int r = 0; r < PANEL; ++r) sum[r] += *(const near_t *)(from[r] + k) * x;
        }
        for (; k < length; ++k)
            for (int r = 0; r < PANEL; ++r) rest[r] += from[r][k] * behind[k];
        for (int r = R - 1; r >= 0; --r) {
            const double *row = U + begin[i + r];
            double left = work[i + r] - rest[r];
            for (int l = 0; l < LANES; ++l) left -= sum[r][l];
            for (int s = r + 1; s < R; ++s) left -= row[s - r] * work[i + s];
            work[i + r] = left * row[0];
        }
    }
    for (int64_t i = 0; i < n; ++i) out[i] = work[(int64_t)position[i / block] * block + i % block];
}

/* What is left of a right-hand side: right - A x. */
void polarmpm_band_rest(int64_t n, int32_t symmetric, const int64_t *indptr, const int32_t *indices, const double *values,
                        const double *x, const double *right, double *out)
{
    memcpy(out, right, sizeof(double) * n);
    for (int64_t i = 0; i < n; ++i) {
        double sum = 0.0;
        for (int64_t k = indptr[i]; k < indptr[i + 1]; ++k) {
            const int64_t j = indices[k];
            sum += values[k] * x[j];
            if (symmetric && j != i) out[j] -= values[k] * x[i];
        }
        out[i] -= sum;
    }
}

#endif

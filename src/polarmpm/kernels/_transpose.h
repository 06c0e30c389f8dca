/* Rows of points, whose numbers stand one after the other, to lanes, whose numbers stand side by side, and back; shared by
 * the units. */
#ifndef POLARMPM_TRANSPOSE_H
#define POLARMPM_TRANSPOSE_H

#include "_points.h"

enum { PARTS = LANES / WIDTH }; /* lanes are treated WIDTH at a time: sums stay in registers */

/* Rows of four vectors as columns. */
#define TRANSPOSE(a, b, c, d, to)                                                                                     \
    {                                                                                                                 \
        typedef int64_t places __attribute__((vector_size(8 * WIDTH)));                                               \
        const places even = {0, 4, 2, 6}, odd = {1, 5, 3, 7}, low = {0, 1, 4, 5}, high = {2, 3, 6, 7};                \
        const vec ab = __builtin_shuffle(a, b, even), cd = __builtin_shuffle(c, d, even);                             \
        const vec ba = __builtin_shuffle(a, b, odd), dc = __builtin_shuffle(c, d, odd);                               \
        to[0] = __builtin_shuffle(ab, cd, low), to[1] = __builtin_shuffle(ba, dc, low);                               \
        to[2] = __builtin_shuffle(ab, cd, high), to[3] = __builtin_shuffle(ba, dc, high);                             \
    }

/* Puts n numbers of each lane, which stand one after the other, side by side: WIDTH of WIDTH lanes at once. */
INLINE void to_lanes(const double *const *from, int n, lanes_t *out)
{
    int k = 0;
    for (; k + WIDTH <= n; k += WIDTH)
        for (int h = 0; h < PARTS; ++h) {
            const double *const *at = from + h * WIDTH;
            vec *to = (vec *)(out + k) + h, columns[WIDTH];
            const vec a = *(const row_t *)(at[0] + k), b = *(const row_t *)(at[1] + k);
            const vec c = *(const row_t *)(at[2] + k), d = *(const row_t *)(at[3] + k);
            TRANSPOSE(a, b, c, d, columns)
            for (int i = 0; i < WIDTH; ++i) to[i * PARTS] = columns[i];
        }
    for (; k < n; ++k)
        for (int l = 0; l < LANES; ++l) out[k][l] = from[l][k];
}

/* The same of rows [point][step], n numbers of each, of the LANES points from `start` on; lanes without a point repeat the
 * last one. */
INLINE void steps_to_lanes(const double *rows, int64_t start, int lanes, int64_t step, int n, lanes_t *out)
{
    const double *from[LANES];
    for (int l = 0; l < LANES; ++l) from[l] = rows + (start + (l < lanes ? l : lanes - 1)) * step;
    to_lanes(from, n, out);
}

INLINE void rows_to_lanes(const double *rows, int64_t start, int lanes, int n, lanes_t *out)
{
    steps_to_lanes(rows, start, lanes, n, n, out);
}

/* n numbers of each of the first `lanes` lanes into rows [lane][step]. */
INLINE void lanes_to_rows(const lanes_t *in, int n, int lanes, int64_t step, double *rows)
{
    int k = 0;
    for (; lanes == LANES && k + WIDTH <= n; k += WIDTH)
        for (int h = 0; h < PARTS; ++h) {
            const vec *from = (const vec *)(in + k) + h;
            vec numbers[WIDTH];
            TRANSPOSE(from[0], from[PARTS], from[2 * PARTS], from[3 * PARTS], numbers)
            for (int i = 0; i < WIDTH; ++i) *(row_t *)(rows + (h * WIDTH + i) * step + k) = numbers[i];
        }
    for (; k < n; ++k)
        for (int l = 0; l < lanes; ++l) rows[l * step + k] = in[k][l];
}

#endif

/* Sums over the nodes of LANES points at once, one direction after the other: nodal values -> values and derivatives at
 * the points, and transposed, work at the points -> nodal forces; shared by the sums' units.
 *
 * Nodes are padded to the `slots` of a batch in each direction. Weights are [direction][order][slot], nodal numbers
 * [component][node], numbers at the points [component][row], rows being the value, its derivatives and, where `curved`,
 * the second ones, in the order of `pair_of`. With three functions in each direction a point's second derivatives cost
 * less this way than the products of its functions do. */
#ifndef POLARMPM_LANES_H
#define POLARMPM_LANES_H

#include "_transpose.h"

enum {
    ROWS = 10                  /* rows in space, where curved */
};

INLINE int rows_of(int dim, int curved) { return 1 + dim + curved * pairs_of(dim); }

static int padded_nodes(const Batch *b) { return b->dim == 3 ? b->slots * b->slots * b->slots : b->slots * b->slots; }

/* Along a line of m nodes: sums with the functions, their derivatives, their second ones. */
INLINE void sum_line(const int m, const int curved, const vec *w, const vec *x, vec *sums)
{
    for (int k = 0; k < 2 + curved; ++k) {
        sums[k] = w[k * m * PARTS] * x[0];
        for (int c = 1; c < m; ++c) sums[k] += w[(k * m + c) * PARTS] * x[c * PARTS];
    }
}

/* Rows of nb components from nodal values. */
INLINE void derive(const int dim, const int m, const int curved, int orders, int nb, const vec *w, const vec *x, vec *out)
{
    const int step = m * PARTS, next = orders * step, plane = (dim == 3 ? m : 1) * step, rows = rows_of(dim, curved);
    for (int i = 0; i < nb; ++i, x += m * plane, out += rows * PARTS)
        for (int h = 0; h < PARTS; ++h) {
            vec sum[ROWS] = {{0}};
            for (int a = 0; a < m; ++a) {
                const vec *at = x + a * plane + h, *u = w + a * PARTS + h;
                vec t[PAIRS] = {{0}};  /* sums over the other directions: value, y, z, yy, yz, zz; in the plane value, y, yy */
                if (dim == 2) sum_line(m, curved, w + next + h, at, t);
                for (int c = 0; dim == 3 && c < m; ++c) {
                    const vec *v = w + next + c * PARTS + h;
                    vec s[3];
                    sum_line(m, curved, w + 2 * next + h, at + c * step, s);
                    t[0] += v[0] * s[0], t[1] += v[step] * s[0], t[2] += v[0] * s[1];
                    if (curved) t[3] += v[2 * step] * s[0], t[4] += v[step] * s[1], t[5] += v[0] * s[2];
                }
                sum[0] += u[0] * t[0], sum[1] += u[step] * t[0], sum[2] += u[0] * t[1];
                if (dim == 3) sum[3] += u[0] * t[2];
                if (curved && dim == 2) sum[3] += u[2 * step] * t[0], sum[4] += u[step] * t[1], sum[5] += u[0] * t[2];
                if (curved && dim == 3) {
                    sum[4] += u[2 * step] * t[0], sum[5] += u[step] * t[1], sum[6] += u[step] * t[2];
                    sum[7] += u[0] * t[3], sum[8] += u[0] * t[4], sum[9] += u[0] * t[5];
                }
            }
            for (int k = 0; k < rows; ++k) out[k * PARTS + h] = sum[k];
        }
}

/* What `sum_line` does, transposed. */
INLINE void spread_line(const int m, const int curved, const vec *w, const vec *sums, vec *f)
{
    for (int c = 0; c < m; ++c) {
        vec sum = w[c * PARTS] * sums[0] + w[(m + c) * PARTS] * sums[1];
        if (curved) sum += w[(2 * m + c) * PARTS] * sums[2];
        f[c * PARTS] = sum;
    }
}

/* Nodal forces of nb components from what their rows multiply: `derive`, transposed. */
INLINE void spread(const int dim, const int m, const int curved, int orders, int nb, const vec *w, const vec *rows, vec *f)
{
    const int step = m * PARTS, next = orders * step, plane = (dim == 3 ? m : 1) * step;
    for (int i = 0; i < nb; ++i, f += m * plane, rows += rows_of(dim, curved) * PARTS)
        for (int h = 0; h < PARTS; ++h) {
            vec q[ROWS];
            for (int k = 0; k < rows_of(dim, curved); ++k) q[k] = rows[k * PARTS + h];
            for (int a = 0; a < m; ++a) {
                const vec *u = w + a * PARTS + h;
                vec *at = f + a * plane + h, t[PAIRS];
                t[0] = q[0] * u[0] + q[1] * u[step], t[1] = q[2] * u[0];
                if (dim == 3) t[2] = q[3] * u[0];
                if (curved && dim == 2) t[0] += q[3] * u[2 * step], t[1] += q[4] * u[step], t[2] = q[5] * u[0];
                if (curved && dim == 3) {
                    t[0] += q[4] * u[2 * step], t[1] += q[5] * u[step], t[2] += q[6] * u[step];
                    t[3] = q[7] * u[0], t[4] = q[8] * u[0], t[5] = q[9] * u[0];
                }
                if (dim == 2) spread_line(m, curved, w + next + h, t, at);
                for (int c = 0; dim == 3 && c < m; ++c) {
                    const vec *v = w + next + c * PARTS + h;
                    vec s[3];
                    s[0] = t[0] * v[0] + t[1] * v[step], s[1] = t[2] * v[0];
                    if (curved) s[0] += t[3] * v[2 * step], s[1] += t[4] * v[step], s[2] = t[5] * v[0];
                    spread_line(m, curved, w + 2 * next + h, s, at + c * step);
                }
            }
        }
}

/* Compiled for two functions in each direction, those of tents, for three, those of quadratic splines, and for any number
 * of them. */
#define OF_BASES(call, name)                                                                                          \
    FAST static __attribute__((noinline)) void name(const Batch *b, int curved, const lanes_t *w, const lanes_t *in,   \
                                                    lanes_t *out)                                                     \
    {                                                                                                                 \
        const int nb = block_size(b), m = b->slots, orders = b->orders;                                               \
        const vec *weights = (const vec *)w, *from = (const vec *)in;                                                 \
        vec *to = (vec *)out;                                                                                         \
        if (b->dim == 3 && m == 2 && !curved) call(3, 2, 0, orders, nb, weights, from, to);                           \
        else if (m == 2 && !curved) call(2, 2, 0, orders, nb, weights, from, to);                                     \
        else if (b->dim == 3 && m == 3 && curved) call(3, 3, 1, 3, nb, weights, from, to);                            \
        else if (b->dim == 3 && m == 3) call(3, 3, 0, orders, nb, weights, from, to);                                 \
        else if (b->dim == 3 && curved) call(3, m, 1, 3, nb, weights, from, to);                                      \
        else if (b->dim == 3) call(3, m, 0, orders, nb, weights, from, to);                                           \
        else if (m == 3 && curved) call(2, 3, 1, 3, nb, weights, from, to);                                           \
        else if (m == 3) call(2, 3, 0, orders, nb, weights, from, to);                                                \
        else if (curved) call(2, m, 1, 3, nb, weights, from, to);                                                     \
        else call(2, m, 0, orders, nb, weights, from, to);                                                            \
    }

OF_BASES(derive, derive_lanes)
OF_BASES(spread, spread_lanes)

/* A group's nodal values, padded. */
INLINE void pad_group(const int nb, const Batch *b, int64_t group, const double *x, double *out)
{
    const int m = b->slots, all = padded_nodes(b);
    const int32_t *c = b->count + group * b->dim, *nodes = b->nodes + b->node_offsets[group];
    if (nodes_of(b, group) < all) memset(out, 0, sizeof(double) * nb * all);
    for (int i = 0; i < c[0]; ++i)
        for (int j = 0; j < c[1]; ++j)
            for (int k = 0; k < (b->dim == 3 ? c[2] : 1); ++k, ++nodes) {
                const double *from = x + (int64_t)*nodes * nb;
                double *to = out + (b->dim == 3 ? (i * m + j) * m + k : i * m + j);
                for (int n = 0; n < nb; ++n) to[n * all] = from[n];
            }
}

/* Nodal values of the lanes' groups; room: LANES nb padded_nodes. */
INLINE void pad_groups(const int nb, const Batch *b, const int64_t *group, const double *x, double *room, lanes_t *out)
{
    const int size = nb * padded_nodes(b);
    const double *of[LANES];
    for (int l = 0; l < LANES; ++l) {
        of[l] = l && group[l] == group[l - 1] ? of[l - 1] : room + l * size;
        if (of[l] == room + l * size) pad_group(nb, b, group[l], x, room + l * size);
    }
    if (group[LANES - 1] != group[0]) to_lanes(of, size, out);
    else for (int k = 0; k < size; ++k) out[k] = room[k] - (lanes_t){0};
}

/* Sums of the lanes from `begin` to `end`: `first`, or to what stands there. */
INLINE void add_lanes(const lanes_t *from, int n, int begin, int end, int first, lanes_t *sums)
{
    typedef int64_t some_t __attribute__((vector_size(8 * WIDTH)));
    const vec *part = (const vec *)from;
    vec *sum = (vec *)sums;
    some_t some[PARTS];
    for (int l = 0; l < LANES; ++l) some[l / WIDTH][l % WIDTH] = l >= begin && l < end ? -1 : 0;
    if (first) for (int k = 0; k < n * PARTS; ++k) sum[k] = (vec)((some_t)part[k] & some[k % PARTS]);
    else for (int k = 0; k < n * PARTS; ++k) sum[k] += (vec)((some_t)part[k] & some[k % PARTS]);
}

/* The sums of a group's lanes into nodal forces. */
INLINE void flush_lanes(const int nb, const Batch *b, int64_t group, const lanes_t *sums, double *force)
{
    const int m = b->slots, all = padded_nodes(b);
    const int32_t *c = b->count + group * b->dim, *nodes = b->nodes + b->node_offsets[group];
    for (int i = 0; i < c[0]; ++i)
        for (int j = 0; j < c[1]; ++j)
            for (int k = 0; k < (b->dim == 3 ? c[2] : 1); ++k, ++nodes) {
                const lanes_t *from = sums + (b->dim == 3 ? (i * m + j) * m + k : i * m + j);
                double *to = force + (int64_t)*nodes * nb;
                for (int n = 0; n < nb; ++n) {
                    const vec *part = (const vec *)(from + n * all);
                    vec sum = part[0];
                    for (int h = 1; h < PARTS; ++h) sum += part[h];
                    to[n] += (sum[0] + sum[1]) + (sum[2] + sum[3]);
                }
            }
}

/* What turns second derivatives in the grid's frame into those in LANES frames, see find_second_shape. */
INLINE void find_turn(const int dim, const lanes_t *frame, lanes_t turn[PAIRS][PAIRS])
{
    for (int i = 0; i < dim; ++i)
        for (int j = i; j < dim; ++j)
            for (int m = 0; m < dim; ++m)
                for (int l = m; l < dim; ++l) {
                    lanes_t sum = frame[m * dim + i] * frame[l * dim + j];
                    if (l > m) sum += frame[l * dim + i] * frame[m * dim + j];
                    turn[pair_of(dim, i, j)][pair_of(dim, m, l)] = sum;
                }
}

/* z of LANES points from the rows of their nodal values. */
INLINE void put_rows(const int dim, const int rot, const int second, int curved, const lanes_t *rows, const lanes_t *frame, lanes_t *z)
{
    const int pairs = pairs_of(dim);
    const lanes_t *grown = frame + dim * dim;
    lanes_t turn[PAIRS][PAIRS];
    if (second == SECOND) find_turn(dim, frame, turn);
    for (int i = 0; i < dim + rot; ++i, rows += rows_of(dim, curved)) {
        lanes_t *gradient = z + gradient_slot(dim, rot, i);
        if (has_value(dim, second, i)) z[value_slot(dim, rot, i)] = rows[0];
        for (int c = 0; c < dim; ++c) {
            lanes_t sum = rows[1] * frame[c];
            for (int d = 1; d < dim; ++d) sum += rows[1 + d] * frame[d * dim + c];
            gradient[c] = sum;
        }
        for (int k = 0; second == SECOND && k < pairs; ++k) {
            lanes_t sum = rows[1] * grown[k];
            for (int m = 1; m < dim; ++m) sum += rows[1 + m] * grown[m * pairs + k];
            for (int l = 0; l < pairs; ++l) sum += turn[k][l] * rows[1 + dim + l];
            z[second_slot(dim, rot, i) + k] = sum;
        }
    }
}

/* What the rows multiply, from what z does, r, and what second derivatives in the grid's frame do, `bent` (or NULL). */
INLINE void take_rows(const int dim, const int rot, const int second, int curved, const lanes_t *r, const lanes_t *bent,
                      const lanes_t *frame, lanes_t *rows)
{
    const int pairs = pairs_of(dim);
    const lanes_t *grown = frame + dim * dim;
    lanes_t turn[PAIRS][PAIRS];
    if (second == SECOND) find_turn(dim, frame, turn);
    for (int i = 0; i < dim + rot; ++i, rows += rows_of(dim, curved)) {
        const lanes_t *gradient = r + gradient_slot(dim, rot, i), *own = r + second_slot(dim, rot, i);
        rows[0] = has_value(dim, second, i) ? r[value_slot(dim, rot, i)] : (lanes_t){0};
        for (int d = 0; d < dim; ++d) {
            lanes_t sum = frame[d * dim] * gradient[0];
            for (int c = 1; c < dim; ++c) sum += frame[d * dim + c] * gradient[c];
            for (int k = 0; second == SECOND && k < pairs; ++k) sum += grown[d * pairs + k] * own[k];
            rows[1 + d] = sum;
        }
        for (int l = 0; curved && l < pairs; ++l) {
            lanes_t sum = bent ? bent[i * pairs + l] : (lanes_t){0};
            for (int k = 0; second == SECOND && k < pairs; ++k) sum += turn[k][l] * own[k];
            rows[1 + dim + l] = sum;
        }
    }
}

#endif

/* The points' boxes: a point stands for a box with half axes d_k, over which the strain energy varies; a part of
 * the units of sums over points.
 *
 * With z_k, the derivative of z along d_k, the energy of the box is that of the rule of degree 3 with the box's centre
 * and the centres of its faces,
 *
 *     W(z) + share / 6 sum_k [W(z + z_k) + W(z - z_k) - 2 W(z)]     (docs/theory.md).
 *
 * All z_k of a point follow from the second derivatives of its functions, h, and for rotations from their gradients:
 * d(du_i/dx_c) = sum_h along[k][c][h] h_i, d(w_i) = sum_c lean[k][c] dw_i/dx_c. So nodes are read, and forces go back to
 * them, once for all sides. With second gradients z_k has the derivatives of the gradients alone: third ones of the
 * functions are left out.
 *
 * A body of revolution has more volume outside: its sides count (1 + c) and (1 - c) times, with the share c of the radius
 * that d_k has along it. They are at other radii, and z_k isn't all of their change: the displacement itself and the
 * rotation are in z, of which the quadratic part, `arched`, is the same on both sides.
 */
#ifndef POLARMPM_BOXES_H
#define POLARMPM_BOXES_H

#include "_lanes.h"
#include "_scatter.h"

enum {
    SIDES = 3,                 /* half axes in space */
    BENT = 2                   /* values in z of a body of revolution: of the displacement and of the rotation */
};

#define LITTLE 0.01            /* share of a box whose sides' own moduli don't matter in a tangent */

/* Memory for LANES points and their boxes. */
typedef struct {
    vec *curved;               /* [lane][PAIRS][sv]: second derivatives of a point's functions */
    vec *sides;                /* [side][lane][shapes_of(second)][sv]: a point's shapes differentiated along the half axes */
    lanes_t *axes;             /* [side][dim] half axes */
    lanes_t *along;            /* [side][dim][pair] see above */
    lanes_t *lean;             /* [side][dim] half axes in the frame, where there are rotations */
    lanes_t *frames, *tilt;    /* [side][dim][dim] `box_frame`, `box_tilt` */
    lanes_t *h, *h_before;     /* [component][pair] second derivatives of the nodal values, of those before the last correction */
    double *zk, *before;       /* [side][nz][LANES]; of the nodal values before the last correction */
    double *sums;              /* [1 + side][nz][LANES]: sum_k [R(z + z_k) + R(z - z_k) - 2 R(z)], R(z + z_k) - R(z - z_k) */
    lanes_t *bent;             /* [component][pair] what virtual second derivatives multiply */
    double *z, *up, *down;     /* inputs, and outputs on both sides */
    double *moduli;            /* [2 side + (0: up, 1: down)][outputs][LANES]: residuals and moduli on the sides */
    lanes_t *even, *odd;       /* [nz][nz]: sums and differences of the moduli on both sides */
    lanes_t *common, *apart;   /* [nz][moduli_of]: what they make of z and second derivatives, see find_whole */
    lanes_t *whole;            /* [moduli_of][moduli_of] */
    int32_t *at;               /* [moduli_of][moduli_of] where an entry of it stands, whose upper triangle is filled */
    lanes_t *hoop;             /* [side]: `box_hoop` */
    lanes_t *arched, *arched_before;  /* [side][BENT]: quadratic parts of the values in z; before the last correction */
    lanes_t *both;             /* [side][BENT]: sum of what the values do work on, on both sides */
} BoxWork;

/* Length of z with the second derivatives of all components behind it. */
INLINE int moduli_of(int dim, int rot, int second) { return unknowns_of(dim, rot, second) + (dim + rot) * pairs_of(dim); }

/* With `shapes` for shapes along the half axes, with `whole` for the moduli at the sides, too. */
static int create_boxes(const Batch *b, int sv, int shapes, int whole, BoxWork *w)
{
    const int nz = unknowns_of(b->dim, b->rot, b->second), outputs = nz + nz * (nz + 1) / 2;
    const size_t stride = (size_t)sv * WIDTH, inputs = 2 * nz + b->nstate + b->nparam, rows = LANES * shapes_of(b->second);
    const size_t bent = (size_t)block_size(b) * PAIRS * LANES, all = whole ? moduli_of(b->dim, b->rot, b->second) : 0;
    *w = (BoxWork){.curved = vectors(LANES * PAIRS * stride), .sides = vectors(shapes ? SIDES * rows * stride : 1),
                   .axes = vectors(SIDES * 3 * LANES), .along = vectors(SIDES * 3 * PAIRS * LANES), .lean = vectors(SIDES * 3 * LANES), .h = vectors(bent),
                   .frames = vectors(SIDES * 9 * LANES), .tilt = vectors(SIDES * 9 * LANES),
                   .h_before = vectors(bent), .zk = vectors(SIDES * nz * LANES), .before = vectors(SIDES * nz * LANES),
                   .sums = vectors((1 + SIDES) * nz * LANES), .bent = vectors(bent), .z = vectors(inputs * LANES),
                   .up = vectors(nz * LANES), .down = vectors(nz * LANES),
                   .moduli = vectors(whole ? (size_t)2 * SIDES * outputs * LANES : 1),
                   .even = vectors(whole ? (size_t)nz * nz * LANES : 1), .odd = vectors(whole ? (size_t)nz * nz * LANES : 1),
                   .common = vectors(nz * all * LANES), .apart = vectors(nz * all * LANES), .whole = vectors(all * all * LANES),
                   .at = malloc(sizeof(int32_t) * (all * all + 1)),
                   .hoop = vectors(SIDES * LANES), .arched = vectors(SIDES * BENT * LANES),
                   .arched_before = vectors(SIDES * BENT * LANES), .both = vectors(SIDES * BENT * LANES)};
    for (size_t i = 0; w->at && i < all; ++i)
        for (size_t j = i; j < all; ++j) w->at[i * all + j] = w->at[j * all + i] = (int32_t)(i * all + j) * LANES;
    return !(w->curved && w->sides && w->axes && w->along && w->lean && w->frames && w->tilt && w->h && w->h_before && w->zk && w->before && w->sums && w->bent &&
             w->z && w->up && w->down && w->moduli && w->even && w->odd && w->common && w->apart && w->whole && w->at && w->hoop && w->arched && w->arched_before && w->both);
}

static void free_boxes(BoxWork *w)
{
    free(w->curved), free(w->sides), free(w->axes), free(w->along), free(w->lean), free(w->frames), free(w->tilt), free(w->h), free(w->h_before), free(w->zk), free(w->before);
    free(w->sums), free(w->bent), free(w->z), free(w->up), free(w->down), free(w->moduli);
    free(w->even), free(w->odd), free(w->common), free(w->apart), free(w->whole), free(w->at);
    free(w->hoop), free(w->arched), free(w->arched_before), free(w->both);
}

/* How many values z has in a body of revolution, their unknown of a node, and their slot. */
INLINE int values_of(int rot, int second) { return second == AXIAL ? 1 + rot : 0; }
INLINE int value_component(int dim, int value) { return value ? dim : 0; }
INLINE int bent_slot(int dim, int rot, int value) { return value_slot(dim, rot, value_component(dim, value)); }

/* Half axes of LANES points from `start` on, the last of them that of the last lane. */
INLINE void find_axes(const int dim, const PointKernels *kernels, int64_t start, int count, const BoxWork *w)
{
    rows_to_lanes(kernels->box_axes, start, count, dim * dim, w->axes);
    if (kernels->box_lean) rows_to_lanes(kernels->box_lean, start, count, dim * dim, w->lean);
    if (kernels->box_frame) rows_to_lanes(kernels->box_frame, start, count, dim * dim * dim, w->frames);
    if (kernels->box_frame) rows_to_lanes(kernels->box_tilt, start, count, dim * dim * dim, w->tilt);
    if (kernels->box_hoop) rows_to_lanes(kernels->box_hoop, start, count, dim, w->hoop);
}

/* Of lane l, point p: second derivatives of its n functions. */
INLINE void find_curved(const int dim, const Batch *b, int64_t p, const int32_t *count, int n, int sv, int l, const BoxWork *w)
{
    second_rows(dim, b, p, count, n, sv * WIDTH, (double *)(w->curved + (int64_t)l * PAIRS * sv));
}

/* What second derivatives make of gradients along the half axes, with LANES frames. */
INLINE void find_along(const int dim, const double *frames, const BoxWork *w)
{
    const lanes_t *frame = (const lanes_t *)frames;
    for (int k = 0; k < dim; ++k)
        for (int c = 0; c < dim; ++c)
            for (int i = 0; i < dim; ++i)
                for (int j = i; j < dim; ++j) {
                    lanes_t sum = frame[i * dim + c] * w->axes[k * dim + j];
                    if (j > i) sum += frame[j * dim + c] * w->axes[k * dim + i];
                    w->along[(k * dim + c) * pairs_of(dim) + pair_of(dim, i, j)] = sum;
                }
}

/* Second derivatives of nodal values, from the rows of these. */
INLINE void take_curved(const int dim, const int rot, const lanes_t *rows, lanes_t *h)
{
    for (int i = 0; i < dim + rot; ++i)
        for (int k = 0; k < pairs_of(dim); ++k) h[i * pairs_of(dim) + k] = rows[i * rows_of(dim, 1) + 1 + dim + k];
}

/* In a body of revolution, the quadratic parts of the values at the sides, from second derivatives. */
INLINE void find_arched(const int dim, const int rot, const int second, const lanes_t *h, const BoxWork *w, lanes_t *arched)
{
    for (int k = 0; k < dim; ++k)
        for (int v = 0; v < values_of(rot, second); ++v) {
            lanes_t sum = {0};
            for (int i = 0; i < dim; ++i)
                for (int j = 0; j < dim; ++j)
                    sum += 0.5 * w->axes[k * dim + i] * w->axes[k * dim + j] * h[value_component(dim, v) * pairs_of(dim) + pair_of(dim, i, j)];
            arched[k * BENT + v] = sum;
        }
}

/* All z_k of LANES points from `start` on, the last of them that of the last lane, from z and the second derivatives. */
INLINE void find_zk(const int dim, const int rot, const int second, const PointKernels *kernels, int64_t start, int count,
                    const double *z, const lanes_t *h, const BoxWork *w, double *zk)
{
    const int nz = unknowns_of(dim, rot, second), pairs = pairs_of(dim), turning = rot * (1 + dim);
    const lanes_t *at = (const lanes_t *)z;
    for (int k = 0; k < dim; ++k) {
        lanes_t *own = (lanes_t *)zk + k * nz;
        for (int i = unknowns_of(dim, rot, 0); i < nz; ++i) own[i] = (lanes_t){0};
        for (int i = 0; i < dim + rot; ++i)
            for (int c = 0; c < dim; ++c) {
                const lanes_t *along = w->along + (k * dim + c) * pairs;
                lanes_t sum = along[0] * h[i * pairs];
                for (int j = 1; j < pairs; ++j) sum += along[j] * h[i * pairs + j];
                for (int m = 0; kernels->box_frame && m < dim; ++m)
                    sum += w->tilt[(k * dim + m) * dim + c] * at[gradient_slot(dim, rot, i) + m];
                own[gradient_slot(dim, rot, i) + c] = sum;
            }
        for (int i = 0; i < dim + rot; ++i) {
            if (!has_value(dim, second, i)) continue;
            lanes_t sum = w->lean[k * dim] * at[gradient_slot(dim, rot, i)];
            for (int c = 1; c < dim; ++c) sum += w->lean[k * dim + c] * at[gradient_slot(dim, rot, i) + c];
            own[value_slot(dim, rot, i)] = sum;
        }
        for (int l = 0; rot && kernels->box_turns && l < LANES; ++l) {  /* rotations, then their gradients */
            const double *turns = kernels->box_turns + ((start + (l < count ? l : count - 1)) * dim + k) * turning;
            for (int i = 0; i < turning; ++i) own[value_slot(dim, rot, dim) + i][l] += turns[i];
        }
    }
}

/* In a body of revolution, how much the side `sign` of half axis k counts. */
#define SIDE_WEIGHT(w, k, sign) (1.0 + (sign) * (w)->hoop[k])

/* What a point's state is on the side `sign` of half axis k, where that is another: the frame; in a body of revolution the
 * radius, and the quadratic part of the values in z. */
INLINE void put_side(const int dim, const int rot, const int second, const PointKernels *kernels, const double *in, double sign, int k,
                     BoxWork *w)
{
    lanes_t *z = (lanes_t *)w->z;
    const int at_frame = unknowns_of(dim, rot, second), first = at_frame + dim * dim + AT_HOOP;
    for (int i = 0; kernels->box_frame && i < dim * dim; ++i)
        z[at_frame + i] = ((const lanes_t *)in)[at_frame + i] + sign * w->frames[k * dim * dim + i];
    if (second != AXIAL) return;
    for (int v = 0; v < values_of(rot, second); ++v) z[bent_slot(dim, rot, v)] += w->arched[k * BENT + v];
    for (int i = first; i < first + 1 + rot; ++i) z[i] = ((const lanes_t *)in)[i] / SIDE_WEIGHT(w, k, sign);
}

/* What the boxes' virtual work multiplies, from the kernel's inputs and its residual at z. */
INLINE void evaluate_boxes(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const double *in,
                           const double *residual, BoxWork *w)
{
    const int nz = unknowns_of(dim, rot, second), block = nz * LANES;
    const kernel_t kernel = kernels->box_kernel;
    const lanes_t *at = (const lanes_t *)in, *r = (const lanes_t *)residual;
    lanes_t *up = (lanes_t *)w->up, *down = (lanes_t *)w->down;
    lanes_t *z = (lanes_t *)w->z, *sums = (lanes_t *)w->sums;
    memcpy(w->z + block, in + block, sizeof(double) * (b->nstate + b->nparam) * LANES);
    for (int i = 0; i < nz; ++i) sums[i] = -2.0 * dim * r[i];
    for (int k = 0; k < dim; ++k) {
        const lanes_t *zk = (const lanes_t *)w->zk + k * nz;
        for (int i = 0; i < nz; ++i) z[i] = at[i] + zk[i];
        put_side(dim, rot, second, kernels, in, 1.0, k, w);
        kernel(w->z, w->up);
        for (int i = 0; i < nz; ++i) z[i] = at[i] - zk[i];
        put_side(dim, rot, second, kernels, in, -1.0, k, w);
        kernel(w->z, w->down);
        for (int i = 0; second == AXIAL && i < nz; ++i) {
            up[i] *= SIDE_WEIGHT(w, k, 1.0);
            down[i] *= SIDE_WEIGHT(w, k, -1.0);
        }
        for (int v = 0; v < values_of(rot, second); ++v)
            w->both[k * BENT + v] = up[bent_slot(dim, rot, v)] + down[bent_slot(dim, rot, v)];
        for (int i = 0; i < nz; ++i) {
            sums[i] += up[i] + down[i];
            sums[(1 + k) * nz + i] = up[i] - down[i];
        }
    }
}

/* What is stored of LANES points and their boxes, LANES numbers each: z, what it does work on, the same of the box, then
 * z_k (in a body of revolution the values' quadratic parts, too), and what these do work on. */
INLINE int stored_sides(int dim, int rot, int second)
{
    return dim * unknowns_of(dim, rot, second) + (second == AXIAL) * SIDES * BENT;
}

INLINE int stored_of(int dim, int rot, int second)
{
    return (3 * unknowns_of(dim, rot, second) + 2 * stored_sides(dim, rot, second)) * LANES;
}

INLINE void store_boxes(const int dim, const int rot, const int second, const double *in, const double *residual, const BoxWork *w,
                        double *out)
{
    const int block = unknowns_of(dim, rot, second) * LANES, bent = (second == AXIAL) * SIDES * BENT * LANES;
    const void *parts[] = {in, residual, w->sums, w->zk, w->arched, w->sums + block, w->both};
    const int sizes[] = {block, block, block, dim * block, bent, dim * block, bent};
    for (int k = 0; k < 7; ++k) {
        memcpy(out, parts[k], sizeof(double) * sizes[k]);
        out += sizes[k];
    }
}

/* What virtual values and derivatives multiply in place of virtual z and z_k: the first `sums`, and `bent`. */
INLINE void collect_sides(const int dim, const int rot, const int second, const PointKernels *kernels, const BoxWork *w)
{
    const int nz = unknowns_of(dim, rot, second), pairs = pairs_of(dim);
    lanes_t *sums = (lanes_t *)w->sums;
    for (int i = 0; i < dim + rot; ++i) {
        const int gradient = gradient_slot(dim, rot, i);
        for (int j = 0; j < pairs; ++j) {
            lanes_t sum = {0};
            for (int k = 0; k < dim; ++k)
                for (int c = 0; c < dim; ++c) sum += w->along[(k * dim + c) * pairs + j] * sums[(1 + k) * nz + gradient + c];
            w->bent[i * pairs + j] = sum;
        }
        for (int k = 0; kernels->box_frame && k < dim; ++k)
            for (int m = 0; m < dim; ++m)
                for (int c = 0; c < dim; ++c)
                    sums[gradient + m] += w->tilt[(k * dim + m) * dim + c] * sums[(1 + k) * nz + gradient + c];
        for (int k = 0; has_value(dim, second, i) && k < dim; ++k)
            for (int c = 0; c < dim; ++c)
                sums[gradient + c] += w->lean[k * dim + c] * sums[(1 + k) * nz + value_slot(dim, rot, i)];
    }
    for (int v = 0; v < values_of(rot, second); ++v)
        for (int k = 0; k < dim; ++k)
            for (int i = 0; i < dim; ++i)
                for (int j = 0; j < dim; ++j)
                    w->bent[value_component(dim, v) * pairs + pair_of(dim, i, j)] +=
                        0.5 * w->axes[k * dim + i] * w->axes[k * dim + j] * w->both[k * BENT + v];
}

/* The boxes' share in the residuals r of LANES points, times `weight`, and in `bent`. */
INLINE void add_sides(const int dim, const int rot, const int second, const BoxWork *w, const lanes_t *weight, lanes_t *r)
{
    const lanes_t *sums = (const lanes_t *)w->sums;
    for (int i = 0; i < unknowns_of(dim, rot, second); ++i) r[i] += *weight * sums[i];
    for (int i = 0; i < (dim + rot) * pairs_of(dim); ++i) w->bent[i] *= *weight;
}

/* Shapes s of lane l, differentiated along its half axes; in a body of revolution, behind them, half the functions' second
 * derivatives along these. */
INLINE void side_shapes(const int dim, const int rot, const int second, const PointKernels *kernels, int nv, int sv, const vec *s, int l,
                        const BoxWork *w)
{
    const vec *curved = w->curved + (int64_t)l * PAIRS * sv;
    for (int k = 0; k < dim; ++k) {
        vec *out = w->sides + ((int64_t)k * LANES + l) * shapes_of(second) * sv;
        for (int c = 0; c < dim; ++c) {
            const lanes_t *along = w->along + (k * dim + c) * pairs_of(dim);
            const double lean = w->lean[k * dim + c][l];
            for (int v = 0; v < nv; ++v) {
                vec sum = along[0][l] * curved[v];
                for (int j = 1; j < pairs_of(dim); ++j) sum += along[j][l] * curved[j * sv + v];
                for (int m = 0; kernels->box_frame && m < dim; ++m) sum += w->tilt[(k * dim + m) * dim + c][l] * s[(1 + m) * sv + v];
                out[(1 + c) * sv + v] = sum;
                if (rot || second == AXIAL) out[v] = (c ? out[v] : (vec){0}) + lean * s[(1 + c) * sv + v];
            }
        }
        for (int v = 0; second == AXIAL && v < nv; ++v) {
            vec sum = {0};
            for (int i = 0; i < dim; ++i)
                for (int j = 0; j < dim; ++j)
                    sum += 0.5 * w->axes[k * dim + i][l] * w->axes[k * dim + j][l] * curved[pair_of(dim, i, j) * sv + v];
            out[(1 + dim) * sv + v] = sum;
        }
    }
}

/* Residuals and moduli at z + z_k and z - z_k, for all sides. */
INLINE void evaluate_sides(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const double *in,
                           BoxWork *w)
{
    const kernel_t kernel = kernels->kernel;
    const int nz = unknowns_of(dim, rot, second), block = nz * LANES, outputs = nz + nz * (nz + 1) / 2;
    const int known = (b->nstate + b->nparam) * LANES;
    memcpy(w->z, in, sizeof(double) * (2 * block + known));
    for (int k = 0; k < dim; ++k)
        for (int down = 0; down < 2; ++down) {
            const double sign = down ? -1.0 : 1.0;
            for (int i = 0; i < block; ++i) {
                w->z[i] = in[i] + sign * w->zk[k * block + i];
                w->z[block + known + i] = in[block + known + i] + sign * w->before[k * block + i];
            }
            lanes_t *values_before = (lanes_t *)(w->z + block + known);
            for (int v = 0; v < values_of(rot, second); ++v) values_before[bent_slot(dim, rot, v)] += w->arched_before[k * BENT + v];
            put_side(dim, rot, second, kernels, in, sign, k, w);
            kernel(w->z, w->moduli + (2 * k + down) * outputs * LANES);
        }
}

/* Whether a point's sides have its own moduli in a tangent: its box counts for little, as of points that have flowed. */
INLINE int is_simple(const int second, const PointKernels *kernels, int64_t p)
{
    return second != AXIAL && kernels->box_share[p] <= LITTLE;
}

/* Gives the sides of lanes the moduli of their points. */
INLINE void simplify_sides(const int dim, const int rot, const int second, const int *simple, int lanes, const double *out, BoxWork *w)
{
    const int nz = unknowns_of(dim, rot, second), outputs = nz + nz * (nz + 1) / 2;
    for (int l = 0; l < lanes; ++l)
        for (int side = 0; simple[l] && side < 2 * dim; ++side)
            for (int i = nz; i < outputs; ++i) w->moduli[(side * outputs + i) * LANES + l] = out[i * LANES + l];
}

/* y^T U + t^T V, where z + U x +- V x are the unknowns at the sides of half axis k, x those at the point and second
 * derivatives: V of z_k, U of what is common to both sides, z and, in a body of revolution, its values' quadratic parts. */
INLINE void side_row(const int dim, const int rot, const int second, const PointKernels *kernels, int k, const lanes_t *y, const lanes_t *t,
                     const BoxWork *w, lanes_t *out)
{
    const int nz = unknowns_of(dim, rot, second), pairs = pairs_of(dim);
    for (int i = 0; i < nz; ++i) out[i] = y[i];
    for (int i = 0; i < dim + rot; ++i) {
        const int gradient = gradient_slot(dim, rot, i);
        for (int j = 0; j < pairs; ++j) {
            lanes_t sum = t[gradient] * w->along[k * dim * pairs + j];
            for (int c = 1; c < dim; ++c) sum += t[gradient + c] * w->along[(k * dim + c) * pairs + j];
            out[nz + i * pairs + j] = sum;
        }
        for (int m = 0; kernels->box_frame && m < dim; ++m)
            for (int c = 0; c < dim; ++c) out[gradient + m] += t[gradient + c] * w->tilt[(k * dim + m) * dim + c];
        for (int c = 0; has_value(dim, second, i) && c < dim; ++c) out[gradient + c] += t[value_slot(dim, rot, i)] * w->lean[k * dim + c];
    }
    for (int v = 0; v < values_of(rot, second); ++v)
        for (int i = 0; i < dim; ++i)
            for (int j = 0; j < dim; ++j)
                out[nz + value_component(dim, v) * pairs + pair_of(dim, i, j)] +=
                    y[bent_slot(dim, rot, v)] * (0.5 * w->axes[k * dim + i] * w->axes[k * dim + j]);
}

/* Transposed, of rows F [z][all] for what is common to both sides, and G for the rest: added to the upper triangle of M. */
INLINE void add_rows(const int dim, const int rot, const int second, const PointKernels *kernels, int k, const lanes_t *F, const lanes_t *G,
                     const BoxWork *w, lanes_t *M)
{
    const int nz = unknowns_of(dim, rot, second), all = moduli_of(dim, rot, second), pairs = pairs_of(dim);
    for (int r = 0; r < nz; ++r)
        for (int q = r; q < all; ++q) M[r * all + q] += F[r * all + q];
    for (int i = 0; i < dim + rot; ++i) {
        const int gradient = gradient_slot(dim, rot, i), value = value_slot(dim, rot, i), bent = nz + i * pairs;
        for (int j = 0; j < pairs; ++j)
            for (int q = bent + j; q < all; ++q)
                for (int c = 0; c < dim; ++c)
                    M[(bent + j) * all + q] += w->along[(k * dim + c) * pairs + j] * G[(gradient + c) * all + q];
        for (int m = 0; kernels->box_frame && m < dim; ++m)
            for (int q = gradient + m; q < all; ++q)
                for (int c = 0; c < dim; ++c)
                    M[(gradient + m) * all + q] += w->tilt[(k * dim + m) * dim + c] * G[(gradient + c) * all + q];
        for (int c = 0; has_value(dim, second, i) && c < dim; ++c)
            for (int q = gradient + c; q < all; ++q) M[(gradient + c) * all + q] += w->lean[k * dim + c] * G[value * all + q];
    }
    for (int v = 0; v < values_of(rot, second); ++v)
        for (int i = 0; i < dim; ++i)
            for (int j = 0; j < dim; ++j) {
                const int row = nz + value_component(dim, v) * pairs + pair_of(dim, i, j);
                const lanes_t factor = 0.5 * w->axes[k * dim + i] * w->axes[k * dim + j];
                for (int q = row; q < all; ++q) M[row * all + q] += factor * F[bent_slot(dim, rot, v) * all + q];
            }
}

/* The sum and the difference of the moduli on both sides of half axis k, times `weight`, symmetric [z][z]. */
INLINE void pair_moduli(const int dim, const int rot, const int second, int k, const lanes_t *weight, const BoxWork *w)
{
    const int nz = unknowns_of(dim, rot, second), outputs = nz + nz * (nz + 1) / 2;
    const lanes_t *up = (const lanes_t *)w->moduli + 2 * k * outputs + nz, *down = up + outputs;
    lanes_t above = *weight, below = *weight;
    if (second == AXIAL) above *= SIDE_WEIGHT(w, k, 1.0), below *= SIDE_WEIGHT(w, k, -1.0);
    for (int i = 0; i < nz; ++i)
        for (int j = i; j < nz; ++j, ++up, ++down) {
            const lanes_t a = above * *up, b = below * *down;
            w->even[i * nz + j] = w->even[j * nz + i] = a + b;
            w->odd[i * nz + j] = w->odd[j * nz + i] = a - b;
        }
}

/* The whole tangent of LANES boxes in terms of z and of second derivatives, `weight` the sixth of what they count: with
 * z + U x +- V x at the sides it is sum_k [(U +- V)^T A (U +- V)] - 2 dim A. The upper triangle of w->whole [all][all]. */
INLINE void find_whole(const int dim, const int rot, const int second, const PointKernels *kernels, const double *out, const lanes_t *weight,
                       const BoxWork *w)
{
    const int nz = unknowns_of(dim, rot, second), all = moduli_of(dim, rot, second);
    const lanes_t *upper = (const lanes_t *)out + nz;
    memset(w->whole, 0, sizeof(lanes_t) * all * all);
    for (int i = 0; i < nz; ++i)
        for (int j = i; j < nz; ++j, ++upper) w->whole[i * all + j] = -2.0 * dim * *weight * *upper;
    for (int k = 0; k < dim; ++k) {
        pair_moduli(dim, rot, second, k, weight, w);
        for (int r = 0; r < nz; ++r) {
            side_row(dim, rot, second, kernels, k, w->even + r * nz, w->odd + r * nz, w, w->common + r * all);
            side_row(dim, rot, second, kernels, k, w->odd + r * nz, w->even + r * nz, w, w->apart + r * all);
        }
        add_rows(dim, rot, second, kernels, k, w->common, w->apart, w, w->whole);
    }
}

#endif

/* The points' boxes: a point stands for a box with half axes d_k, over which the strain energy varies; a part of
 * _native.c.
 *
 * With z_k, the derivative of z along d_k, the energy of the box is that of the rule of degree 3 with the box's centre
 * and the centres of its faces,
 *
 *     W(z) + share / 6 sum_k [W(z + z_k) + W(z - z_k) - 2 W(z)]     (docs/theory.md).
 *
 * With second gradients z_k has the derivatives of the gradients alone: third ones of the functions are left out, and
 * their rows in `sides` stay zero.
 *
 * A body of revolution has more volume outside: its sides count (1 + c) and (1 - c) times, with the share c of the radius
 * that d_k has along it. They are at other radii, and z_k isn't all of their change: the displacement itself and the
 * rotation are in z, of which the quadratic part, `bent`, is the same on both sides.
 */
#include "_points.h"

enum {
    SIDES = 3,                 /* half axes in space */
    BENT = 2                   /* values in z of a body of revolution: of the displacement and of the rotation */
};

/* Memory for LANES points and their boxes. */
typedef struct {
    vec *first, *second;       /* [SIDES][sv], [PAIRS][sv]: derivatives of a point's functions */
    vec *sides;                /* [side][lane][shapes_of(second)][sv]: a point's shapes differentiated along the half axes */
    double *zk, *before;       /* [side][nz][LANES]; of the nodal values before the last correction */
    double *sums;              /* [1 + side][nz][LANES]: sum_k [R(z + z_k) + R(z - z_k) - 2 R(z)], R(z + z_k) - R(z - z_k) */
    double *z, *up, *down;     /* inputs, and outputs on both sides */
    double *moduli;            /* [2 side + (0: up, 1: down)][outputs][LANES]: residuals and moduli on the sides */
    vec *moved;                /* [lane][shapes_of(second)][sv]: shapes on a side */
    double *hoop;              /* [side][LANES]: `box_hoop` */
    double *bent, *bent_before;  /* [side][BENT][LANES]: quadratic parts of the values in z; before the last correction */
    double *both;              /* [side][BENT][LANES]: sum of what the values do work on, on both sides */
} BoxWork;

static int create_boxes(const Batch *b, int sv, int whole, BoxWork *w)
{
    const int nz = unknowns_of(b->dim, b->rot, b->second), outputs = nz + nz * (nz + 1) / 2;
    const size_t stride = (size_t)sv * WIDTH, inputs = 2 * nz + b->nstate + b->nparam;
    *w = (BoxWork){.first = vectors(SIDES * stride), .second = vectors(PAIRS * stride),
                   .sides = vectors(SIDES * LANES * shapes_of(b->second) * stride), .zk = vectors(SIDES * nz * LANES),
                   .before = vectors(SIDES * nz * LANES), .moved = vectors(LANES * shapes_of(b->second) * stride),
                   .moduli = vectors(whole ? (size_t)2 * SIDES * outputs * LANES : 1), .sums = vectors((1 + SIDES) * nz * LANES), .z = vectors(inputs * LANES),
                   .up = vectors(nz * LANES), .down = vectors(nz * LANES),
                   .hoop = vectors(SIDES * LANES), .bent = vectors(SIDES * BENT * LANES),
                   .bent_before = vectors(SIDES * BENT * LANES), .both = vectors(SIDES * BENT * LANES)};
    return !(w->first && w->second && w->sides && w->zk && w->before && w->sums && w->z && w->up && w->down && w->moduli &&
             w->moved && w->hoop && w->bent && w->bent_before && w->both);
}

static void free_boxes(BoxWork *w)
{
    free(w->first), free(w->second), free(w->sides), free(w->zk);
    free(w->sums), free(w->z), free(w->up), free(w->down), free(w->before), free(w->moduli), free(w->moved), free(w->hoop);
    free(w->bent), free(w->bent_before), free(w->both);
}

/* How many values z has in a body of revolution, their unknown of a node, and their slot. */
INLINE int values_of(int rot, int second) { return second == AXIAL ? 1 + rot : 0; }
INLINE int value_component(int dim, int value) { return value ? dim : 0; }
INLINE int bent_slot(int dim, int rot, int value) { return value_slot(dim, rot, value_component(dim, value)); }

/* A point's shapes differentiated along a half axis, in the layout and frame of `shape`; in a body of revolution, behind
 * them, half the functions' second derivatives along it. */
INLINE void side_shapes(const int dim, const int second, int n, int nv, int sv, const double *axis, const double *frame, const BoxWork *w,
                        vec *s)
{
    for (int v = 0; v < nv; ++v) {
        vec along[SIDES], value = {0};
        for (int j = 0; j < dim; ++j) {
            value += axis[j] * w->first[j * sv + v];
            along[j] = (vec){0};
            for (int l = 0; l < dim; ++l) along[j] += axis[l] * w->second[pair_of(dim, j, l) * sv + v];
        }
        s[v] = value;
        if (second == AXIAL) {
            vec bent = {0};
            for (int j = 0; j < dim; ++j)
                for (int l = 0; l < dim; ++l) bent += 0.5 * axis[j] * axis[l] * w->second[pair_of(dim, j, l) * sv + v];
            s[(1 + dim) * sv + v] = bent;
        }
        for (int c = 0; c < dim; ++c) {
            vec sum = {0};
            for (int j = 0; j < dim; ++j) sum += frame[j * dim + c] * along[j];
            s[(1 + c) * sv + v] = sum;
        }
        for (int q = 0; v == nv - 1 && q < WIDTH; ++q)  /* what an earlier point has left beyond its nodes */
            for (int c = 0; c <= dim + (second == AXIAL) && v * WIDTH + q >= n; ++c) s[c * sv + v][q] = 0.0;
    }
}

/* Shapes of lane l, point p, differentiated along its half axes. */
INLINE void find_sides(const int dim, const int second, const Batch *b, const PointKernels *kernels, int64_t p, const int32_t *count, int n,
                       int sv, int l, BoxWork *w)
{
    const int nv = (n + WIDTH - 1) / WIDTH;
    curved_shape(dim, b, p, count, sv * WIDTH, (double *)w->first, (double *)w->second);
    for (int k = 0; kernels->box_hoop && k < dim; ++k) w->hoop[k * LANES + l] = kernels->box_hoop[p * dim + k];
    for (int k = 0; k < dim; ++k)
        side_shapes(dim, second, n, nv, sv, kernels->box_axes + (p * dim + k) * dim, b->state + p * b->nstate, w,
                    w->sides + ((int64_t)k * LANES + l) * shapes_of(second) * sv);
}

/* z_k of lane l, point p, from its group's nodal values, written with a step; in a body of revolution also `bent`. */
INLINE void gather_sides(const int dim, const int rot, const int second, const PointKernels *kernels, int64_t p, int nv, int sv, const vec *x,
                         int l, const BoxWork *w, double *zk, double *bent, const int step)
{
    const int nz = unknowns_of(dim, rot, second), plain = second == SECOND ? 0 : second;
    for (int k = 0; k < dim; ++k) {
        double *own = zk + k * nz * step;
        for (int i = unknowns_of(dim, rot, plain); i < nz; ++i) own[i * step] = 0.0;
        interpolate(dim, rot, plain, nv, sv, w->sides + ((int64_t)k * LANES + l) * shapes_of(second) * sv, x, own, step);
        const vec *half = w->sides + (((int64_t)k * LANES + l) * shapes_of(second) + 1 + dim) * sv;
        for (int v = 0; v < values_of(rot, second); ++v)
            bent[(k * BENT + v) * step] = dot(nv, x + value_component(dim, v) * sv, half);
        const int turning = rot * (1 + dim);  /* rotations, then their gradients */
        for (int i = 0; i < turning; ++i)
            own[(value_slot(dim, rot, dim) + i) * step] += kernels->box_turns[(p * dim + k) * turning + i];
    }
}

/* In a body of revolution, how much the side `sign` of half axis k counts on a lane. */
INLINE double side_weight(const int second, const BoxWork *w, int k, double sign, int lane)
{
    return second == AXIAL ? 1.0 + sign * w->hoop[k * LANES + lane] : 1.0;
}

/* In a body of revolution: the radius that a point's state has over, and the quadratic part of the values, on the side
 * `sign` of half axis k. */
INLINE void put_side(const int dim, const int rot, const int second, const double *in, double sign, int k, BoxWork *w)
{
    for (int v = 0; v < values_of(rot, second); ++v)
        for (int l = 0; l < LANES; ++l) w->z[bent_slot(dim, rot, v) * LANES + l] += w->bent[(k * BENT + v) * LANES + l];
    const int first = (unknowns_of(dim, rot, second) + dim * dim + AT_HOOP) * LANES;
    for (int i = 0; second == AXIAL && i < (1 + rot) * LANES; ++i)
        w->z[first + i] = in[first + i] / side_weight(second, w, k, sign, i % LANES);
}

/* What the residual of a side counts. */
INLINE void weigh_side(const int second, double sign, int k, int block, const BoxWork *w, double *out)
{
    for (int i = 0; second == AXIAL && i < block; ++i) out[i] *= side_weight(second, w, k, sign, i % LANES);
}

/* What the boxes' virtual work multiplies, from the kernel's inputs and its residual at z. */
INLINE void evaluate_boxes(const int dim, const int rot, const int second, const Batch *b, kernel_t kernel, const double *in,
                           const double *residual, BoxWork *w)
{
    const int nz = unknowns_of(dim, rot, second), block = nz * LANES;
    memcpy(w->z + block, in + block, sizeof(double) * (b->nstate + b->nparam) * LANES);
    for (int i = 0; i < block; ++i) w->sums[i] = -2.0 * dim * residual[i];
    for (int k = 0; k < dim; ++k) {
        const double *zk = w->zk + k * block;
        double *odd = w->sums + (1 + k) * block;
        for (int i = 0; i < block; ++i) w->z[i] = in[i] + zk[i];
        put_side(dim, rot, second, in, 1.0, k, w);
        kernel(w->z, w->up);
        weigh_side(second, 1.0, k, block, w, w->up);
        for (int i = 0; i < block; ++i) w->z[i] = in[i] - zk[i];
        put_side(dim, rot, second, in, -1.0, k, w);
        kernel(w->z, w->down);
        weigh_side(second, -1.0, k, block, w, w->down);
        for (int v = 0; v < values_of(rot, second); ++v)
            for (int l = 0; l < LANES; ++l) {
                const int slot = bent_slot(dim, rot, v) * LANES + l;
                w->both[(k * BENT + v) * LANES + l] = w->up[slot] + w->down[slot];
            }
        for (int i = 0; i < block; ++i) {
            w->sums[i] += w->up[i] + w->down[i];
            odd[i] = w->up[i] - w->down[i];
        }
    }
}

/* What the values' quadratic parts do work on, into nodal forces; `both` of a side, with a step. */
INLINE void add_bent(const int dim, const int rot, const int second, int nv, int sv, const vec *side, const double *both,
                     const int step, double weight, vec *f)
{
    for (int value = 0; value < values_of(rot, second); ++value)
        for (int v = 0; v < nv; ++v)
            f[value_component(dim, value) * sv + v] += weight * both[value * step] * side[(1 + dim) * sv + v];
}

/* The boxes' share in the residual r of a point on lane l, and what its sides add to the group's nodal forces. */
INLINE void add_sides(const int dim, const int rot, const int second, int nv, int sv, const BoxWork *w, double weight, int l, double *r,
                      vec *f)
{
    const int nz = unknowns_of(dim, rot, second);
    double side[UNKNOWNS_MAX];
    for (int i = 0; i < nz; ++i) r[i] += weight * w->sums[i * LANES + l];
    for (int k = 0; k < dim; ++k) {
        for (int i = 0; i < nz; ++i) side[i] = weight * w->sums[((1 + k) * nz + i) * LANES + l];
        add_residual(dim, rot, second == SECOND ? 0 : second, nv, sv, w->sides + (k * LANES + l) * shapes_of(second) * sv, side, f);
        add_bent(dim, rot, second, nv, sv, w->sides + (k * LANES + l) * shapes_of(second) * sv,
                 w->both + k * BENT * LANES + l, LANES, weight, f);
    }
}

/* Residuals and moduli at z + z_k and z - z_k, for all sides. */
INLINE void evaluate_sides(const int dim, const int rot, const int second, const Batch *b, kernel_t kernel, const double *in, BoxWork *w)
{
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
            for (int v = 0; v < values_of(rot, second); ++v)
                for (int l = 0; l < LANES; ++l)
                    w->z[block + known + bent_slot(dim, rot, v) * LANES + l] += w->bent_before[(k * BENT + v) * LANES + l];
            put_side(dim, rot, second, in, sign, k, w);
            kernel(w->z, w->moduli + (2 * k + down) * outputs * LANES);
        }
}

/* Shapes of lanes l .. end moved to the centre of a side, by sign times their derivatives. */
INLINE void move_shapes(const int second, int sv, const vec *shapes, const vec *side, double sign, int l, int end, vec *out)
{
    for (int64_t i = (int64_t)l * shapes_of(second) * sv; i < (int64_t)end * shapes_of(second) * sv; ++i) out[i] = shapes[i] + sign * side[i];
    for (int q = l; second == AXIAL && q < end; ++q) {  /* in the plane: three rows, and the quadratic parts */
        const int64_t first = (int64_t)q * SHAPES * sv;
        for (int v = 0; v < sv; ++v) out[first + v] += side[first + 3 * sv + v];
    }
}

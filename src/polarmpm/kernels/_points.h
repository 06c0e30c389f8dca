/* What the compiled loops share: structures, whose fields structures.py reads here, and the points' weighting
 * functions; shared by all units. */
#ifndef POLARMPM_POINTS_H
#define POLARMPM_POINTS_H

#include "_layout.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum {
    INTERFACE = 30,            /* raised with every change of a structure or signature; native.py reads it here */
    LANES = 8,                 /* points in a kernel call */
    WIDTH = 4,                 /* nodes in a vector */
    MANY = 4                   /* points whose blocks are summed at once */
};

typedef double vec __attribute__((vector_size(8 * WIDTH), aligned(8 * WIDTH)));
typedef double lanes_t __attribute__((vector_size(8 * LANES), aligned(8 * LANES)));  /* a number of LANES points */
typedef double loose_t __attribute__((vector_size(8 * LANES), aligned(8)));  /* anywhere in memory */
typedef int64_t mask_t __attribute__((vector_size(8 * LANES), aligned(8 * LANES)));  /* all bits or none of a lane */
typedef void (*kernel_t)(const double *in, double *out);

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define FAST __attribute__((target_clones("arch=x86-64-v4", "fma", "default")))
#else
#define FAST
#endif

typedef struct {
    int32_t dim, rot;          /* space dimension, rotation components of a node */
    int32_t second;            /* SECOND: z has second gradients, `orders` is 3, the state begins with F~ and H~; AXIAL: a
                                * body of revolution; else 0 */
    int32_t slots;             /* stored weights in each direction */
    int32_t orders;            /* of stored derivatives: 2, values and gradients; 3, second derivatives, too */
    int32_t nstate, nparam;
    int64_t npoints, ngroups;
    const double *weights;     /* [point][dim][value, gradient, ...][slots] */
    const int32_t *count;      /* [group][dim] nodes in each direction */
    const double *state;       /* [point][nstate]; starts with the dim x dim frame */
    const double *param;       /* [nparam], the same for all points of a batch */
    const double *volume;      /* [point] reference volume */
    const int64_t *offsets;    /* [group + 1] first point */
    const int64_t *node_offsets;  /* [group + 1] first entry of nodes */
    const int32_t *nodes;      /* local node numbers */
} Batch;

typedef struct {
    int32_t symmetric;         /* upper triangle only */
    int32_t half;              /* only pairs of a node and a later one of its group are summed */
    int32_t reach;             /* largest lattice distance of coupled nodes */
    const int32_t *place;      /* [node][(2 reach + 1)^dim] block column in the node's row, -1: none */
    const int64_t *row_start;  /* [node * block + i] address of block column 0 */
    const int64_t *number;     /* [node] global number; the row of a pair has the smaller one */
    const uint8_t *fixed;      /* [node * block + i] */
    const double *lift;        /* prescribed increments of this iteration, or NULL */
    double *values;
} Matrix;

typedef struct {
    kernel_t kernel;           /* (z, state, param [, z before]) -> residual [, upper triangle of the tangent] */
    kernel_t couple;           /* (w, m) -> residual, tangent; NULL without couples */
    const int32_t *couple_of;  /* [point] row of `couples`, -1: none */
    const double *couples;     /* [row][SPIN] */
    const double *before;      /* nodal values before the last correction, for the tangent's kernel; NULL: not needed */
    const int32_t *returned_of;  /* [point] row of `returned`, -1: evaluate the kernel; NULL: kernel for all points */
    const double *returned;    /* [row][nz (+ nz nz with tangent)] per volume, from the return mapping */
    kernel_t initial;          /* (z, frame, stress) -> what an initial stress adds to `kernel`'s; NULL: there is none */
    const double *initial_stress;  /* [point][ninitial] */
    int32_t ninitial;          /* at most INITIAL_MAX */
    kernel_t box_kernel;       /* residual of the elastic energy, for the points' boxes; NULL without boxes */
    const double *box_axes;    /* [point][dim][dim] half axes, one a row */
    const double *box_lean;    /* [point][dim][dim] the same in the frame, for values in z; NULL: there are none */
    const double *box_turns;   /* [point][dim][rot (1 + dim)] what z_k begins with, of rotations and their gradients; NULL: zero */
    const double *box_frame;   /* [point][dim][dim][dim] derivatives of the frame of the state along the half axes; NULL: it is one in a box */
    const double *box_tilt;    /* the same, by the frame: T^-1 dT; NULL with it */
    const double *box_hoop;    /* [point][dim] of bodies of revolution: what the half axes have along the radius, over it */
    const double *box_share;   /* [point] share of the boxes' energy */
    double *box_store;         /* [LANES points][polarmpm_stored] takes what polarmpm_box_work needs of a state; NULL: nothing */
} PointKernels;

typedef struct {
    int64_t npatches;
    int32_t functions, scalars;  /* of a patch, and of a point */
    int32_t modes;             /* functions times scalars */
    const int64_t *offsets;    /* [patch + 1] first node */
    const int32_t *nodes;      /* local nodes of the patches, in the order of the lattice */
    const int32_t *codes;      /* [node of a patch] distance from the patch's lowest, in a box of (2 reach + 1)^dim nodes */
    const int32_t *patch;      /* [point] of a batch */
    const int64_t *map_of;     /* [point] first entry of maps */
    const int32_t *maps;       /* node of the point's group -> node of its patch */
    const double *values;      /* [point][functions] */
} Patches;

/* Sizes of the structures as compiled; native.py compares them with those that it has read from the C text. */
#define SIZE_OF(structure) const int64_t polarmpm_size_##structure = sizeof(structure)

/* Memory for n zeros, aligned for vectors; NULL where there is none. */
static void *vectors(size_t n)
{
    const size_t line = 8 * LANES;  /* what the kernels' vectors need, and no less than a vec */
    void *p = aligned_alloc(line, (n * sizeof(double) / line + 1) * line);
    if (p) memset(p, 0, n * sizeof(double));
    return p;
}

INLINE int block_size(const Batch *b) { return b->dim + b->rot; }

static int nodes_of(const Batch *b, int64_t group)
{
    int n = 1;
    for (int d = 0; d < b->dim; ++d) n *= b->count[group * b->dim + d];
    return n;
}

static int largest_group(const Batch *b)
{
    int most = 1;
    for (int64_t g = 0; g < b->ngroups; ++g) {
        int n = nodes_of(b, g);
        if (n > most) most = n;
    }
    return most;
}

typedef double row_t __attribute__((vector_size(8 * WIDTH), aligned(8)));  /* anywhere in memory */

/* The functions of `shape` of a node and the next one in each direction, of a body in space. */
INLINE void tents(const double *w, int m, int next, int stride, double *s)
{
    const double *y = w + next, *z = y + next;
    const vec along_y = {y[0], y[0], y[1], y[1]}, slope_y = {y[m], y[m], y[m + 1], y[m + 1]};
    const vec along_z = {z[0], z[1], z[0], z[1]}, slope_z = {z[m], z[m + 1], z[m], z[m + 1]};
    const vec both = along_y * along_z, by_y = slope_y * along_z, by_z = along_y * slope_z;
    for (int i = 0; i < 2; ++i, s += WIDTH) {
        *(row_t *)s = w[i] * both;
        *(row_t *)(s + stride) = w[m + i] * both;
        *(row_t *)(s + 2 * stride) = w[i] * by_y;
        *(row_t *)(s + 3 * stride) = w[i] * by_z;
    }
}

/* Weighting functions of a point and their gradients, [value, d/dx_1, ...][stride]; in the frame if given, and then the
 * stride is a multiple of WIDTH. */
INLINE void shape(const int dim, const Batch *b, int64_t p, const int32_t *count, const double *frame, int stride,
                  double *s)
{
    const int m = b->slots, next = b->orders * m;
    const double *w = b->weights + p * dim * next, *wy = w + next, *wz = wy + next;
    const int n2 = dim == 3 ? count[2] : 1, n = count[0] * count[1] * n2;
    if (dim == 3 && count[0] == 2 && count[1] == 2 && n2 == 2) tents(w, m, next, stride, s);
    else for (int i = 0, a = 0; i < count[0]; ++i)
        for (int j = 0; j < count[1]; ++j) {
            const double v = w[i] * wy[j];
            const double dx = w[m + i] * wy[j], dy = w[i] * wy[m + j];
            for (int k = 0; k < n2; ++k, ++a) {
                s[a] = dim == 3 ? v * wz[k] : v;
                s[stride + a] = dim == 3 ? dx * wz[k] : dx;
                s[2 * stride + a] = dim == 3 ? dy * wz[k] : dy;
                if (dim == 3) s[3 * stride + a] = v * wz[m + k];
            }
        }
    for (int c = 0; c <= dim; ++c)
        for (int q = n; q < stride; ++q) s[c * stride + q] = 0.0;
    for (int a = 0; frame && a < n; a += WIDTH) {
        vec g[3];
        for (int d = 0; d < dim; ++d) g[d] = *(const row_t *)(s + (1 + d) * stride + a);
        for (int c = 0; c < dim; ++c) {
            vec sum = g[0] * frame[c];
            for (int d = 1; d < dim; ++d) sum += g[d] * frame[d * dim + c];
            *(row_t *)(s + (1 + c) * stride + a) = sum;
        }
    }
}

/* First and second derivatives of a point's functions: first [axis][stride], second [pair][stride], pairs in the order
 * xx, xy, yy or xx, xy, xz, yy, yz, zz. */
INLINE void curved_shape(const int dim, const Batch *b, int64_t p, const int32_t *count, int stride, double *first,
                         double *second)
{
    const int m = b->slots, next = b->orders * m;
    const double *w = b->weights + p * dim * next, *wy = w + next, *wz = wy + next;
    const int n2 = dim == 3 ? count[2] : 1;
    int a = 0;
    for (int i = 0; i < count[0]; ++i)
        for (int j = 0; j < count[1]; ++j) {
            const double v = w[i] * wy[j], x = w[m + i] * wy[j], y = w[i] * wy[m + j];
            const double xx = w[2 * m + i] * wy[j], xy = w[m + i] * wy[m + j], yy = w[i] * wy[2 * m + j];
            for (int k = 0; k < n2; ++k, ++a) {
                const double z = dim == 3 ? wz[k] : 1.0;
                first[a] = x * z, first[stride + a] = y * z;
                second[a] = xx * z, second[stride + a] = xy * z;
                if (dim == 3) {
                    first[2 * stride + a] = v * wz[m + k];
                    second[2 * stride + a] = x * wz[m + k], second[3 * stride + a] = yy * z;
                    second[4 * stride + a] = y * wz[m + k], second[5 * stride + a] = v * wz[2 * m + k];
                } else {
                    second[2 * stride + a] = yy;
                }
            }
        }
}

/* Writes factor times WIDTH numbers of which the first `count` are meant; what stands behind them is written later, or no
 * matter. */
INLINE void put_some(double factor, const vec *v, int count, double *out, int room)
{
    const vec value = factor * *v;
    if (room >= WIDTH) memcpy(out, &value, sizeof(vec));
    else for (int q = 0; q < count; ++q) out[q] = value[q];
}

/* Second derivatives of a point's n functions alone, [pair][stride], zero behind them: `curved_shape` with vectors. */
INLINE void second_rows(const int dim, const Batch *b, int64_t p, const int32_t *count, int n, int stride, double *out)
{
    const int m = b->slots, next = b->orders * m, last = count[dim - 1];
    const double *w = b->weights + p * dim * next, *wy = w + next, *along = w + (dim - 1) * next;
    for (int from = 0; from < last; from += WIDTH) {
        const int some = last - from < WIDTH ? last - from : WIDTH;
        vec v = {0}, g = {0}, h = {0};  /* functions of the last direction, their derivatives */
        for (int q = 0; q < some; ++q) v[q] = along[from + q], g[q] = along[m + from + q], h[q] = along[2 * m + from + q];
        for (int i = 0; i < count[0]; ++i)
            for (int j = 0; j < (dim == 3 ? count[1] : 1); ++j) {
                const int a = (dim == 3 ? i * count[1] + j : i) * last + from, room = stride - a;
                if (dim == 3) {
                    put_some(w[2 * m + i] * wy[j], &v, some, out + a, room);
                    put_some(w[m + i] * wy[m + j], &v, some, out + stride + a, room);
                    put_some(w[m + i] * wy[j], &g, some, out + 2 * stride + a, room);
                    put_some(w[i] * wy[2 * m + j], &v, some, out + 3 * stride + a, room);
                    put_some(w[i] * wy[m + j], &g, some, out + 4 * stride + a, room);
                    put_some(w[i] * wy[j], &h, some, out + 5 * stride + a, room);
                } else {
                    put_some(w[2 * m + i], &v, some, out + a, room);
                    put_some(w[m + i], &g, some, out + stride + a, room);
                    put_some(w[i], &h, some, out + 2 * stride + a, room);
                }
            }
    }
    for (int q = n; q % WIDTH; ++q)
        for (int k = 0; k < pairs_of(dim); ++k) out[k * stride + q] = 0.0;
}

/* Second derivatives of a point's weighting functions, behind those that `shape` has written to s, in the layout of
 * `pair_of`; with a frame F~, which H~ follows, w,JK = w,mn F~_mJ F~_nK + w,m H~_mJK. `raw`: room for 3 + PAIRS rows. */
INLINE void find_second_shape(const int dim, const Batch *b, int64_t p, const int32_t *count, const double *frame, int n,
                              int sv, vec *raw, vec *s)
{
    const int pairs = pairs_of(dim), nv = (n + WIDTH - 1) / WIDTH, stride = sv * WIDTH;
    double *first = (double *)raw, *second = (double *)(raw + 3 * sv), turn[PAIRS][PAIRS];
    curved_shape(dim, b, p, count, stride, first, second);
    for (int q = n; q < nv * WIDTH; ++q) {  /* what an earlier point has left beyond its nodes */
        for (int m = 0; m < dim; ++m) first[m * stride + q] = 0.0;
        for (int k = 0; k < pairs; ++k) second[k * stride + q] = 0.0;
    }
    for (int i = 0; frame && i < dim; ++i)
        for (int j = i; j < dim; ++j)
            for (int m = 0; m < dim; ++m)
                for (int l = m; l < dim; ++l) {
                    double sum = frame[m * dim + i] * frame[l * dim + j];
                    if (l > m) sum += frame[l * dim + i] * frame[m * dim + j];
                    turn[pair_of(dim, i, j)][pair_of(dim, m, l)] = sum;
                }
    const double *grown = frame ? frame + dim * dim : NULL;
    vec *out = s + (1 + dim) * sv;
    for (int v = 0; v < nv; ++v)
        for (int k = 0; k < pairs; ++k) {
            vec sum = raw[(3 + k) * sv + v];
            if (frame) {
                sum = turn[k][0] * raw[3 * sv + v];
                for (int l = 1; l < pairs; ++l) sum += turn[k][l] * raw[(3 + l) * sv + v];
                for (int m = 0; m < dim; ++m) sum += grown[m * pairs + k] * raw[m * sv + v];
            }
            out[k * sv + v] = sum;
        }
}

/* The same, compiled once: within the loops over points it would be there dozens of times. */
FAST static void second_shape(int dim, const Batch *b, int64_t p, const int32_t *count, const double *frame, int n, int sv,
                              vec *raw, vec *s)
{
    if (dim == 3) find_second_shape(3, b, p, count, frame, n, sv, raw, s);
    else find_second_shape(2, b, p, count, frame, n, sv, raw, s);
}

INLINE double dot(const int nv, const vec *a, const vec *b)
{
    vec sum = a[0] * b[0];
    for (int v = 1; v < nv; ++v) sum += a[v] * b[v];
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

/* z of a point from its group's nodal values, written with a step. */
INLINE void interpolate(const int dim, const int rot, const int second, int nv, int sv, const vec *s, const vec *x,
                        double *z, const int step)
{
    for (int i = 0; i < dim + rot; ++i) {
        double *gradient = z + gradient_slot(dim, rot, i) * step;
        if (has_value(dim, second, i)) z[value_slot(dim, rot, i) * step] = dot(nv, x + i * sv, s);
        for (int j = 0; j < dim; ++j) gradient[j * step] = dot(nv, x + i * sv, s + (1 + j) * sv);
        for (int k = 0; second == SECOND && k < pairs_of(dim); ++k)
            z[(second_slot(dim, rot, i) + k) * step] = dot(nv, x + i * sv, s + (1 + dim + k) * sv);
    }
}

#endif

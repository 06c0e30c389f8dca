/* What the compiled loops share: structures, whose fields structures.py reads here, and the points' weighting
 * functions; a part of _native.c. */
#ifndef POLARMPM_POINTS_H
#define POLARMPM_POINTS_H

#include "_layout.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum {
    INTERFACE = 10,            /* raised with every change of a structure or signature; native.py reads it here */
    LANES = 8,                 /* points in a kernel call */
    WIDTH = 4,                 /* nodes in a vector */
    MANY = 4                   /* points whose blocks are summed at once */
};

typedef double vec __attribute__((vector_size(8 * WIDTH), aligned(8 * WIDTH)));
typedef void (*kernel_t)(const double *in, double *out);

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define FAST __attribute__((target_clones("arch=x86-64-v4", "fma", "default")))
#else
#define FAST
#endif

typedef struct {
    int32_t dim, rot;          /* space dimension, rotation components of a node */
    int32_t slots;             /* stored weights in each direction */
    int32_t nstate, nparam;
    int64_t npoints, ngroups;
    const double *weights;     /* [point][dim][value, gradient][slots] */
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
} PointKernels;

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

/* Weighting functions of a point and their gradients, [value, d/dx_1, ...][stride]; in the frame if given. */
INLINE void shape(const int dim, const Batch *b, int64_t p, const int32_t *count, const double *frame, int stride,
                  double *s)
{
    const int m = b->slots;
    const double *w = b->weights + p * dim * 2 * m;
    const int n2 = dim == 3 ? count[2] : 1;
    int a = 0;
    for (int i = 0; i < count[0]; ++i)
        for (int j = 0; j < count[1]; ++j) {
            const double v = w[i] * w[2 * m + j];
            const double dx = w[m + i] * w[2 * m + j], dy = w[i] * w[3 * m + j];
            for (int k = 0; k < n2; ++k, ++a) {
                double g[3];
                if (dim == 3) {
                    const double wz = w[4 * m + k];
                    s[a] = v * wz;
                    g[0] = dx * wz;
                    g[1] = dy * wz;
                    g[2] = v * w[5 * m + k];
                } else {
                    s[a] = v;
                    g[0] = dx;
                    g[1] = dy;
                }
                for (int c = 0; c < dim; ++c) {
                    double sum = frame ? 0.0 : g[c];
                    if (frame)
                        for (int d = 0; d < dim; ++d) sum += g[d] * frame[d * dim + c];
                    s[(1 + c) * stride + a] = sum;
                }
            }
        }
    for (int c = 0; c <= dim; ++c)
        for (int q = a; q < stride; ++q) s[c * stride + q] = 0.0;
}

#endif

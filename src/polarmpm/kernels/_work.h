/* What sums over points and over elements share: memory for the evaluation of LANES points, and what of it does work; a
 * part of _native.c, _elements.c and _patches.c. */
#ifndef POLARMPM_WORK_H
#define POLARMPM_WORK_H

#include "_boxes.h"

typedef struct {
    double *in, *out, *cin, *cout, *iin, *iout, *A;
    vec *shapes, *x, *before, *f, *K;  /* shapes [lane][shapes_of(second)][sv], nodal values [component][sv] of a group */
    vec *raw, *packed;                 /* what second_shape, and add_tangents, need */
    int32_t *each, *upper;             /* [nz][nz] where moduli stand in A, and in what a kernel gives, from `out` + nz LANES on */
    lanes_t *weights, *rows;           /* of LANES points: their weights; values and derivatives, see _lanes.h */
    lanes_t *nodal, *nodal_before;     /* nodal values of the lanes' groups */
    lanes_t *forces, *sums;            /* nodal forces of lanes, and of those of a group */
    double *room;                      /* what pad_groups needs */
    int shaped;                        /* evaluation forms shapes, too; 2: and second derivatives */
    Place *at;
    int sv;                            /* vectors of the nodes of the largest group */
    int64_t gathered;                  /* the group (element) of which all nodal values are; -1: several, or none */
    BoxWork boxes;                     /* without memory where no point has a box */
} Work;

INLINE void gather_group(const int nb, int n, int sv, const int32_t *nodes, const double *x, vec *out)
{
    double *to = (double *)out;
    for (int i = 0; i < nb; ++i) {
        for (int a = 0; a < n; ++a) to[i * sv * WIDTH + a] = x[(int64_t)nodes[a] * nb + i];
        for (int a = n; a < sv * WIDTH; ++a) to[i * sv * WIDTH + a] = 0.0;
    }
}

INLINE int lanes_from(const Batch *b, int64_t start)
{
    return (int)(b->npoints - start < LANES ? b->npoints - start : LANES);
}

/* The moduli of a point, times its volume: A [nz][nz]. */
INLINE void point_moduli(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Work *w,
                         int64_t p, int l, int coupled, double *A)
{
    const int nz = unknowns_of(dim, rot, second), turn = value_slot(dim, rot, dim);
    const int64_t row = kernels->returned_of ? kernels->returned_of[p] : -1;
    const double *block = row < 0 ? NULL : kernels->returned + row * (nz + nz * nz), volume = b->volume[p];
    const double *upper = w->out + nz * LANES + l;
    if (block)
        for (int k = 0; k < nz * nz; ++k) A[k] = volume * block[nz + k];
    else
        for (int i = 0; i < nz; ++i)
            for (int j = i; j < nz; ++j, upper += LANES) A[i * nz + j] = A[j * nz + i] = volume * *upper;
    const double *more = w->iout + nz * LANES + l;
    for (int i = 0; kernels->initial && i < nz; ++i)
        for (int j = i; j < nz; ++j, more += LANES) {
            A[i * nz + j] += volume * *more;
            if (j > i) A[j * nz + i] += volume * *more;
        }
    if (coupled)
        for (int i = 0; i < SPIN; ++i)
            for (int j = 0; j < SPIN; ++j)
                A[(turn + i) * nz + turn + j] += w->cout[(SPIN * (1 + i) + j) * LANES + l];
}

/* The moduli of points l .. end of these lanes, times their volumes: as the kernel has written them where nothing else adds
 * to them. */
INLINE Moduli find_moduli(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels, const Work *w,
                          int64_t start, int l, int end, int coupled)
{
    const int nz = unknowns_of(dim, rot, second);
    int other = dim == 2 || coupled || kernels->initial;  /* in the plane, see add_few */
    for (int q = l; !other && kernels->returned_of && q < end; ++q) other |= kernels->returned_of[start + q] >= 0;
    if (!other) return (Moduli){w->out + nz * LANES + l, b->volume + start + l, w->upper, 1};
    for (int q = l; q < end; ++q)
        point_moduli(dim, rot, second, b, kernels, w, start + q, q, coupled, w->A + q * nz * nz);
    return (Moduli){w->A + l * nz * nz, NULL, w->each, nz * nz};
}

/* What a point's virtual work multiplies, times its volume, r [nz]; gradients in the point's frame. `tangent`: returned
 * ones have moduli behind it. */
INLINE void point_terms(const int dim, const int rot, const int second, const Batch *b, const PointKernels *kernels,
                        const Work *w, int64_t p, int l, int coupled, int tangent, double *r)
{
    const int nz = unknowns_of(dim, rot, second), turn = value_slot(dim, rot, dim);
    const int64_t row = kernels->returned_of ? kernels->returned_of[p] : -1;
    const double *block = row < 0 ? NULL : kernels->returned + row * (nz + (tangent ? nz * nz : 0)), volume = b->volume[p];
    for (int k = 0; k < nz; ++k) r[k] = volume * (block ? block[k] : w->out[k * LANES + l]);
    for (int k = 0; kernels->initial && k < nz; ++k) r[k] += volume * w->iout[k * LANES + l];
    if (coupled)
        for (int k = 0; k < SPIN; ++k) r[turn + k] += w->cout[k * LANES + l];
}

/* Where the entries of a symmetric matrix of lanes stand of which the upper triangle is stored, row by row: at [n][n]. */
static void set_upper(int n, int32_t *at)
{
    for (int i = 0, k = 0; i < n; ++i)
        for (int j = i; j < n; ++j, ++k) at[i * n + j] = at[j * n + i] = k * LANES;
}

/* Memory for the evaluation of points, with `scatter` for sums of a group, with `boxes` (2: for their whole tangent) for
 * the points' boxes. Returns nonzero without memory. */
static int create_work(const Batch *b, int tangent, int scatter, int boxes, Work *w)
{
    const int nb = block_size(b), nz = unknowns_of(b->dim, b->rot, b->second), largest = largest_group(b);
    const int most = scatter ? largest : 0, outputs = nz + (tangent ? nz * (nz + 1) / 2 : 0);
    const size_t sv = (largest + WIDTH - 1) / WIDTH, stride = sv * WIDTH, inputs = 2 * nz + b->nstate + b->nparam;
    const size_t padded = (size_t)nb * padded_nodes(b) * LANES;
    *w = (Work){.in = vectors(inputs * LANES), .out = vectors((size_t)outputs * LANES),
                .cin = vectors(2 * SPIN * LANES), .cout = vectors(SPIN * (1 + SPIN) * LANES),
                .iin = vectors((nz + b->dim * b->dim + INITIAL_MAX) * LANES), .iout = vectors((size_t)outputs * LANES),
                .A = vectors((size_t)LANES * nz * nz),
                .shapes = vectors(LANES * shapes_of(b->second) * stride),
                .each = malloc(sizeof(int32_t) * nz * nz), .upper = malloc(sizeof(int32_t) * nz * nz),
                .packed = vectors(tangent && scatter ? 2 * MANY * PACKED * stride : 1),
                .raw = vectors(b->second == SECOND ? (3 + PAIRS) * stride : 1), .x = vectors(nb * stride), .before = vectors(nb * stride),
                .f = vectors(nb * stride), .K = vectors(tangent && scatter ? most * nb * nb * stride : 1),
                .at = malloc(sizeof(Place) * (most + 1)), .sv = (int)sv, .gathered = -1,
                .weights = vectors((size_t)b->dim * b->orders * b->slots * LANES), .rows = vectors(nb * ROWS * LANES),
                .nodal = vectors(padded), .nodal_before = vectors(padded), .forces = vectors(scatter ? padded : 1),
                .sums = vectors(scatter ? padded : 1), .room = vectors(padded), .shaped = tangent && scatter};
    if (!(w->in && w->out && w->cin && w->cout && w->iin && w->iout && w->A && w->shapes && w->raw && w->packed && w->each && w->upper && w->x && w->before && w->f && w->K && w->at && w->weights &&
          w->rows && w->nodal && w->nodal_before && w->forces && w->sums && w->room))
        return 1;
    for (int i = 0; i < nz * nz; ++i) w->each[i] = i;
    set_upper(nz, w->upper);
    for (int k = 0; k < b->nparam; ++k)
        for (int l = 0; l < LANES; ++l) w->in[(nz + b->nstate + k) * LANES + l] = b->param[k];
    return boxes && create_boxes(b, w->sv, scatter, boxes > 1, &w->boxes);
}

static void free_work(Work *w)
{
    free(w->in), free(w->out), free(w->cin), free(w->cout), free(w->iin), free(w->iout), free(w->A);
    free(w->shapes), free(w->raw), free(w->packed), free(w->each), free(w->upper), free(w->x), free(w->before), free(w->f), free(w->K), free(w->at);
    free(w->weights), free(w->rows), free(w->nodal), free(w->nodal_before), free(w->forces), free(w->sums), free(w->room);
    free_boxes(&w->boxes);
}

#endif

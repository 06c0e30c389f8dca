/* Rows of blocks of a matrix on a lattice, in double precision, and what relaxation needs of them, in single precision;
 * shared by the units of multigrid. */
#ifndef POLARMPM_ROWS_H
#define POLARMPM_ROWS_H

#include "_points.h"

enum {
    LINE = 8,                  /* numbers of a vector in single precision */
    PIECE = 4,                 /* in double precision; wider vectors than a processor has are kept in memory */
    BLOCK_MAX = 6,             /* unknowns of a node */
    INVERSE_MAX = 8,           /* numbers of a padded column of a block's inverse, at most */
    AHEAD = 1,                 /* rows */
    PARENTS = 8                /* nodes of the coarser lattice that a node is interpolated from */
};

typedef float single_vec __attribute__((vector_size(4 * LINE), aligned(4)));
typedef float single_half __attribute__((vector_size(2 * LINE), aligned(4)));
typedef double double_vec __attribute__((vector_size(8 * PIECE), aligned(8)));
typedef double double_half __attribute__((vector_size(4 * PIECE), aligned(8)));

typedef struct {
    int32_t block;             /* unknowns of a node */
    int32_t half;              /* of a symmetric matrix: the diagonal block first, of which the upper triangle counts, then
                                * later columns; else all columns, those of this rank ascending */
    int32_t symmetric;         /* a block before the diagonal is the transposed of one behind it, and isn't read */
    int64_t nodes;             /* rows; columns beyond them are other ranks' */
    const int64_t *offsets;    /* [node + 1] first block of a row */
    const int32_t *cols;       /* [block] */
    const int64_t *row_start;  /* [node * block + i] address of block column 0 */
    double *values;
} BlockRows;

/* A run is a number of columns one after the other, whose blocks stand one after the other in the row, too: on a lattice
 * the neighbours along its last axis. Unknowns of a run are read, and written, as they stand. */
typedef struct {
    int32_t symmetric;         /* what stands before the diagonal is the transposed of what stands behind it */
    const int32_t *own;        /* [node] which block of the row the diagonal's is */
    const int64_t *up, *low;   /* [node + 1] first run behind the node; before it, and of other ranks: of symmetric matrices
                                * of other ranks only */
    const int32_t *up_cols, *low_cols;  /* [run] first column */
    const int32_t *up_at, *low_at;  /* which block of the row it is */
    const int32_t *up_long, *low_long;  /* columns */
    const int64_t *up_start, *low_start;  /* [node + 1] address of the row's runs: of each `block` lines, padded to half a vector */
    float *up_rows, *low_rows;
    const int64_t *early;      /* [node + 1] of symmetric rows: blocks before the diagonal, as they stand in other rows; in
                                * those rows only that `rest_of` is asked for */
    const int32_t *early_cols, *early_at;  /* the other row, and which block of it */
    float *own_rows;           /* [node][column][inverse_line] the diagonal's block */
    float *inverse;            /* the same of its inverse */
    float *given;              /* [node * block + LINE] of symmetric matrices: what the rows met so far have taken from a row */
    float *single;             /* [column * block + LINE] the unknowns, as the rows read them */
    double *added;             /* [node * block] to the diagonal, before it's inverted */
} Relaxation;

INLINE double block_entry(const BlockRows *A, const int nb, int64_t row, int64_t k, int i, int j)
{
    return A->values[A->row_start[row * nb + i] + k * nb + j];
}

/* Which block of a row is the diagonal's. */
INLINE int64_t own_of(const BlockRows *A, int64_t row)
{
    int64_t k = 0;
    if (!A->half)
        while (k < A->offsets[row + 1] - A->offsets[row] && A->cols[A->offsets[row] + k] != row) ++k;
    return k;
}

/* Block of the diagonal of a row, whole. */
INLINE void diagonal_block(const BlockRows *A, const int nb, int64_t row, double *D)
{
    const int64_t k = own_of(A, row);
    for (int i = 0; i < nb; ++i)
        for (int j = 0; j < nb; ++j)
            D[i * nb + j] = A->half && j < i ? block_entry(A, nb, row, k, j, i) : block_entry(A, nb, row, k, i, j);
}

/* A row is asked for in time, as its lines are too many for a processor to foresee. */
INLINE void ask_for_row(const int nb, const BlockRows *A, int64_t row)
{
    if (row >= A->nodes) return;
    const double *begin = A->values + A->row_start[row * nb];
    const int64_t numbers = (A->row_start[row * nb + nb - 1] - A->row_start[row * nb]) / (nb - 1) * nb;
    for (int64_t k = 0; k < numbers; k += LINE) __builtin_prefetch(begin + k);
}

/* Sums of a vector's numbers. */
INLINE double total(double_vec v)
{
    return (v[0] + v[2]) + (v[1] + v[3]);
}

/* Defines polarmpm_call(...), which is call_of(block, ...) with the block's size as a constant. */
#define BY_BLOCK(call, result, declared, ...)                                                                         \
    FAST static __attribute__((noinline)) result call##_2 declared { return call##_of(2, __VA_ARGS__); }             \
    FAST static __attribute__((noinline)) result call##_3 declared { return call##_of(3, __VA_ARGS__); }             \
    FAST static __attribute__((noinline)) result call##_6 declared { return call##_of(6, __VA_ARGS__); }             \
    static result call##_any declared { return call##_of(A->block, __VA_ARGS__); }

#define BLOCK_CALL(call, ...)                                                                                         \
    (A->block == 6 ? call##_6(__VA_ARGS__) : A->block == 3 ? call##_3(__VA_ARGS__) : A->block == 2 ? call##_2(__VA_ARGS__) \
     : call##_any(__VA_ARGS__))

#endif

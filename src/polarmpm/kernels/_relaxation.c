/* Products with block rows in double precision, and Gauss-Seidel relaxation of blocks with rows in single precision. The
 * driver is solvers/levels.py.
 *
 * Reading the rows is what this ought to cost. Of symmetric matrices the half behind the diagonal is read alone, and once in
 * a product or a sweep: what a row's blocks give to the row, and, transposed, what they give to the later rows. Vectors run
 * along runs of columns, in which the unknowns stand as they are needed: none is gathered. Vectors of unknowns are double;
 * those that relaxation reads are single. */
#include "_rows.h"

/* Whether a column of a row is one of those behind the diagonal, or of those before it and of other ranks. */
INLINE int belongs(const BlockRows *A, int64_t row, int64_t col, int behind)
{
    if (behind) return col > row && col < A->nodes;
    return col >= A->nodes || (!A->symmetric && col < row);
}

INLINE int64_t padded(int64_t width) { return (width + LINE / 2 - 1) / (LINE / 2) * (LINE / 2); }

/* Runs of the columns behind the diagonal, or before it: of each row its first one and the address of their numbers in single
 * precision, [node + 1], and unless NULL of each run its first column, its first block and its columns, see Relaxation. */
void polarmpm_runs(const BlockRows *A, int32_t behind, int64_t *first, int64_t *start, int32_t *cols, int32_t *at,
                   int32_t *length)
{
    int64_t run = 0, address = 0;
    for (int64_t row = 0; row < A->nodes; ++row) {
        const int32_t *mine = A->cols + A->offsets[row];
        const int64_t n = A->offsets[row + 1] - A->offsets[row];
        first[row] = run;
        start[row] = address;
        for (int64_t k = 0, end; k < n; k = end) {
            end = k + 1;
            if (!belongs(A, row, mine[k], behind)) continue;
            while (end < n && mine[end] == mine[end - 1] + 1 && belongs(A, row, mine[end], behind)) ++end;
            if (cols) cols[run] = mine[k], at[run] = (int32_t)k, length[run] = (int32_t)(end - k);
            address += A->block * padded((end - k) * A->block);
            ++run;
        }
    }
    first[A->nodes] = run;
    start[A->nodes] = address;
}

/* Which block of a row is the diagonal's. */
void polarmpm_own_blocks(const BlockRows *A, int32_t *own)
{
    for (int64_t row = 0; row < A->nodes; ++row) own[row] = (int32_t)own_of(A, row);
}

/* One side of the rows. */
typedef struct {
    const int64_t *first, *start;
    const int32_t *cols, *at, *length;
    float *rows;
} Side;

INLINE Side side_of(const Relaxation *S, int behind)
{
    return behind ? (Side){S->up, S->up_start, S->up_cols, S->up_at, S->up_long, S->up_rows}
                  : (Side){S->low, S->low_start, S->low_cols, S->low_at, S->low_long, S->low_rows};
}

/* sum += a run's lines times x. With `both` also y += these lines, transposed, times `own`. */
INLINE void multiply_run(const int nb, const int both, int64_t width, const double *const *lines, int64_t from, const double *x,
                         const double *own, double_vec *s, double_half *t, double *sum, double *y)
{
    int64_t k = 0;
    for (; k + PIECE <= width; k += PIECE) {
        const double_vec X = *(const double_vec *)(x + k);
        double_vec Y = both ? *(double_vec *)(y + k) : (double_vec){0.0};
        for (int i = 0; i < nb; ++i) {
            const double_vec R = *(const double_vec *)(lines[i] + from + k);
            s[i] += R * X;
            if (both) Y += R * own[i];
        }
        if (both) *(double_vec *)(y + k) = Y;
    }
    if (k + PIECE / 2 <= width) {
        const double_half X = *(const double_half *)(x + k);
        double_half Y = both ? *(double_half *)(y + k) : (double_half){0.0};
        for (int i = 0; i < nb; ++i) {
            const double_half R = *(const double_half *)(lines[i] + from + k);
            t[i] += R * X;
            if (both) Y += R * own[i];
        }
        if (both) *(double_half *)(y + k) = Y;
        k += PIECE / 2;
    }
    for (; k < width; ++k)
        for (int i = 0; i < nb; ++i) {
            sum[i] += lines[i][from + k] * x[k];
            if (both) y[k] += lines[i][from + k] * own[i];
        }
}

/* The block of the diagonal times the row's own unknowns. */
INLINE void multiply_own(const int nb, const int half, const double *const *lines, int64_t from, const double *own, double *sum)
{
    for (int i = 0; i < nb; ++i) sum[i] = 0.0;
    for (int i = 0; i < nb; ++i)
        for (int j = half ? i : 0; j < nb; ++j) {
            const double v = lines[i][from + j];
            sum[i] += v * own[j];
            if (half && j > i) sum[j] += v * own[i];
        }
}

/* y = A x; columns of other ranks are in x behind this one's. */
INLINE void product_of(const int nb, const BlockRows *A, const Relaxation *S, const double *x, double *y)
{
    const Side up = side_of(S, 1), low = side_of(S, 0);
    for (int64_t k = 0; k < A->nodes * nb; ++k) y[k] = 0.0;
    for (int64_t row = 0; row < A->nodes; ++row) {
        const double *lines[BLOCK_MAX], *own = x + row * nb;
        double sum[BLOCK_MAX];
        double_vec s[BLOCK_MAX];
        double_half t[BLOCK_MAX];
        ask_for_row(nb, A, row + AHEAD);
        for (int i = 0; i < nb; ++i) {
            lines[i] = A->values + A->row_start[row * nb + i];
            s[i] = (double_vec){0.0};
            t[i] = (double_half){0.0};
        }
        multiply_own(nb, A->half, lines, (int64_t)S->own[row] * nb, own, sum);
        for (int64_t r = up.first[row]; r < up.first[row + 1]; ++r) {
            const int64_t col = (int64_t)up.cols[r] * nb, from = (int64_t)up.at[r] * nb, width = (int64_t)up.length[r] * nb;
            if (A->symmetric) multiply_run(nb, 1, width, lines, from, x + col, own, s, t, sum, y + col);
            else multiply_run(nb, 0, width, lines, from, x + col, own, s, t, sum, y);
        }
        for (int64_t r = low.first[row]; r < low.first[row + 1]; ++r)
            multiply_run(nb, 0, (int64_t)low.length[r] * nb, lines, (int64_t)low.at[r] * nb, x + (int64_t)low.cols[r] * nb, own, s,
                         t, sum, y);
        for (int i = 0; i < nb; ++i) y[row * nb + i] += sum[i] + total(s[i]) + (t[i][0] + t[i][1]);
    }
}

/* rows in single precision ---------------------------------------------------------------------------------------------- */

/* Numbers of a padded column of a block's inverse. */
INLINE int inverse_line(const int nb) { return nb > PIECE ? INVERSE_MAX : PIECE; }

/* `some` numbers of a line, in single precision, zeros up to n; *bad becomes NaN where one isn't finite. */
INLINE void copy_some(const double *from, int64_t some, int64_t n, float *out, single_half *bad)
{
    int64_t k = 0;
    for (; k + PIECE <= some; k += PIECE) {
        const single_half v = __builtin_convertvector(*(const double_vec *)(from + k), single_half);
        *(single_half *)(out + k) = v;
        *bad += v * 0.0f;
    }
    for (; k < some; ++k) {
        out[k] = (float)from[k];
        (*bad)[0] += out[k] * 0.0f;
    }
    for (; k < n; ++k) out[k] = 0.0f;
}

/* One side of a row in single precision: of each run all lines of a vector's columns, of the next ones, of half a vector. */
INLINE void copy_runs(const int nb, const BlockRows *A, int64_t row, const Side *side, single_half *bad)
{
    float *out = side->rows + side->start[row];
    for (int64_t r = side->first[row]; r < side->first[row + 1]; ++r) {
        const int64_t width = (int64_t)side->length[r] * nb, whole = padded(width), first = (int64_t)side->at[r] * nb;
        const double *lines[BLOCK_MAX];
        int64_t k = 0;
        for (int i = 0; i < nb; ++i) lines[i] = A->values + A->row_start[row * nb + i] + first;
        for (; k + LINE <= whole; k += LINE)
            for (int i = 0; i < nb; ++i, out += LINE)
                copy_some(lines[i] + k, k + LINE <= width ? LINE : width - k, LINE, out, bad);
        for (int i = 0; k < whole && i < nb; ++i, out += LINE / 2) copy_some(lines[i] + k, width - k, LINE / 2, out, bad);
    }
}

/* Inverse of a block with its diagonal scaled to one; where that is singular, of its diagonal. Rows of a zero diagonal
 * are zero. Column after column, each padded. */
INLINE void invert(const int nb, const double *D, float *out)
{
    double a[BLOCK_MAX][2 * BLOCK_MAX], scale[BLOCK_MAX];
    int singular = 0;
    for (int i = 0; i < nb; ++i) scale[i] = D[i * nb + i] != 0.0 ? 1.0 / sqrt(fabs(D[i * nb + i])) : 0.0;
    for (int i = 0; i < nb; ++i)
        for (int j = 0; j < nb; ++j) {
            a[i][j] = scale[i] * D[i * nb + j] * scale[j] + (i == j && scale[i] == 0.0);
            a[i][nb + j] = i == j;
        }
    for (int k = 0; k < nb && !singular; ++k) {
        int best = k;
        for (int i = k + 1; i < nb; ++i)
            if (fabs(a[i][k]) > fabs(a[best][k])) best = i;
        singular = !(fabs(a[best][k]) > 1e-10);
        if (singular) break;
        for (int j = 0; j < 2 * nb; ++j) {
            const double kept = a[k][j];
            a[k][j] = a[best][j];
            a[best][j] = kept;
        }
        const double pivot = 1.0 / a[k][k];
        for (int j = 0; j < 2 * nb; ++j) a[k][j] *= pivot;
        for (int i = 0; i < nb; ++i) {
            const double factor = a[i][k];
            if (i == k || factor == 0.0) continue;
            for (int j = 0; j < 2 * nb; ++j) a[i][j] -= factor * a[k][j];
        }
    }
    for (int j = 0; j < nb; ++j)
        for (int i = 0; i < nb; ++i) {
            const double plain = i == j && D[i * nb + i] != 0.0 ? 1.0 / D[i * nb + i] : 0.0;
            out[j * inverse_line(nb) + i] = (float)(singular ? plain : scale[i] * a[i][nb + j] * scale[j]);
        }
}

INLINE void fill_of(const int nb, const BlockRows *A, const Relaxation *S, double lift, int64_t *bad)
{
    const Side up = side_of(S, 1), low = side_of(S, 0);
    single_half sum = {0.0f};
    for (int64_t row = 0; row < A->nodes; ++row) {
        double D[BLOCK_MAX * BLOCK_MAX], *added = S->added + row * nb;
        float *inverse = S->inverse + row * nb * inverse_line(nb);
        ask_for_row(nb, A, row + AHEAD);
        copy_runs(nb, A, row, &low, &sum);
        copy_runs(nb, A, row, &up, &sum);
        diagonal_block(A, nb, row, D);
        for (int i = 0; i < nb; ++i)
            for (int j = 0; j < nb; ++j) S->own_rows[(row * nb + j) * inverse_line(nb) + i] = (float)D[i * nb + j];
        for (int i = 0; i < nb; ++i) {
            added[i] += lift * fabs(D[i * nb + i]);
            D[i * nb + i] += added[i];
        }
        invert(nb, D, inverse);
        for (int i = 0; i < nb; ++i)
            for (int j = 0; j < nb; ++j) *bad += !isfinite(D[i * nb + j]) || !isfinite(inverse[j * inverse_line(nb) + i]);
    }
    *bad += (sum[0] + sum[1]) + (sum[2] + sum[3]) != 0.0f;
}

/* relaxation -------------------------------------------------------------------------------------------------------------- */

INLINE float single_total(single_vec v, single_half w)
{
    const single_half h = {v[0] + v[4], v[1] + v[5], v[2] + v[6], v[3] + v[7]}, sum = h + w;
    return (sum[0] + sum[2]) + (sum[1] + sum[3]);
}

/* s, t += a vector's length, or half of it, of a run's lines times x. */
INLINE void add_vector(const int nb, const float *rows, const float *x, single_vec *s)
{
    for (int i = 0; i < nb; ++i) s[i] += *(const single_vec *)(rows + i * LINE) * *(const single_vec *)x;
}

INLINE void add_half(const int nb, const float *rows, const float *x, single_half *t)
{
    for (int i = 0; i < nb; ++i) t[i] += *(const single_half *)(rows + i * (LINE / 2)) * *(const single_half *)x;
}

/* sum -= one side of a row times x. With `back` from its end to its beginning: a sweep that goes the same way then meets
 * memory in one direction, and processors fetch it in time. */
INLINE void subtract_runs(const int nb, const int back, const Side *side, int64_t row, const float *x, double *sum)
{
    const int64_t begin = side->first[row], runs = side->first[row + 1] - begin;
    const float *rows = side->rows + side->start[row + back];
    single_vec s[BLOCK_MAX];
    single_half t[BLOCK_MAX];
    if (runs == 0) return;
    for (int i = 0; i < nb; ++i) s[i] = (single_vec){0.0f}, t[i] = (single_half){0.0f};
    for (int64_t k = 0; k < runs; ++k) {
        const int64_t r = back ? begin + runs - 1 - k : begin + k, width = padded((int64_t)side->length[r] * nb);
        const float *v = x + (int64_t)side->cols[r] * nb;
        const int64_t whole = width / LINE * LINE;
        if (back) {
            if (whole < width) add_half(nb, rows -= nb * (LINE / 2), v + whole, t);
            for (int64_t j = whole; j > 0; j -= LINE) add_vector(nb, rows -= nb * LINE, v + j - LINE, s);
        } else {
            for (int64_t j = 0; j < whole; j += LINE, rows += nb * LINE) add_vector(nb, rows, v + j, s);
            if (whole < width) add_half(nb, rows, v + whole, t), rows += nb * (LINE / 2);
        }
    }
    for (int i = 0; i < nb; ++i) sum[i] -= single_total(s[i], t[i]);
}

/* given -= one side of a row, transposed, times x of this row */
INLINE void give_runs(const int nb, const Side *side, int64_t row, const float *x, float *given)
{
    const float *rows = side->rows + side->start[row];
    for (int64_t r = side->first[row]; r < side->first[row + 1]; ++r) {
        float *out = given + (int64_t)side->cols[r] * nb, *end = out + padded((int64_t)side->length[r] * nb);
        for (; out + LINE <= end; out += LINE, rows += nb * LINE) {
            single_vec v = *(const single_vec *)rows * x[0];
            for (int i = 1; i < nb; ++i) v += *(const single_vec *)(rows + i * LINE) * x[i];
            *(single_vec *)out -= v;
        }
        if (out < end) {
            single_half v = *(const single_half *)rows * x[0];
            for (int i = 1; i < nb; ++i) v += *(const single_half *)(rows + i * (LINE / 2)) * x[i];
            *(single_half *)out -= v;
            rows += nb * (LINE / 2);
        }
    }
}

/* x = inverse times sum, in both precisions. */
INLINE void put_solution(const int nb, const float *inverse, const double *sum, double *x, float *single)
{
    const int line = inverse_line(nb);
    double_vec v = {0.0}, w = {0.0};
    for (int j = 0; j < nb; ++j) {
        v += __builtin_convertvector(*(const single_half *)(inverse + j * line), double_vec) * sum[j];
        if (nb > PIECE) w += __builtin_convertvector(*(const single_half *)(inverse + j * line + PIECE), double_vec) * sum[j];
    }
    for (int i = 0; i < nb; ++i) {
        x[i] = i < PIECE ? v[i % PIECE] : w[i % PIECE];
        single[i] = (float)x[i];
    }
}

INLINE void to_single(int64_t n, const double *x, float *out)
{
    int64_t k = 0;
    for (; k + PIECE <= n; k += PIECE)
        *(single_half *)(out + k) = __builtin_convertvector(*(const double_vec *)(x + k), single_half);
    for (; k < n; ++k) out[k] = (float)x[k];
}

enum { FROM_ZERO = 0, BACKWARD = 1, FORWARD = 2, REST = 3 };

/* FROM_ZERO: x = (D + U)^-1 b, from the last row to the first; BACKWARD, FORWARD: a sweep; REST: b = what the sweep before,
 * if it began with zero, leaves of it. D has what is added. Of symmetric matrices `given` is L x after FROM_ZERO and
 * BACKWARD, the latter needs what the sweep before has left there, and FORWARD begins anew. `columns` of x are known. */
INLINE void relax_of(const int nb, int64_t nodes, const Relaxation *S, int how, int64_t columns, double *b, double *x)
{
    const Side up = side_of(S, 1), low = side_of(S, 0);
    if (S->symmetric && (how == FROM_ZERO || how == FORWARD)) memset(S->given, 0, sizeof(float) * nodes * nb);
    if (how != FROM_ZERO) to_single(columns * nb, x, S->single);
    for (int64_t k = 0; k < nodes; ++k) {
        const int64_t row = how == FROM_ZERO || how == BACKWARD ? nodes - 1 - k : k;
        double sum[BLOCK_MAX];
        for (int i = 0; i < nb; ++i) {
            sum[i] = how == REST ? 0.0 : b[row * nb + i];
            if (how != FROM_ZERO) sum[i] += S->added[row * nb + i] * x[row * nb + i];
            if (S->symmetric && how != FROM_ZERO) sum[i] += S->given[row * nb + i];
            if (S->symmetric && how == BACKWARD) S->given[row * nb + i] = 0.0f;
        }
        if (how != FROM_ZERO) subtract_runs(nb, 0, &low, row, S->single, sum);
        if (how == REST) {
            for (int i = 0; i < nb; ++i) b[row * nb + i] = sum[i];
            continue;
        }
        if (how == FORWARD) subtract_runs(nb, 0, &up, row, S->single, sum);
        else subtract_runs(nb, 1, &up, row, S->single, sum);
        put_solution(nb, S->inverse + row * nb * inverse_line(nb), sum, x + row * nb, S->single + row * nb);
        if (S->symmetric) give_runs(nb, &up, row, S->single + row * nb, S->given);
    }
}

/* s += half a vector's columns of `nb` lines, which stand `line` numbers apart, times x; with `both` also y += these,
 * transposed, times `own`. */
INLINE void multiply_half(const int nb, const int both, const float *rows, const int line, const double *x, const double *own,
                          double_vec *s, double *y)
{
    const double_vec X = *(const double_vec *)x;
    double_vec Y = both ? *(double_vec *)y : (double_vec){0.0};
    for (int i = 0; i < nb; ++i) {
        const double_vec R = __builtin_convertvector(*(const single_half *)(rows + i * line), double_vec);
        s[i] += R * X;
        if (both) Y += R * own[i];
    }
    if (both) *(double_vec *)y = Y;
}

/* A side of a row. */
INLINE void multiply_side(const int nb, const int both, const Side *side, int64_t row, const double *x, const double *own,
                          double_vec *s, double *y)
{
    const float *rows = side->rows + side->start[row];
    for (int64_t r = side->first[row]; r < side->first[row + 1]; ++r) {
        const int64_t col = (int64_t)side->cols[r] * nb, width = padded((int64_t)side->length[r] * nb);
        int64_t k = 0;
        for (; k + LINE <= width; k += LINE, rows += nb * LINE) {
            multiply_half(nb, both, rows, LINE, x + col + k, own, s, y + col + k);
            multiply_half(nb, both, rows + PIECE, LINE, x + col + k + PIECE, own, s, y + col + k + PIECE);
        }
        if (k < width) {
            multiply_half(nb, both, rows, LINE / 2, x + col + k, own, s, y + col + k);
            rows += nb * (LINE / 2);
        }
    }
}

/* y = A x with the rows in single precision, all sums in double. Behind x and y there is room for LINE numbers. */
INLINE void quick_product_of(const int nb, const BlockRows *A, const Relaxation *S, const double *x, double *y)
{
    const Side up = side_of(S, 1), low = side_of(S, 0);
    const int line = inverse_line(nb);
    for (int64_t k = 0; k < A->nodes * nb; ++k) y[k] = 0.0;
    for (int64_t row = 0; row < A->nodes; ++row) {
        const double *own = x + row * nb;
        double_vec s[BLOCK_MAX];
        double sum[BLOCK_MAX];
        for (int i = 0; i < nb; ++i) s[i] = (double_vec){0.0}, sum[i] = 0.0;
        for (int i = 0; i < nb; ++i)
            for (int j = 0; j < nb; ++j) sum[i] += S->own_rows[(row * nb + j) * line + i] * own[j];
        if (A->symmetric) multiply_side(nb, 1, &up, row, x, own, s, y);
        else multiply_side(nb, 0, &up, row, x, own, s, y);
        multiply_side(nb, 0, &low, row, x, own, s, y);
        for (int i = 0; i < nb; ++i) y[row * nb + i] += sum[i] + total(s[i]);
    }
}

/* r = b - A x in double precision, in some rows only. */
INLINE void rest_of(const int nb, const BlockRows *A, const Relaxation *S, int64_t count, const int64_t *rows,
                    const double *b, const double *x, double *r)
{
    for (int64_t c = 0; c < count; ++c) {
        const int64_t row = rows[c], n = A->offsets[row + 1] - A->offsets[row];
        const int32_t *cols = A->cols + A->offsets[row];
        double D[BLOCK_MAX * BLOCK_MAX], sum[BLOCK_MAX];
        diagonal_block(A, nb, row, D);
        for (int i = 0; i < nb; ++i) {
            sum[i] = b[row * nb + i];
            for (int j = 0; j < nb; ++j) sum[i] -= D[i * nb + j] * x[row * nb + j];
        }
        for (int64_t a = A->symmetric ? S->early[row] : 0; A->symmetric && a < S->early[row + 1]; ++a)
            for (int i = 0; i < nb; ++i)
                for (int j = 0; j < nb; ++j)
                    sum[i] -= block_entry(A, nb, S->early_cols[a], S->early_at[a], j, i) * x[(int64_t)S->early_cols[a] * nb + j];
        for (int64_t k = 0; k < n; ++k) {
            if (cols[k] == row || (A->symmetric && cols[k] < row)) continue;
            for (int i = 0; i < nb; ++i)
                for (int j = 0; j < nb; ++j) sum[i] -= block_entry(A, nb, row, k, i, j) * x[(int64_t)cols[k] * nb + j];
        }
        for (int i = 0; i < nb; ++i) r[row * nb + i] = sum[i];
    }
}

BY_BLOCK(product, void, (const BlockRows *A, const Relaxation *S, const double *x, double *y), A, S, x, y)
BY_BLOCK(quick_product, void, (const BlockRows *A, const Relaxation *S, const double *x, double *y), A, S, x, y)
BY_BLOCK(fill, void, (const BlockRows *A, const Relaxation *S, double lift, int64_t *bad), A, S, lift, bad)
BY_BLOCK(relax, void, (const BlockRows *A, const Relaxation *S, int how, int64_t columns, double *b, double *x), A->nodes, S,
         how, columns, b, x)
BY_BLOCK(rest, void, (const BlockRows *A, const Relaxation *S, int64_t count, const int64_t *rows, const double *b,
         const double *x, double *r), A, S, count, rows, b, x, r)

void polarmpm_block_product(const BlockRows *A, const Relaxation *S, const double *x, double *y)
{
    BLOCK_CALL(product, A, S, x, y);
}

void polarmpm_quick_product(const BlockRows *A, const Relaxation *S, const double *x, double *y)
{
    BLOCK_CALL(quick_product, A, S, x, y);
}

/* Returns whether there are numbers that aren't finite. */
int polarmpm_relaxation(const BlockRows *A, const Relaxation *S, double lift)
{
    int64_t bad = 0;
    BLOCK_CALL(fill, A, S, lift, &bad);
    return bad != 0;
}

void polarmpm_relax(const BlockRows *A, const Relaxation *S, int32_t how, int64_t columns, double *b, double *x)
{
    BLOCK_CALL(relax, A, S, how, columns, b, x);
}

void polarmpm_rest(const BlockRows *A, const Relaxation *S, int64_t count, const int64_t *rows, const double *b,
                   const double *x, double *r)
{
    BLOCK_CALL(rest, A, S, count, rows, b, x, r);
}

SIZE_OF(BlockRows);
SIZE_OF(Relaxation);

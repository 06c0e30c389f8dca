/* Factors of small matrices whose unknowns, in a good order, are coupled to near ones only, as those of slender bodies.
 * Matrices have a symmetric pattern, and rows (`block` for a node) in compressed storage, whose upper
 * triangle is enough where they are symmetric. Rows of the factor's upper triangle U, and columns of its lower one L, go from
 * the diagonal to the last entry that the factor has; of symmetric matrices L is the transpose of U, and isn't stored. There
 * is no pivoting: who solves looks at what is left. */
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

#define PIECES 4
#define SIZED_AS(name) name##_narrow
#define ALONE FAST
#include "_bandloops.h"
#undef PIECES
#undef SIZED_AS
#undef ALONE

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define PIECES 8
#define SIZED_AS(name) name##_wide
#define ALONE __attribute__((target("arch=x86-64-v4")))
#include "_bandloops.h"
#define BY_WIDTH(call) (__builtin_cpu_supports("x86-64-v4") ? call##_wide : call##_narrow)
#else
#define BY_WIDTH(call) call##_narrow
#endif

/* Factors of a matrix whose diagonal is larger by a share `shift`: Cholesky's where it is symmetric, else L U, L behind U.
 * LANES numbers in front of `factor` are read. Returns nonzero where it isn't definite, or a pivot is zero. */
int polarmpm_band_factor(int64_t n, int32_t block, int32_t symmetric, const int64_t *begin, int64_t entries,
                         const int64_t *place, const double *values, double shift, double *factor)
{
    return BY_WIDTH(factor)(n, block, symmetric, begin, entries, place, values, shift, factor);
}

/* Solution of a system by its factors; `work`: n numbers. */
void polarmpm_band_solve(int64_t n, int32_t block, int32_t symmetric, const int32_t *position, const int64_t *begin,
                         const double *factor, const double *right, double *work, double *out)
{
    BY_WIDTH(solve)(n, block, symmetric, position, begin, factor, right, work, out);
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

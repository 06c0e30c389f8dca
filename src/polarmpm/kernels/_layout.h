/* Where the unknowns z = (du/dx, w, dw/dx) of a point stand, or z = (du/dx, d2u/dx2) with second gradients, or z = (du/dx,
 * w, dw/dx, u_r) in a body of revolution; shared by all units. `second` says which of them.
 *
 * The table is kinematics/layout.py's, and tests/kernels/test_slots.py holds this file against it. A component counts
 * the unknowns of a node: displacements, then rotations. Called with constants, all of this is constant, too. The sums
 * treat values and gradients one after the other: one loop over both, which asks for each slot, took a tenth longer. */
#ifndef POLARMPM_LAYOUT_H
#define POLARMPM_LAYOUT_H

#define INLINE static inline __attribute__((always_inline))

enum {
    SHAPES = 4,                /* a weighting function and its derivatives, in space */
    SECOND_SHAPES = 10,        /* and its second derivatives, too */
    PAIRS = 6,                 /* different second derivatives in space */
    UNKNOWNS_MAX = 27,         /* length of z in space with second gradients; 21 with rotations */
    INITIAL_MAX = 39,          /* numbers of an initial stress, in space with second gradients; 18 with rotations */
    SPIN = 3,                  /* components of a rotation, and of a couple, in space */
    SECOND = 1, AXIAL = 2,     /* what `second` is, zero else: with second gradients, in a body of revolution */
    AT_HOOP = 1                /* of its points, in the state behind the frame: the hoop's frame over the radius */
};

/* Different second derivatives, in the order xx, xy, yy or xx, xy, xz, yy, yz, zz. */
INLINE int pairs_of(int dim) { return dim * (dim + 1) / 2; }

INLINE int pair_of(const int dim, int i, int j)
{
    const int low = i < j ? i : j, high = i < j ? j : i;
    return dim == 2 ? low + high : low == 0 ? high : low + high + 1;
}

/* Length of z. */
INLINE int unknowns_of(int dim, int rot, int second)
{
    return dim * dim + rot * (1 + dim) + (second == SECOND) * dim * pairs_of(dim) + (second == AXIAL);
}

/* Rows of a point's shapes: the function, its derivatives, and its second ones. */
INLINE int shapes_of(int second) { return second == SECOND ? SECOND_SHAPES : SHAPES; }

/* Whether z holds the component itself, beside its gradient. */
INLINE int has_value(int dim, int second, int component)
{
    return component >= dim || (second == AXIAL && component == 0);
}

/* That of a displacement stands behind all else. */
INLINE int value_slot(int dim, int rot, int component)
{
    return component < dim ? dim * dim + rot * (1 + dim) + component : dim * dim + component - dim;
}

/* First of a component's `dim` derivatives, one after the other. */
INLINE int gradient_slot(int dim, int rot, int component)
{
    return component < dim ? dim * component : dim * dim + rot + dim * (component - dim);
}

/* First of a displacement's second derivatives, in the order of pair_of; they stand behind all that is said above. */
INLINE int second_slot(int dim, int rot, int component)
{
    return dim * dim + rot * (1 + dim) + pairs_of(dim) * component;
}

/* Without second gradients, the slots before this one hold all that belongs to this component and to those before it. */
INLINE int end_slot(int dim, int rot, int component) { return gradient_slot(dim, rot, component) + dim; }

/* Defines call_sized(...), which is call(dim, rot, second, ...) with the sizes of a batch as constants. Each size is
 * compiled as a function of its own: one function that held all of them was up to a sixth slower, and longer to compile.
 * `declared` are the parameters in parentheses; their names follow, first that of what has the sizes. */
#define SPECIALISED(call, declared, b, ...)                                                                           \
    SIZED(call##_300, declared, call(3, 0, 0, b, __VA_ARGS__))                                                        \
    SIZED(call##_330, declared, call(3, 3, 0, b, __VA_ARGS__))                                                        \
    SIZED(call##_200, declared, call(2, 0, 0, b, __VA_ARGS__))                                                        \
    SIZED(call##_210, declared, call(2, 1, 0, b, __VA_ARGS__))                                                        \
    SIZED(call##_301, declared, call(3, 0, 1, b, __VA_ARGS__))                                                        \
    SIZED(call##_201, declared, call(2, 0, 1, b, __VA_ARGS__))                                                        \
    SIZED(call##_202, declared, call(2, 0, 2, b, __VA_ARGS__))                                                        \
    SIZED(call##_212, declared, call(2, 1, 2, b, __VA_ARGS__))                                                        \
    static void call##_sized declared                                                                                 \
    {                                                                                                                 \
        if ((b)->second == SECOND && (b)->dim == 3) call##_301(b, __VA_ARGS__);                                       \
        else if ((b)->second == SECOND) call##_201(b, __VA_ARGS__);                                                   \
        else if ((b)->second && (b)->rot == 1) call##_212(b, __VA_ARGS__);                                            \
        else if ((b)->second) call##_202(b, __VA_ARGS__);                                                             \
        else if ((b)->dim == 3 && (b)->rot == 3) call##_330(b, __VA_ARGS__);                                          \
        else if ((b)->dim == 3) call##_300(b, __VA_ARGS__);                                                           \
        else if ((b)->rot == 1) call##_210(b, __VA_ARGS__);                                                           \
        else call##_200(b, __VA_ARGS__);                                                                              \
    }

/* The same of what has no second gradients. */
#define SPECIALISED_PLAIN(call, declared, b, ...)                                                                     \
    SIZED(call##_300, declared, call(3, 0, 0, b, __VA_ARGS__))                                                        \
    SIZED(call##_330, declared, call(3, 3, 0, b, __VA_ARGS__))                                                        \
    SIZED(call##_200, declared, call(2, 0, 0, b, __VA_ARGS__))                                                        \
    SIZED(call##_210, declared, call(2, 1, 0, b, __VA_ARGS__))                                                        \
    SIZED(call##_202, declared, call(2, 0, 2, b, __VA_ARGS__))                                                        \
    SIZED(call##_212, declared, call(2, 1, 2, b, __VA_ARGS__))                                                        \
    static void call##_sized declared                                                                                 \
    {                                                                                                                 \
        if ((b)->dim == 3 && (b)->rot == 3) call##_330(b, __VA_ARGS__);                                               \
        else if ((b)->dim == 3) call##_300(b, __VA_ARGS__);                                                           \
        else if ((b)->second && (b)->rot == 1) call##_212(b, __VA_ARGS__);                                            \
        else if ((b)->second) call##_202(b, __VA_ARGS__);                                                             \
        else if ((b)->rot == 1) call##_210(b, __VA_ARGS__);                                                           \
        else call##_200(b, __VA_ARGS__);                                                                              \
    }

#define SIZED(name, declared, call)                                                                                   \
    FAST static __attribute__((noinline)) void name declared { call; }

#endif

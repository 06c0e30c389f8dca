/* Where the unknowns z = (du/dx, w, dw/dx) of a point stand; a part of _native.c.
 *
 * The table is kinematics/layout.py's, and tests/kernels/test_slots.py holds this file against it. A component counts
 * the unknowns of a node: displacements, then rotations. Called with constants, all of this is constant, too. The sums
 * treat values and gradients one after the other: one loop over both, which asks for each slot, took a tenth longer. */
#ifndef POLARMPM_LAYOUT_H
#define POLARMPM_LAYOUT_H

#define INLINE static inline __attribute__((always_inline))

enum {
    SHAPES = 4,                /* a weighting function and its derivatives, in space */
    UNKNOWNS_MAX = 21,         /* length of z in space with rotations */
    INITIAL_MAX = 18,          /* numbers of an initial stress, in space with rotations */
    SPIN = 3                   /* components of a rotation, and of a couple, in space */
};

/* Length of z. */
INLINE int unknowns_of(int dim, int rot) { return dim * dim + rot * (1 + dim); }

/* Whether z holds the component itself, beside its gradient. */
INLINE int has_value(int dim, int component) { return component >= dim; }

INLINE int value_slot(int dim, int rot, int component) { return dim * dim + component - dim; }

/* First of a component's `dim` derivatives, one after the other. */
INLINE int gradient_slot(int dim, int rot, int component)
{
    return component < dim ? dim * component : dim * dim + rot + dim * (component - dim);
}

/* The slots before this one hold all that belongs to this component and to those before it. */
INLINE int end_slot(int dim, int rot, int component) { return gradient_slot(dim, rot, component) + dim; }

/* call(dim, rot, ...) with the sizes of a batch as constants. */
#define SPECIALISED(call, b, ...)                                                                                     \
    do {                                                                                                              \
        if ((b)->dim == 3 && (b)->rot == 3) call(3, 3, b, __VA_ARGS__);                                               \
        else if ((b)->dim == 3) call(3, 0, b, __VA_ARGS__);                                                           \
        else if ((b)->rot == 1) call(2, 1, b, __VA_ARGS__);                                                           \
        else call(2, 0, b, __VA_ARGS__);                                                                              \
    } while (0)

#endif

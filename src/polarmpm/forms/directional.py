"""Derivatives of the points' kernels in a direction: of unknowns, state and parameters at once.

A tangent-linear run asks for the derivative of stresses where z, what a point has been through and the
material's numbers all change by a little, in a given way. UFL derives the form in that direction, which is as
much code as the form itself, not as its tangent. Inputs are those of the kernel, each group of them followed
by its change: (z, dz, state, dstate, parameters, dparameters).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

from mpi4py import MPI

import ufl

from ..kernels import codegen
from ..kernels.kernel import Kernel, PointSpace, Slots, compile_expressions
from ..kinematics.motion import Motion
from .initialstress import InitialKernels
from .plastic import PlasticForm
from .points import PointForm
from .projected import ProjectedForm
from .returns import LocalProblem, Program, Vector, compile_functions


class Direction:
    """Coefficients of a kernel, and others by which they change.

    Args:
        terminals: of the kernel.
        groups: into how many inputs, one after the other, its input is divided.

    Attributes:
        terminals: of the kernels of derivatives.
        inputs: how long their input is.
    """

    def __init__(self, space: PointSpace, terminals: Slots, groups: Sequence[int]):
        self.space, self._changes = space, {c: space.coefficient(c.ufl_shape[0]) for c in terminals}
        starts = [sum(groups[:k]) for k in range(len(groups))]

        def doubled(slot: int, change: bool) -> int:
            k = max(k for k, start in enumerate(starts) if slot >= start and groups[k])
            return slot + starts[k] + (groups[k] if change else 0)

        self.terminals: dict[Any, int | tuple[int, ...]] = {}
        for c, change in self._changes.items():
            first = terminals[c]
            slots = range(first, first + c.ufl_shape[0]) if isinstance(first, int) else first
            self.terminals[c] = tuple(doubled(slot, False) for slot in slots)
            self.terminals[change] = tuple(doubled(slot, True) for slot in slots)
        self.inputs = 2 * sum(groups)

    def along(self, expression: Any, without: Sequence[Any] = ()) -> Any:
        """An expression's derivative; some coefficients stay."""
        return sum(ufl.derivative(expression, c, d) for c, d in self._changes.items() if c not in without)

    def compiled(self, name: str, part: Any, size: int, comm: MPI.Comm, of: str) -> Kernel:
        """The kernel of a `Vector`, or of a list of UFL scalars; `of`: the code of the kernel of which these
        are derivatives. Collective."""
        functions, known = {name: part if isinstance(part, list) else [part]}, ["along", of] if of else []
        program = Program(functions, self.terminals, self.inputs, self.space)
        kernels = compile_functions(name, lambda: program, comm, known)
        assert kernels[name].outputs == size
        return kernels[name]


class FormAlong:
    """Derivatives of a material's point form. Kernels are compiled when they are asked for first; collective.

    Attributes:
        form: what is derived; groups of input are z, the packed state and parameters.
    """

    def __init__(self, form: PointForm, comm: MPI.Comm):
        self.form, self.comm = form, comm
        numbers = form.inputs - form.layout.unknowns - form.packed_size
        self._groups = [form.layout.unknowns, form.packed_size, numbers]
        self._direction = Direction(form.space, _terminals(form), self._groups)
        self._returns: dict[str, tuple[Kernel, Kernel]] = {}

    def _vector(self, form: Any) -> Vector:
        return Vector(form, self.form.unknowns)

    @cached_property
    def residual(self) -> Kernel:
        """Of the residual (nz), with stiff scalars of L_z and L_t (nz + m), at constant pi."""
        d = self._direction
        form = d.along(codegen.integrand(self.form.residual))
        return d.compiled("along", self._vector(form), self.form.unknowns, self.comm, self.form.code)

    @cached_property
    def measure(self) -> Kernel:
        """Of the stiff scalars (m)."""
        form, d = self.form, self._direction
        assert isinstance(form, ProjectedForm)
        rows = [d.along(e) for e in form.scalars_now]
        return d.compiled("measure_along", rows, form.scalars, self.comm, form.code)

    @cached_property
    def bent(self) -> Kernel:
        """Of pi . e_z at constant pi (nz + m)."""
        form, d = self.form, self._direction
        assert isinstance(form, ProjectedForm)
        test = ufl.TestFunction(form.space.function_space(form.unknowns))
        e = sum(form.extra[k] * one for k, one in enumerate(form.scalars_now))
        row = d.along(ufl.derivative(e, form.z, test))
        return d.compiled("bent_along", self._vector(row), form.unknowns, self.comm, form.code)

    @cached_property
    def moved(self) -> Kernel:
        """Of the projected F (3, 3) in the frame of the state."""
        form, d = self.form, self._direction
        assert isinstance(form, ProjectedForm)
        rows = d.along(form.moved.F)
        known = ["moved along", form.code] if form.code else []
        return compile_expressions([rows], d.terminals, d.inputs, form.space.domain, self.comm, known)

    @cached_property
    def moduli(self) -> Kernel:
        """Of the elastic tangent times a constant vector, which stands in the place of dz."""
        form, d = self.form, self._direction
        vector = d._changes[form.z]
        work = ufl.derivative(codegen.integrand(form.residual), form.z, vector)
        row = d.along(work, without=[form.z])
        return d.compiled("moduli_along", self._vector(row), form.unknowns, self.comm, form.code)

    def returned(self, region: int) -> tuple[Kernel, Kernel]:
        """On a region of the yield surface: of the local residual (nx) at constant X, and of the stresses
        (nz, with stiff scalars nz + m), whose input ends with X and its change."""
        form = self.form
        assert isinstance(form, PlasticForm)
        name = form.regions[region].name
        if name not in self._returns:
            of = form.return_kernels(form.regions[region], self.comm)
            codes = of.local.code, of.stress.code
            self._returns[name] = self._returned(form.local_problem(form.regions[region]), *codes)
        return self._returns[name]

    def _returned(self, problem: LocalProblem, local_code: str, code: str) -> tuple[Kernel, Kernel]:
        form, nx = self.form, problem.X.ufl_shape[0]
        terminals = {**_terminals(form), problem.X: form.inputs}
        d = Direction(form.space, terminals, [*self._groups, nx])
        test = ufl.TestFunction(form.space.function_space(nx))
        local = d.along(ufl.dot(ufl.as_vector(problem.residual), test), without=[problem.X])
        work = self._vector(d.along(problem.work))
        return (
            d.compiled(f"{problem.name}_local_along", Vector(local, nx), nx, self.comm, local_code),
            d.compiled(f"{problem.name}_work_along", work, form.unknowns, self.comm, code),
        )


def _terminals(form: PointForm) -> Mapping[Any, int | tuple[int, ...]]:
    """Of a form, whose input may have groups of no length."""
    return {c: slots for c, slots in form.terminals.items() if c.ufl_shape[0]}


class InitialAlong:
    """The same of initial stresses; groups are z, frame and packed stress. Collective."""

    def __init__(self, kernels: InitialKernels, comm: MPI.Comm):
        form, of = kernels.form, kernels.residual.code
        n, space = form.layout.unknowns, form.space
        frame = form.layout.dim**2
        d = Direction(space, form.terminals, [n, frame, form.size])
        work = ufl.derivative(form.energy, form.z, ufl.TestFunction(space.function_space(n)))
        self.residual = d.compiled("initial_along", Vector(d.along(work), n), n, comm, of)
        # the tangent times a constant vector in the place of dz
        times = ufl.derivative(work, form.z, d._changes[form.z])
        self.times = d.compiled("initial_times", Vector(times, n), n, comm, of)
        changed = Vector(d.along(times, without=[form.z]), n)
        self.moduli = d.compiled("initial_moduli", changed, n, comm, of)


class MotionAlong:
    """The same of the update of F, the quaternion and the wryness; groups are the state before and z.
    Collective.

    Attributes:
        by_reference: gradients are taken by X.
    """

    def __init__(self, motion: Motion, comm: MPI.Comm):
        self.by_reference = motion.by_reference
        self._full = motion._full
        state, z = motion._state, motion._z
        groups = [state.ufl_shape[0], z.ufl_shape[0]]
        space = PointSpace(state.ufl_function_space().ufl_domain())
        d = Direction(space, {state: 0, z: groups[0]}, groups)
        rows = [d.along(e) for e in motion._expressions()]
        known = ["motion along", motion._kernel.code]
        self._kernel = compile_expressions(rows, d.terminals, d.inputs, space.domain, comm, known)

    def __call__(self, state: Sequence[Any], change: Sequence[Any], z: Any, dz: Any) -> tuple[Any, ...]:
        """Changes of (F, q, Gamma), of classical materials of (F,)."""
        return self._full.unpack(self._kernel(*state, *change, z, dz))

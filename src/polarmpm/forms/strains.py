"""Strain measures, stresses and virtual work at a point, in UFL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import ufl

from ..kernels.kernel import matrix
from ..kinematics import measures as kin
from ..kinematics.layout import Layout
from ..materials.base import Material, evaluate_energy, named_parameters


def strains(material: Material, layout: Layout, z: Any, state: Any, *, rotated: bool) -> tuple[Any, ...]:
    """(E, Gamma) of a micropolar material, the strain measures of a classical one.

    Args:
        z: scalars (G, w, Gw), gradients taken in the frame of the state.
        state: scalars (V~, Gamma~') in the rotated frame, else (F~, q~, Gamma~), or F~ of a classical
            material; of a plane problem without the entries that are known.
    """
    d, r = layout.dim, layout.rotations
    g, frame = matrix(z, d, d), matrix(state, d, d)
    f = kin.plane_tensor(frame) + kin.plane_gradient(g) if d == 2 else frame + g
    if r == 0:
        return material.measures(f)
    if d == 2:
        return _plane_strains(f, z, state, rotated)
    w = ufl.as_vector([z[9 + i] for i in range(3)])
    gw = matrix(z, 3, 3, 12)
    dq, increment = kin.exp_map(w), ufl.dot(kin.right_tangent(w), gw)
    if rotated:
        return ufl.dot(ufl.transpose(dq), f) - ufl.Identity(3), matrix(state, 3, 3, 9) + increment
    q0t = ufl.transpose(kin.quaternion_tensor([state[9 + i] for i in range(4)]))
    strain = ufl.dot(q0t, ufl.dot(ufl.transpose(dq), f)) - ufl.Identity(3)
    return strain, matrix(state, 3, 3, 13) + ufl.dot(q0t, increment)


def _plane_strains(f: Any, z: Any, state: Any, rotated: bool) -> tuple[Any, Any]:
    first = 4 if rotated else 6
    wryness = kin.plane_wryness([state[first + j] + z[5 + j] for j in range(2)])
    strain = ufl.dot(ufl.transpose(kin.plane_exp_map(z[4])), f)
    if not rotated:
        strain = ufl.dot(ufl.transpose(kin.quaternion_tensor([state[4], 0, 0, state[5]])), strain)
    return strain - ufl.Identity(3), wryness


def stresses(material: Material, strains: Sequence[Any], numbers: Any) -> list[Any]:
    """dW/dE and dW/dGamma, T (3.145)-(3.146); of a classical material the derivatives by its measures."""
    variables = [ufl.variable(e) for e in strains]
    w = evaluate_energy(material, variables, named_parameters(material, numbers))
    return [ufl.diff(w, v) for v in variables]


def virtual_work(material: Material, strains: Sequence[Any], unknown: Any, test: Any, numbers: Any) -> Any:
    """dW/dE : dE + dW/dGamma : dGamma with variations of the strains in `unknown`."""
    pairs = zip(stresses(material, strains, numbers), strains, strict=True)
    return sum(ufl.inner(s, ufl.derivative(e, unknown, test)) for s, e in pairs)


def predicts(material: Material) -> bool:
    """Whether a material's iterations have a tangent of their own, see `tangent_work`."""
    measured = material.micropolar or type(material).measures is not Material.measures
    return material.stress_prediction and measured and not material.plastic


def tangent_work(
    material: Material,
    strains: Sequence[Any],
    unknowns: Sequence[Any],
    arguments: Sequence[Any],
    numbers: Any,
) -> Any:
    """Derivative of the virtual work, but with predicted stresses in its geometric part.

    A correction of the unknowns turns points, and with the turn comes a spurious strain of second order,
    whose stress spoils the next tangent. The geometric part takes instead the stress that the linear solution
    meant, S(x~) + S'(x~) [x - x~] with x~ from before the correction: the mixed integration points of
    Magisano, Leonetti and Garcea (2017). At x = x~, and so at the solution, it's the derivative itself. Where
    the material doesn't predict, it always is.

    Args:
        strains: measures at x, and at x~.
        unknowns: x, x~ and x - x~; the latter holds numbers of its own.
        arguments: test and trial function.
    """
    (now, before), (x, x0, correction), (test, trial) = strains, unknowns, arguments
    if not predicts(material):
        return ufl.derivative(virtual_work(material, now, x, test, numbers), x, trial)
    work = 0
    for e, s, s0 in zip(
        now, stresses(material, now, numbers), stresses(material, before, numbers), strict=True
    ):
        variation, predicted = ufl.derivative(e, x, test), s0 + ufl.derivative(s0, x0, correction)
        work += ufl.inner(ufl.derivative(s, x, trial), variation)
        work += ufl.derivative(ufl.inner(predicted, variation), x, trial)
    return work

"""Strain measures, stresses and virtual work at a point, in UFL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import ufl

from ..kinematics import tensors as kin
from ..kinematics.layout import Layout
from ..kinematics.motion import Increment, Moved, move
from ..materials.base import Material, evaluate_energy, evaluate_measures, named_parameters


def motion(layout: Layout, z: Any, state: Any, *, rotated: bool) -> Moved:
    """F, Q and Gamma at a point, in the frame of its state.

    Args:
        z: scalars (G, w, Gw), gradients taken in the frame of the state; or (G, h).
        state: scalars (V~, Gamma~') in the rotated frame, else (F~, q~, Gamma~), or F~ of a classical
            material, (F~, H~) with second gradients; of a plane problem without the entries that are known.
    """
    before = layout.state(rotated=rotated)
    by = Increment.of(layout, z, before.hoop(state))
    if not layout.rotations:
        return move(by, before.frame(state), grad_F=before.second_gradient(state))
    base = None if rotated else kin.quaternion_tensor(before.quaternion(state))
    return move(by, before.frame(state), base, before.wryness(state))


def strain_measures(material: Material, stretch: Any, wryness: Any, grad_F: Any = None) -> tuple[Any, ...]:
    """(E, Gamma) of U = Q^T F and Gamma; of a classical material, without a wryness, its measures of F, and
    of H with second gradients."""
    if wryness is None:
        return evaluate_measures(material, stretch, grad_F)
    return stretch - ufl.Identity(3), wryness


def strains(material: Material, layout: Layout, z: Any, state: Any, *, rotated: bool) -> tuple[Any, ...]:
    """Strain measures of a material at a point, see `motion` and `strain_measures`."""
    now = motion(layout, z, state, rotated=rotated)
    return strain_measures(material, now.stretch, now.wryness, now.grad_F)


def stresses(material: Material, strains: Sequence[Any], numbers: Any) -> list[Any]:
    """dW/dE and dW/dGamma, T (3.145)-(3.146); of a classical material the derivatives by its measures."""
    variables = [ufl.variable(e) for e in strains]
    w = evaluate_energy(material, variables, named_parameters(material, numbers))
    return [ufl.diff(w, v) for v in variables]


def elastic_stress(
    material: Material, deformation: Any, wryness: Any, numbers: Any, grad_F: Any = None
) -> tuple[Any, Any]:
    """B = dW/dE and S = dW/dGe at the elastic stretch Ue = Q^T Fe and wryness Ge; of a classical material,
    without a wryness, dW/dFe and None, with second gradients dW/dF and dW/dH.

    Args:
        numbers: the material's, by name.
    """
    if wryness is not None:
        e, g = ufl.variable(deformation - ufl.Identity(3)), ufl.variable(wryness)
        w = evaluate_energy(material, (e, g), numbers)
        return ufl.diff(w, e), ufl.diff(w, g)
    fe = ufl.variable(deformation)
    by = [fe] if grad_F is None else [fe, ufl.variable(grad_F)]
    measures = evaluate_measures(material, *by)
    v = [ufl.variable(m) for m in measures]
    w = evaluate_energy(material, v, numbers)  # derived with respect to the few measures first
    stresses = []
    for b in by:
        parts = [_chain(ufl.diff(w, vi), ufl.diff(m, b)) for vi, m in zip(v, measures, strict=True)]
        stresses.append(sum(parts[1:], parts[0]))
    return stresses[0], stresses[1] if len(by) > 1 else None


def _chain(outer: Any, inner: Any) -> Any:
    """Derivative of an energy by a measure times the measure's derivative by F or H."""
    if not outer.ufl_shape:
        return outer * inner
    mine = ufl.indices(len(outer.ufl_shape))
    left = ufl.indices(len(inner.ufl_shape) - len(mine))
    return ufl.as_tensor(outer[mine] * inner[mine + left], left)


def pushed(stress: Any, q: Any, by: Any) -> Any:
    """Q S by^T: a stress in space, per reference volume. Q is None of a classical material."""
    forward = ufl.dot(stress, ufl.transpose(by))
    return forward if q is None else ufl.dot(q, forward)


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

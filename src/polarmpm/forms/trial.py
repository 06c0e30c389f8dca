"""A user's energy is tried at rest and in a few states, before any work is done with it."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..errors import InputError, KernelError, TrustWarning
from ..kernels import codegen
from ..kernels.codegen import Scalariser
from ..kernels.kernel import PointSpace, matrix, third
from ..kernels.recall import recalled
from ..kinematics import rotations
from ..materials.base import Material, UserEnergy, evaluate_energy, named_parameters, parameter_values
from ..tools import compat
from ..tools.parallel import warn_on_one_rank
from . import kinds
from .strains import elastic_stress, strain_measures

_STATES = 4  # the first one at rest
_SIZE = 0.05  # of strains and wrynesses (1/m)
_NONE = 1e-6  # share of a strained state's stress, or energy, that counts as none


def try_energy(material: Material, comm: MPI.Comm) -> None:
    """Raise InputError for an energy that can't be meant: one that doesn't depend on the deformation, whose
    stress at rest isn't a number, or that isn't isotropic though it says so; warn of one that has a stress at
    rest, or its least energy elsewhere. The package's own aren't tried. Collective.
    """
    elastic = material.elastic_part
    own = type(elastic).__module__.startswith(__name__.split(".")[0] + ".")
    if own and not isinstance(elastic, UserEnergy):
        return
    try:
        of = "tried", kinds.of_material(elastic), tuple(parameter_values(elastic))
        depends, energy, stress = recalled(of, lambda: _evaluated(elastic))
    except KernelError:  # is said when it is compiled
        return
    kind = type(elastic).__name__
    if not depends:
        raise InputError(f"material: the energy of {kind} doesn't depend on the deformation")
    if not np.isfinite(energy[0]) or not np.all(np.isfinite(stress[:, 0])):
        bad = energy[0] if not np.isfinite(energy[0]) else stress[~np.isfinite(stress[:, 0]), 0][0]
        what = "is" if not np.isfinite(energy[0]) else "has a stress of"
        raise InputError(f"material: the energy of {kind} {what} {bad} at rest; it must be smooth there")
    _warn_of_rest(kind, energy[:_STATES], stress[:, :_STATES], comm)
    apart = np.abs(energy[_STATES:] - energy[1:_STATES])
    if (elastic.micropolar and not elastic.isotropic) or np.all(apart <= 1e-8 * np.abs(energy).max()):
        return
    worst = int(np.argmax(apart))
    here, there = energy[1 + worst], energy[_STATES + worst]
    what = f"the energy of {kind} is {here:.6g} in a state and {there:.6g} in the same state turned"
    if elastic.micropolar:
        raise InputError(f"material: isotropic = True, but {what}")
    cause = "as a whole: stresses are wrong where the body turns; write it as a function of F.T * F"
    warn_on_one_rank(comm, f"{what} {cause}", TrustWarning)


def _warn_of_rest(kind: str, energy: np.ndarray, stress: np.ndarray, comm: MPI.Comm) -> None:
    """Warn of a state at rest, the first one of energies (m,) and stresses (k, m), that is none."""
    at_rest, most = (np.abs(part).max(initial=0.0) for part in (stress[:, :1], stress[:, 1:]))
    if at_rest > _NONE * most:
        text = (
            f"has a stress of {at_rest:.3g} in the undeformed state: unless an initial stress is in balance "
        )
        text += "with it, the body moves without a load; NeoHookean's -2 mu ln J is there to take it away"
    elif energy.min() < energy[0] - _NONE * np.abs(energy - energy[0]).max():
        text = f"is less, by {energy[0] - energy.min():.3g}, in a strained state than in the undeformed one, "
        text += "which isn't stable then; are the signs right?"
    else:
        return
    warn_on_one_rank(comm, f"the energy of {kind} {text}", TrustWarning)


def _evaluated(material: Material) -> tuple[bool, np.ndarray, np.ndarray]:
    """Whether the energy depends on the deformation; energies (m,) and stresses (k, m) in the states, those
    but the first one once more turned: classical ones as a whole, micropolar ones, of strains that don't know
    of that, in the body."""
    numbers = parameter_values(material)
    space = PointSpace(compat.point_domain())
    more = 27 if material.second_gradient else 9  # second gradients stand for the wryness
    u, g, p = (space.coefficient(n) for n in (9, more, len(numbers)))
    named = named_parameters(material, p)
    stretch, wryness = matrix(u, 3, 3), matrix(g, 3, 3) if material.micropolar else None
    second = third(g) if material.second_gradient else None
    scalarise = Scalariser({u: 0, g: 9, p: 9 + more})
    expressions = [evaluate_energy(material, strain_measures(material, stretch, wryness, second), named)]
    expressions += [s for s in elastic_stress(material, stretch, wryness, named, second) if s is not None]
    nodes = []
    for expression in expressions:
        data = scalarise(codegen.expand(expression)).data
        nodes += [scalarise.plain(data[index]) for index in np.ndindex(*data.shape)]
    rng = np.random.default_rng(1)
    strain, bend = _SIZE * rng.uniform(-1, 1, (2, _STATES, 3, 3))
    strain[0], bend[0] = 0.0, 0.0
    turn = rotations.to_tensor(rotations.from_vector(rng.uniform(-1, 1, (_STATES - 1, 3))))
    back = np.swapaxes(turn, 1, 2)
    deformed = strain + np.eye(3)
    if material.micropolar:
        rows = [np.concatenate([a, turn @ a[1:] @ back]).reshape(-1, 9).T for a in (deformed, bend)]
    else:
        rows = [
            np.concatenate([deformed, turn @ deformed[1:]]).reshape(-1, 9).T,
            np.zeros((9, 2 * _STATES - 1)),
        ]
    if material.second_gradient:
        halves = np.stack([bend, np.roll(bend, 1, axis=1), np.roll(bend, 1, axis=2)], axis=3)
        halves = halves + np.swapaxes(halves, 2, 3)
        turned = np.einsum("nij,njkl->nikl", turn, halves[1:])
        rows[1] = np.concatenate([halves, turned]).reshape(-1, 27).T
    inputs = np.vstack([*rows, np.tile(numbers[:, None], rows[0].shape[1])])
    values = scalarise.graph.values(nodes, inputs)
    depends = scalarise.graph.depends(nodes[0], range(9 + more))
    return depends, values[0], values[1:]

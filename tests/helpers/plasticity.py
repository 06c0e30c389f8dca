"""Plastic materials, points that are driven through deformations, and their equations in NumPy and SciPy.

Nothing of the package's UFL is used for what is compared: elastic laws, yield functions and the local
equations T (4.57)-(4.60) are written out anew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import polarmpm as pm
from polarmpm.bodies.points import Points
from polarmpm.forms.choice import make_form
from polarmpm.forms.returnmapping import ReturnMapping, Yielding
from polarmpm.kinematics import rotations
from polarmpm.materials.base import parameter_values
from tests.conftest import COMM

LAM, MU = 3e3, 2e3  # Pa
BULK = LAM + 2 * MU / 3
K = 40.0  # Pa
L_P = 0.4  # m
ELASTIC = pm.MicropolarElastic.bounded_stiffness(lam=LAM, mu=MU, kappa=7e2, l_b=0.3)
NO_COUPLES = pm.MicropolarElastic(lam=LAM, mu=MU, kappa=7e2, alpha=0.0, beta=0.0, gamma=0.0)
FULL = pm.MicropolarElastic(lam=LAM, mu=MU, kappa=7e2, alpha=110.0, beta=130.0, gamma=170.0)
NEO_HOOKEAN = pm.NeoHookean(lam=LAM, mu=MU)
HENCKY = pm.Hencky(lam=LAM, mu=MU)


def cone(elastic: pm.Material = ELASTIC, phi: float = 30.0, psi: float = 10.0, **options: Any) -> Any:
    """Drucker-Prager with angles in degrees."""
    options = {"k": K, "cone": "compression", **({"l_p": L_P} if elastic.micropolar else {}), **options}
    return pm.DruckerPrager(elastic, phi=math.radians(phi), psi=math.radians(psi), **options)


def cylinder(elastic: pm.Material = ELASTIC, **options: Any) -> Any:
    """Von Mises."""
    return pm.VonMises(elastic, **{"k": K, **({"l_p": L_P} if elastic.micropolar else {}), **options})


def slope(angle: float) -> float:
    """a or b of the cone, T (4.34)-(4.35), for degrees."""
    s = math.sin(math.radians(angle))
    return 6 * s / (3 - s)


# NumPy ----------------------------------------------------------------------------------------------
def transposed(a: np.ndarray) -> np.ndarray:
    return np.swapaxes(a, -1, -2)


def sym(a: np.ndarray) -> np.ndarray:
    return 0.5 * (a + transposed(a))


def trace(a: np.ndarray) -> np.ndarray:
    return np.trace(a, axis1=-2, axis2=-1)


def dev(a: np.ndarray) -> np.ndarray:
    return a - trace(a)[..., None, None] / 3 * np.eye(3)


def square(a: np.ndarray) -> np.ndarray:
    return np.einsum("...ij,...ij->...", a, a)


def hat(w: np.ndarray) -> np.ndarray:
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return out - transposed(out)


def right_tangent(w: np.ndarray) -> np.ndarray:
    """J_r(w) of rotation vectors (n, 3)."""
    t = np.maximum(np.linalg.norm(w, axis=-1), 1e-4)[..., None, None]
    h = hat(w)
    return np.eye(3) - (1 - np.cos(t)) / t**2 * h + (t - np.sin(t)) / t**3 * h @ h


def elastic_law(
    material: pm.Material, fe: np.ndarray, ge: np.ndarray | None, q: np.ndarray, f: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """tau and nu of Fe (Q Ue) and Ge, T (3.122)-(3.125), (4.26)-(4.27)."""
    p = material.parameters()
    if not material.micropolar:
        left = fe @ transposed(fe)
        if isinstance(material, pm.Hencky):
            value, vector = np.linalg.eigh(left)
            twice = (vector * np.log(value)[..., None, :]) @ transposed(vector)
            return p["mu"] * twice + 0.5 * p["lam"] * trace(twice)[..., None, None] * np.eye(3), None
        log_j = np.log(np.linalg.det(fe))[..., None, None]
        return p["mu"] * (left - np.eye(3)) + p["lam"] * log_j * np.eye(3), None
    assert ge is not None
    strain = transposed(q) @ fe - np.eye(3)
    b = p["lam"] * trace(strain)[..., None, None] * np.eye(3)
    b = b + 2 * p["mu"] * sym(strain) + 2 * p["kappa"] * (strain - sym(strain))
    s = p["alpha"] * trace(ge)[..., None, None] * np.eye(3)
    s = s + 2 * p["gamma"] * sym(ge) + 2 * p["beta"] * (ge - sym(ge))
    return q @ b @ transposed(fe), q @ s @ transposed(f)


def q_of(tau: np.ndarray, nu: np.ndarray | None, l_p: float = L_P) -> np.ndarray:
    """q, T (4.38)."""
    return np.sqrt(1.5 * (square(dev(sym(tau))) + (0 if nu is None else square(nu) / l_p**2)))


def yield_value(material: Any, tau: np.ndarray, nu: np.ndarray | None, chi: np.ndarray) -> np.ndarray:
    """f, T (4.39)."""
    numbers = material.plastic_parameters()
    pressure = numbers.get("friction", 0.0) * trace(tau) / 3
    return q_of(tau, nu, numbers.get("l_p", 1.0)) + pressure - (numbers["k"] + numbers["H"] * chi)


# points ---------------------------------------------------------------------------------------------
@dataclass
class Solution:
    """What the return mapping found, in the reference frame; `multiplier` is the sum of a region's."""

    rows: np.ndarray
    region: np.ndarray
    ue: np.ndarray
    ge: np.ndarray
    chi: np.ndarray
    multiplier: np.ndarray
    f: np.ndarray
    q: np.ndarray
    gamma: np.ndarray
    tau: np.ndarray
    nu: np.ndarray | None

    @property
    def apex(self) -> np.ndarray:
        """Which of the points are at the cone's apex, its second region."""
        return self.region == 1


class Driven:
    """Points of one plastic material whose deformation is given.

    Increments z are (n, nz): the entries of dDu/dX, of Dw, and of dDw/dX, row by row.
    """

    def __init__(self, material: Any, n: int, dim: int = 2):
        self.material, self.dim, self.n = material, dim, n
        self.form = make_form(material, dim)
        self.points = Points(np.zeros((n, dim)), np.ones(n), np.ones((n, dim)), material, COMM)
        self.mapping = ReturnMapping(self.form, COMM, self.points.id)
        self.size = self.form.layout.unknowns
        self._elastic: Any = None

    # kinematics -----------------------------------------------------------------------------------
    def parts(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """dDu/dX (n, 3, 3), Dw (n, 3) and dDw/dX (n, 3, 3)."""
        d, r, n = self.dim, self.form.layout.rotations, len(z)
        gradient, w, bend = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3))
        gradient[:, :d, :d] = z[:, : d * d].reshape(n, d, d)
        if r:
            w[:, 3 - r :] = z[:, d * d : d * d + r]
            bend[:, 3 - r :, :d] = z[:, d * d + r :].reshape(n, r, d)
        return gradient, w, bend

    def motion(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """F, Q and Gamma (n, 3, 3)."""
        p, (gradient, w, bend) = self.points, self.parts(z)
        before = rotations.to_tensor(p.q)
        wryness = p.wryness + transposed(before) @ right_tangent(w) @ bend
        return p.F + gradient, Rotation.from_rotvec(w).as_matrix() @ before, wryness

    def _frame(self) -> np.ndarray:
        """(n, nz, nz): from increments by X to those in the frame of the kernels."""
        d, r = self.dim, self.form.layout.rotations
        turn = rotations.to_tensor(self.points.q)[:, :d, :d]
        out = np.tile(np.eye(self.size), (self.n, 1, 1))
        if r and self.material.isotropic:
            starts = [d * i for i in range(d)] + [d * d + r + d * i for i in range(r)]
            for s in starts:
                out[:, s : s + d, s : s + d] = turn
        return out

    def inputs(self, z: np.ndarray) -> np.ndarray:
        p = self.points
        state = self.form.pack(p.F, p.q, p.wryness, p.plastic_state(np.arange(self.n)))
        numbers = np.tile(parameter_values(self.material), (self.n, 1))
        return np.hstack([np.einsum("nij,nj->ni", self._frame(), z), state, numbers])

    # stresses -------------------------------------------------------------------------------------
    def stress(self, z: np.ndarray, tangent: bool = True) -> tuple[np.ndarray, np.ndarray, Yielding]:
        """s (n, nz) and A (n, nz, nz) by X, and the points that yield."""
        if self._elastic is None:
            self._elastic = self.form.compile(COMM)
        nz, inputs = self.size, self.inputs(z)
        out = self._elastic[1](inputs)
        s, a = out[:, :nz].copy(), np.zeros((self.n, nz, nz))
        i, j = np.triu_indices(nz)
        a[:, i, j] = a[:, j, i] = out[:, nz:]
        y = self.mapping.evaluate(inputs, tangent)
        s[y.rows] = y.returned[:, :nz]
        if tangent:
            a[y.rows] = y.returned[:, nz:].reshape(-1, nz, nz)
        frame = self._frame()
        return np.einsum("nji,nj->ni", frame, s), transposed(frame) @ a @ frame, y

    def solve(self, z: np.ndarray) -> Solution:
        """Local unknowns of the points that yield."""
        y = self.mapping.evaluate(self.inputs(z), False)
        ue, ge = self.mapping._tensors(y.X)
        if self.material.isotropic and self.material.micropolar:
            turn = rotations.to_tensor(self.points.q[y.rows])
            ue, ge = (transposed(turn) @ a @ turn for a in (ue, ge))
        f, q, gamma = (a[y.rows] for a in self.motion(z))
        if not self.material.micropolar:
            q = np.tile(np.eye(3), (len(f), 1, 1))
        tau, nu = elastic_law(self.material.elastic, q @ ue, ge, q, f)
        column = self.form.hardening_column
        chi, multiplier = y.X[:, column], y.X[:, column + 1 :].sum(axis=1)
        return Solution(y.rows, y.region, ue, ge, chi, multiplier, f, q, gamma, tau, nu)

    def advance(self, z: np.ndarray) -> tuple[Yielding, np.ndarray]:
        """A converged step; the points that yield and their dissipation."""
        p, base = self.points, self.points.q
        y = self.mapping.evaluate(self.inputs(z), False)
        loss = self.mapping.dissipation()
        p.F, _, p.wryness = self.motion(z)
        p.q = rotations.multiply(rotations.from_vector(self.parts(z)[1]), p.q)
        self.mapping.update_plastic_state(p, np.arange(len(p)), base)
        return y, loss


def residuals(driven: Driven, x: Solution) -> dict[str, np.ndarray]:
    """T (4.57)-(4.60) of a solution on the cone, with SciPy's matrix exponential."""
    p, m = driven.points, driven.material
    numbers = m.plastic_parameters()
    trial = x.f @ np.linalg.inv(p.plastic_F[x.rows])
    q = q_of(x.tau, x.nu, numbers.get("l_p", 1.0))[:, None, None]
    flow = 1.5 * dev(sym(x.tau)) / q + numbers.get("dilatancy", 0.0) / 3 * np.eye(3)
    back = np.array([expm(-g * n) for g, n in zip(x.multiplier, flow, strict=True)])
    out = {"U": x.ue - transposed(x.q) @ back @ trial}
    if x.nu is not None:
        step = 1.5 / numbers["l_p"] ** 2 * x.multiplier[:, None, None] * (transposed(x.q) @ (x.nu / q) @ x.f)
        out["Gamma"] = x.ge + step - (x.gamma - p.plastic_wryness[x.rows])
    out["chi"] = x.chi - p.hardening[x.rows] - x.multiplier
    return out | {"f": yield_value(m, x.tau, x.nu, x.chi) / m.plastic_parameters()["k"]}

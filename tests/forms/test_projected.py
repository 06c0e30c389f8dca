"""Points with projected scalars: derivatives against differences, and what the projection replaces."""

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.forms.choice import make_projected
from polarmpm.forms.projected import ProjectedForm
from polarmpm.kinematics import rotations
from polarmpm.materials.base import parameter_values

COMM = MPI.COMM_WORLD
ELASTIC = {
    "neo-Hookean": pm.NeoHookean.from_engineering(E=10.0, nu=0.4),
    "Hencky": pm.Hencky.from_engineering(E=10.0, nu=0.4),
    "micropolar": pm.MicropolarElastic.from_engineering(E=10.0, nu=0.4, n=0.5, l_b=0.1, l_t=0.1, psi=1.0),
}
PLASTIC = pm.VonMises(ELASTIC["micropolar"], k=0.3, l_p=0.1)


def _size(tensors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(tensors**2, axis=(1, 2)))


class Case:
    """A few points in a deformed state with increments, and the kernels of their form."""

    def __init__(self, material: pm.Material, dim: int, rotation: bool):
        stiffness = 0.0 if material.plastic else 0.7
        self.form = form = make_projected(material, dim, rotation=rotation, stabilisation=stiffness)
        rng, n, r = np.random.default_rng(1), 4, form.layout.rotations
        F, wryness, turn = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3, 3)), np.zeros((n, 3))
        F[:, :dim, :dim] += 0.1 * rng.standard_normal((n, dim, dim))
        if r:
            turn[:, 3 - r :] = 0.3 * rng.standard_normal((n, r))
            wryness[:, 3 - r :, :dim] = 0.2 * rng.standard_normal((n, r, dim))
        plastic = (
            (np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3, 3)), np.zeros(n)) if material.plastic else ()
        )
        self.m, self.nz = form.scalars, form.layout.unknowns
        state = form.pack(F, rotations.from_vector(turn), wryness, plastic)
        self.state = form.extend(state, 0.03 * rng.standard_normal((n, self.m)))
        self.parameters = np.tile(parameter_values(material), (n, 1))
        self.y = 0.05 * rng.standard_normal((n, self.nz + self.m))
        self.pi = 0.5 * rng.standard_normal((n, self.m))

    def inputs(self, y: np.ndarray) -> tuple[np.ndarray, ...]:
        state, first, m = self.state.copy(), self.form.state_size, self.m
        state[:, first : first + m], state[:, first + m : first + 2 * m] = y[:, self.nz :], self.pi
        return y[:, : self.nz], state, self.parameters

    def differences(self, kernel, outputs: slice) -> np.ndarray:
        """Derivative (n, outputs, unknowns) of what a kernel gives."""
        columns = []
        for j in range(self.y.shape[1]):
            step = np.zeros_like(self.y)
            step[:, j] = 1e-5
            ends = [kernel(*self.inputs(self.y + k * step))[:, outputs] for k in (1, -1, 2, -2)]
            columns.append((8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / 12e-5)
        return np.stack(columns, axis=2)


@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rotation", [False, True])
@pytest.mark.parametrize("name", list(ELASTIC))
def test_derivatives(name, dim, rotation):
    if (rotation and (name != "micropolar" or dim == 3)) or (name, dim) == ("Hencky", 3):
        pytest.skip("no relative rotation, or a minute to compile")
    case = Case(ELASTIC[name], dim, rotation)
    m, nz, inputs = case.m, case.nz, case.inputs(case.y)
    (residual, blocks), kernels = case.form.compile(COMM), case.form.compile_scalars(COMM)
    upper = np.triu_indices(nz)
    of_z, of_t = case.differences(residual, slice(0, nz)), case.differences(kernels.conjugate, slice(0, m))
    size = np.abs(of_z).max()
    assert np.allclose(blocks(*inputs)[:, :nz], residual(*inputs), atol=1e-12 * size)
    assert np.allclose(blocks(*inputs)[:, nz:], of_z[:, upper[0], upper[1]], atol=1e-9 * size)
    conjugate = kernels.conjugate(*inputs)
    assert np.allclose(conjugate[:, m : m + m * nz].reshape(-1, m, nz), of_t[:, :, :nz], atol=1e-9 * size)
    assert np.allclose(conjugate[:, m + m * nz :].reshape(-1, m, m), of_t[:, :, nz:], atol=1e-9 * size)
    assert np.allclose(of_z[:, :, nz:], np.swapaxes(of_t[:, :, :nz], 1, 2), atol=1e-9 * size)
    measure = kernels.measure(*inputs)[:, m:].reshape(-1, m, nz)
    of_e = case.differences(kernels.measure, slice(0, m + m * nz))
    assert np.allclose(measure, of_e[:, :m, :nz], atol=1e-9)
    second = of_e[:, m:, :nz].reshape(-1, m, nz, nz)
    bent = np.einsum("nm,nmij->nij", case.pi, second)
    assert np.allclose(kernels.curvature(*inputs), bent[:, upper[0], upper[1]], atol=1e-9)


@pytest.mark.parametrize(
    "material", [ELASTIC["Hencky"], ELASTIC["micropolar"], PLASTIC], ids=lambda m: type(m).__name__
)
def test_the_material_sees_the_projected_scalars(material):
    """Fbar has the scalars t, in whatever frame, and F itself where t = e."""
    case = Case(material, 2, rotation=True)
    kernels, m, nz = case.form.compile_scalars(COMM), case.m, case.nz
    case.y[:, nz:] = kernels.measure(*case.inputs(case.y))[:, :m]
    same = kernels.moved(*case.inputs(case.y)).reshape(-1, 3, 3)
    assert np.allclose(same[:, 2], [0, 0, 1])
    gain = 0.01 * np.arange(1, m + 1)
    case.y[:, nz:] += gain
    other = kernels.moved(*case.inputs(case.y)).reshape(-1, 3, 3)
    if material.measure == "log":
        assert np.allclose(np.log(np.linalg.det(other) / np.linalg.det(same)), gain[0])
        longer = [np.linalg.eigvalsh((np.swapaxes(F, 1, 2) @ F)[:, :2, :2]) for F in (other, same)]
        assert m > 1 or np.allclose(longer[0] / longer[1], np.exp(gain[0]))
    else:
        assert np.allclose(_size(other - same), np.sqrt(gain[0] ** 2 / 2 + 2 * gain[1] ** 2))


def test_which_scalars():
    """The relative rotation is one of micropolar materials, in space three."""

    def scalars(material, dim):
        return make_projected(material, dim, rotation=True).scalars

    assert scalars(ELASTIC["Hencky"], 2) == scalars(ELASTIC["Hencky"], 3) == 1
    assert [scalars(ELASTIC["micropolar"], dim) for dim in (2, 3)] == [2, 4]
    assert [scalars(PLASTIC, dim) for dim in (2, 3)] == [2, 4]
    assert isinstance(make_projected(PLASTIC, 2), ProjectedForm)

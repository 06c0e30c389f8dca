"""Large deformations of micropolar (Cosserat) solids with material points, on FEniCSx."""

import importlib
from typing import TYPE_CHECKING, Any

from .basis.base import Basis
from .basis.registry import register as register_basis
from .bodies.elements import Elements, Facets
from .bodies.points import Points, Selection
from .bodies.seeding import seed, seed_mesh
from .errors import InputError, KernelError, NotConserved, NotConverged, PointsOutsideGrid, PolarMPMError
from .geometry.grid import Grid
from .geometry.planes import plane
from .geometry.surfaces import Surface
from .io import Recorder, Table
from .io.restart import load as load_restart
from .io.restart import save as save_restart
from .materials import Hencky, Material, MicropolarElastic, NeoHookean, UserEnergy
from .problems.elements import QuasiStaticFEM
from .problems.points import PUBLISHED, QuasiStatic
from .solvers.newton import Controls
from .solvers.resetting import EverySteps, Never, WhenDistorted
from .solvers.stepping import Step
from .terms.ghost import GhostPenalty

if TYPE_CHECKING:
    from .materials.cones import DruckerPrager, VonMises
    from .materials.plastic import Plastic, UserPlasticity

_PLASTIC = {"DruckerPrager": "cones", "VonMises": "cones", "Plastic": "plastic", "UserPlasticity": "plastic"}


def __getattr__(name: str) -> Any:
    """Plastic materials, imported when a scene asks for one."""
    if name in _PLASTIC:
        return getattr(importlib.import_module(f"{__name__}.materials.{_PLASTIC[name]}"), name)
    raise AttributeError(f"module 'polarmpm' has no attribute {name!r}")


__version__ = "0.1.0"

__all__ = [
    "PUBLISHED",
    "Basis",
    "Controls",
    "DruckerPrager",
    "Elements",
    "EverySteps",
    "Facets",
    "GhostPenalty",
    "Grid",
    "Hencky",
    "InputError",
    "KernelError",
    "Material",
    "MicropolarElastic",
    "NeoHookean",
    "Never",
    "NotConserved",
    "NotConverged",
    "Plastic",
    "Points",
    "PointsOutsideGrid",
    "PolarMPMError",
    "QuasiStatic",
    "QuasiStaticFEM",
    "Recorder",
    "Selection",
    "Step",
    "Surface",
    "Table",
    "UserEnergy",
    "UserPlasticity",
    "VonMises",
    "WhenDistorted",
    "load_restart",
    "plane",
    "register_basis",
    "save_restart",
    "seed",
    "seed_mesh",
]

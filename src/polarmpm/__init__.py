"""Large deformations of micropolar (Cosserat) solids with material points, on FEniCSx."""

from typing import TYPE_CHECKING, Any

from .conditions import plane
from .elementproblem import QuasiStaticFEM
from .elements import Elements, Facets
from .errors import (
    InputError,
    KernelError,
    NotConserved,
    NotConverged,
    PointsOutsideGrid,
    PolarMPMError,
)
from .ghost import GhostPenalty
from .grid import Grid
from .io import Recorder, Table
from .io.restart import load as load_restart
from .io.restart import save as save_restart
from .materials import Hencky, Material, MicropolarElastic, NeoHookean, UserEnergy
from .newton import Controls
from .pointproblem import PUBLISHED, QuasiStatic
from .points import Points, Selection
from .resetting import EverySteps, Never, WhenDistorted
from .seeding import seed, seed_mesh
from .stepping import Step
from .surfaces import Surface

if TYPE_CHECKING:
    from .materials.plastic import DruckerPrager, Plastic, UserPlasticity, VonMises

_PLASTIC = ("DruckerPrager", "Plastic", "UserPlasticity", "VonMises")


def __getattr__(name: str) -> Any:
    """Plastic materials, imported when a scene asks for one."""
    if name in _PLASTIC:
        from .materials import plastic

        return getattr(plastic, name)
    raise AttributeError(f"module 'polarmpm' has no attribute {name!r}")


__version__ = "0.1.0"

__all__ = [
    "PUBLISHED",
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
    "save_restart",
    "seed",
    "seed_mesh",
]

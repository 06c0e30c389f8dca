"""Large deformations of micropolar (Cosserat) solids with material points, on FEniCSx."""

import importlib
from typing import TYPE_CHECKING, Any

import polarmpm.tools.presence  # noqa: F401 (before all that needs what it looks for)

from .basis.base import Basis, Weights
from .basis.registry import register as register_basis
from .bodies.elements import Elements
from .bodies.facets import Facets
from .bodies.meshseeding import seed_mesh
from .bodies.points import Points
from .bodies.seeding import seed
from .bodies.selection import Selection
from .conditions.ground import K0
from .errors import (
    ErrorOnAnotherRank,
    Finding,
    InputError,
    KernelError,
    NotConserved,
    NotConverged,
    NotDifferentiable,
    OutputError,
    PointsOutsideGrid,
    PolarMPMError,
    RanksApart,
    SupportLost,
    TrustWarning,
)
from .forms.stresses import MaterialField
from .geometry.grid import Grid
from .geometry.lines import lines
from .geometry.planes import plane
from .geometry.shapes import Box, Cylinder, HalfSpace, Polygon, Shape, Sphere
from .geometry.solids import Solid
from .geometry.surfaces import Surface
from .io import Field, Recorder, Table
from .io.restart import load as load_restart
from .io.restart import save as save_restart
from .materials import (
    ArrudaBoyce,
    GradientElastic,
    Hencky,
    Material,
    MicropolarElastic,
    NeoHookean,
    OrientedMicropolar,
    SaintVenantKirchhoff,
    UserEnergy,
)
from .problems.dynamic import Dynamic, DynamicFEM
from .problems.elements import QuasiStaticFEM
from .problems.gridpolicies import AlongBands, FollowBody
from .problems.observer import Observer
from .problems.points import PUBLISHED, QuasiStatic
from .solvers.choice import register_solver
from .solvers.newton import Controls
from .solvers.resetting import EverySteps, InMotion, Never, WhenDistorted
from .solvers.stepping import Step
from .terms.base import Boxes, Piece, Term
from .terms.bodycontact import BodyContact
from .terms.ghost import GhostPenalty
from .terms.obstacles import Obstacle
from .terms.rigid import RigidBody
from .terms.surfaceterms import SurfaceTerm
from .tools import ends, interrupts

ends.install()
interrupts.heed_pipes()

if TYPE_CHECKING:
    from . import geotechnics
    from .identification.experiment import Experiment
    from .identification.fitting import identify
    from .identification.places import Places
    from .identification.planning import Plan, plan
    from .identification.profile import Profile
    from .identification.reading import Curve, MeasuredField, read_curve, read_field
    from .identification.result import Compared, Fit, Outlier
    from .identification.transforms import Bounds, Linear
    from .materials.clay import CamClay, Houlsby
    from .materials.cones import DruckerPrager, VonMises
    from .materials.plastic import Continuation, Plastic, UserPlasticity
    from .materials.pyramids import MohrCoulomb, Tresca
    from .materials.regions import ConeApex, Edge, Region, SmoothPart, YieldSurface
    from .sensitivity.runs import Sensitivity
    from .study.pilot import lines_from

_LATER = {
    **dict.fromkeys(("DruckerPrager", "VonMises"), "materials.cones"),
    **dict.fromkeys(("MohrCoulomb", "Tresca"), "materials.pyramids"),
    **dict.fromkeys(("CamClay", "Houlsby"), "materials.clay"),
    **dict.fromkeys(("Continuation", "Plastic", "UserPlasticity"), "materials.plastic"),
    **dict.fromkeys(("ConeApex", "Edge", "Region", "SmoothPart", "YieldSurface"), "materials.regions"),
    "Sensitivity": "sensitivity.runs",
    "Experiment": "identification.experiment",
    "Profile": "identification.profile",
    "identify": "identification.fitting",
    **dict.fromkeys(("Bounds", "Linear"), "identification.transforms"),
    **dict.fromkeys(("Compared", "Fit", "Outlier"), "identification.result"),
    **dict.fromkeys(("Plan", "plan"), "identification.planning"),
    **dict.fromkeys(("Curve", "MeasuredField", "read_curve", "read_field"), "identification.reading"),
    "Places": "identification.places",
    "lines_from": "study.pilot",
}


def __getattr__(name: str) -> Any:
    """Plastic materials, their yield surfaces and others, imported when a scene asks for one."""
    if name == "geotechnics":
        return importlib.import_module(f"{__name__}.geotechnics")
    if name in _LATER:
        return getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
    raise AttributeError(f"module 'polarmpm' has no attribute {name!r}")


__version__ = "0.1.0"  # the one place that states it; read without an import when the package is built

__all__ = [
    "K0",
    "PUBLISHED",
    "AlongBands",
    "ArrudaBoyce",
    "Basis",
    "BodyContact",
    "Bounds",
    "Box",
    "Boxes",
    "CamClay",
    "Compared",
    "ConeApex",
    "Continuation",
    "Controls",
    "Curve",
    "Cylinder",
    "DruckerPrager",
    "Dynamic",
    "DynamicFEM",
    "Edge",
    "Elements",
    "ErrorOnAnotherRank",
    "EverySteps",
    "Experiment",
    "Facets",
    "Field",
    "Finding",
    "Fit",
    "FollowBody",
    "GhostPenalty",
    "GradientElastic",
    "Grid",
    "HalfSpace",
    "Hencky",
    "Houlsby",
    "InMotion",
    "InputError",
    "KernelError",
    "Linear",
    "Material",
    "MaterialField",
    "MeasuredField",
    "MicropolarElastic",
    "MohrCoulomb",
    "NeoHookean",
    "Never",
    "NotConserved",
    "NotConverged",
    "NotDifferentiable",
    "Observer",
    "Obstacle",
    "OrientedMicropolar",
    "Outlier",
    "OutputError",
    "Piece",
    "Places",
    "Plan",
    "Plastic",
    "Points",
    "PointsOutsideGrid",
    "PolarMPMError",
    "Polygon",
    "Profile",
    "QuasiStatic",
    "QuasiStaticFEM",
    "RanksApart",
    "Recorder",
    "Region",
    "RigidBody",
    "SaintVenantKirchhoff",
    "Selection",
    "Sensitivity",
    "Shape",
    "SmoothPart",
    "Solid",
    "Sphere",
    "Step",
    "SupportLost",
    "Surface",
    "SurfaceTerm",
    "Table",
    "Term",
    "Tresca",
    "TrustWarning",
    "UserEnergy",
    "UserPlasticity",
    "VonMises",
    "Weights",
    "WhenDistorted",
    "YieldSurface",
    "geotechnics",
    "identify",
    "lines",
    "lines_from",
    "load_restart",
    "plan",
    "plane",
    "read_curve",
    "read_field",
    "register_basis",
    "register_solver",
    "save_restart",
    "seed",
    "seed_mesh",
]

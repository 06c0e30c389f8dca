"""Materials: an energy in UFL and the numbers it needs."""

from .base import Material, UserEnergy
from .classical import Hencky, NeoHookean, SaintVenantKirchhoff
from .gradient import GradientElastic
from .micropolar import MicropolarElastic
from .oriented import OrientedMicropolar
from .rubber import ArrudaBoyce

__all__ = [
    "ArrudaBoyce",
    "GradientElastic",
    "Hencky",
    "Material",
    "MicropolarElastic",
    "NeoHookean",
    "OrientedMicropolar",
    "SaintVenantKirchhoff",
    "UserEnergy",
]

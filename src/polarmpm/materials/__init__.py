"""Materials: an energy in UFL and the numbers it needs."""

from .base import Material, UserEnergy
from .classical import Hencky, NeoHookean
from .micropolar import MicropolarElastic

__all__ = ["Hencky", "Material", "MicropolarElastic", "NeoHookean", "UserEnergy"]

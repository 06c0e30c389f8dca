"""What geotechnical engineers ask of a computation: factors of safety."""

from .reduction import reduced
from .strength import StrengthReduction, Trial, strength_reduction

__all__ = ["StrengthReduction", "Trial", "reduced", "strength_reduction"]

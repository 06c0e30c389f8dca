"""Contributions to the nodal system besides the bodies' stresses: where one adds physics."""

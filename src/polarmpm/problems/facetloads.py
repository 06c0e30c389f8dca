"""Loads on facets of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..bodies.facets import Facets
from ..conditions.amplitudes import Amplitude


@dataclass(eq=False)
class SurfaceLoad:
    """A traction, couple traction or pressure on facets.

    Attributes:
        amplitude: its values; a total when `share` is 1 / area.
        kind: "force", "couple" or "pressure".
        follows: it turns with the surface.
    """

    facets: Facets
    amplitude: Amplitude
    kind: str
    follows: bool
    share: float
    function: Any = None  # its nodal values, made when the system is built
    rows: Any = None  # the nodes of the facets
    position: Any = None  # where they are (n, d) (m)

    def __repr__(self) -> str:
        area = f"{self.facets.area:.6g} {'m^2' if self.facets.body.dim == 3 else 'm'}"
        return f"SurfaceLoad({self.amplitude.name!r} on {area}{', follows' if self.follows else ''})"


@dataclass
class Varying:
    """Compiled forms of loads that depend on the unknowns: virtual work, and minus its derivative."""

    residual: Any
    tangent: Any

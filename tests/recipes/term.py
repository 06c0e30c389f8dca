"""A term of one's own: a Winkler foundation."""

# recipe: begin
from typing import Any

import ufl

import polarmpm as pm


class Winkler(pm.SurfaceTerm):
    """Springs of k (Pa/m) against the displacement along a surface's normal."""

    def energy(self, at: Any, p: Any) -> Any:
        return p.k / 2 * ufl.dot(at.u, at.normal) ** 2


# recipe: end

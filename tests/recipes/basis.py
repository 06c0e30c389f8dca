"""A basis of one's own: once more the tents."""

# recipe: begin
import numpy as np

import polarmpm as pm


class Hats(pm.Basis):
    """All that a basis has to say: its name, its degree, and the functions of a cell along each axis."""

    name = "hats"
    degree = 1
    gradients_jump = True  # at the faces of cells: a ghost penalty makes sense

    def lines(self, grid: pm.Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Values and gradients (1/m) at x (n, d) of the functions of cells (n, d): (n, d, 2, degree + 1)."""
        r, slope = grid.within(x, cells), 1.0 / grid.sizes(cells)
        return np.stack([np.stack([1.0 - r, -slope], axis=2), np.stack([r, slope], axis=2)], axis=3)


pm.register_basis(Hats())  # from now on basis="hats"
# recipe: end

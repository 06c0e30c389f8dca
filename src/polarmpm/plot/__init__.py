"""Figures of points, meshes, grids and load-displacement curves."""

from .figures import gather, load_displacement, plot_mesh, plot_points, save, subplots
from .gridlines import plot_grid

__all__ = ["gather", "load_displacement", "plot_grid", "plot_mesh", "plot_points", "save", "subplots"]

"""Figures of points, meshes and load-displacement curves."""

from .figures import gather, load_displacement, plot_mesh, plot_points, save, subplots

__all__ = ["gather", "load_displacement", "plot_mesh", "plot_points", "save", "subplots"]

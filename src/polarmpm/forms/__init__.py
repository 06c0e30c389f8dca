"""Weak forms at a point, on a surface and on a mesh, in UFL; return mapping."""

"""Sums over points and elements: sparse matrices and nodal systems."""

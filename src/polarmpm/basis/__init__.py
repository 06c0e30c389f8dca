"""Weighting functions on the lattice; each basis is one class in one file."""

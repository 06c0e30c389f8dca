"""Nonlinear and linear solvers, load stepping and arc length, reset policies; they know no body."""

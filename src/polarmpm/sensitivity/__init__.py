"""Derivatives of a run's answers by the numbers that it is built of."""

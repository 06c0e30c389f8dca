"""Rotations, strain measures, the layout of a point's values, the update of a point's motion."""

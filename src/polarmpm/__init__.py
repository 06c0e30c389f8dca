"""Large deformations of micropolar (Cosserat) solids with material points, on FEniCSx."""

__version__ = "0.1.0"

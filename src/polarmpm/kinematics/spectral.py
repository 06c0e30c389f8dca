"""Functions of principal stretches that stay smooth where stretches coincide."""

from __future__ import annotations

from math import exp, factorial
from typing import Any

import ufl

# (ln x / (x - 1))^2 = sum_k _WEIGHTS[k] / (x + _POLES[k]) with a relative error below 4e-11 for x between
# 1/100 and 100, that is for principal stretches between 1/10 and 10: a least-squares fit with poles that are
# equally spaced in ln x. Eigenvalues in closed form would do too, but their derivatives are infinite
# wherever two of them coincide, as in uniaxial stretch.
_POLES = [exp(-7.5 + 15.0 * k / 23) for k in range(24)]
_WEIGHTS = [
    0.028162356742366782,
    -0.016314605842413343,
    0.029867325662239094,
    0.023651291718901533,
    0.04837752130199122,
    0.07717323754849938,
    0.1227310155011898,
    0.18337422712035664,
    0.2501281659829467,
    0.2912293488159919,
    0.253397811605014,
    0.10354327472567015,
    -0.10354338950791118,
    -0.25339741867501436,
    -0.2912302158103016,
    -0.25012624317864574,
    -0.18337909315619794,
    -0.12271607261706209,
    -0.07722907468158528,
    -0.04814279532269591,
    -0.02459352550885939,
    -0.026969406232821912,
    0.011016831466886446,
    -0.02421183816748654,
]


def strain_invariants(F: Any) -> tuple[Any, Any, Any]:
    """tr X, tr(X^2) and det X of X = F^T F - I, for a 3 x 3 deformation gradient in UFL."""
    return tensor_invariants(ufl.dot(ufl.transpose(F), F) - ufl.Identity(3))


def tensor_invariants(x: Any) -> tuple[Any, Any, Any]:
    """tr X, tr(X^2) and det X of a symmetric tensor."""
    return ufl.tr(x), ufl.inner(x, x), ufl.det(x)


def squared_log_strain(first: Any, square: Any, third: Any) -> Any:
    """|ln V|^2, the squared norm of the logarithmic strain, of `strain_invariants`.

    With the eigenvalues x_i - 1 of X it is 1/4 sum_i ln(x_i)^2 = 1/4 sum_k w_k tr(X^2 (X + s_k I)^-1),
    s_k = 1 + pole; the traces are rational in the invariants, without cancellation at small strain.
    """
    second = 0.5 * (first * first - square)
    total = 0.0
    for weight, pole in zip(_WEIGHTS, _POLES, strict=True):
        s = 1.0 + pole
        above = first * third + s * (first * second - 3.0 * third) + s * s * square
        below = third + s * (second + s * (first + s))
        total += weight * above / below
    return 0.25 * total


_TERMS = 20  # of the exponential: machine precision up to a norm of the deviator of 2


def exp_symmetric(a: Any) -> Any:
    """exp(a) of a symmetric 3 x 3 tensor.

    Its series is summed up modulo the characteristic polynomial of the deviator d, d^3 = J2 d + J3 I, so that
    three scalars are all that is summed.
    """
    d = ufl.dev(a)
    second, third = 0.5 * ufl.inner(d, d), ufl.det(d)
    c0, c1, c2 = ufl.as_ufl(1.0 / factorial(_TERMS)), ufl.as_ufl(0.0), ufl.as_ufl(0.0)
    for k in range(_TERMS - 1, -1, -1):
        c0, c1, c2 = 1.0 / factorial(k) + third * c2, c0 + second * c2, c1
    return ufl.exp(ufl.tr(a) / 3) * (c0 * ufl.Identity(3) + c1 * d + c2 * ufl.dot(d, d))

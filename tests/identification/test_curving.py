"""Steps of least squares that follow a curved valley."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.identification import minimising
from polarmpm.identification.curving import Model, Point, best_step, latest


def valley(v):
    """Residuals (3,) whose least values lie on y = x^2, and their derivatives."""
    x, y = v
    r = np.array([1.0 - 0.1 * x, 10.0 * (y - x**2), 0.1 * y])
    return Point(np.array(v, dtype=float), r, np.array([[-0.1, 0.0], [-20.0 * x, 10.0], [0.0, 0.1]]))


def curve(t):
    """Residuals that are cubic along the first unknown, and their derivatives."""
    a = np.array([[1.0, 2.0], [0.5, -1.0], [2.0, 0.3]])
    b, c = np.array([0.3, -2.0, 1.0]), np.array([0.1, 0.4, -0.2])
    r = a @ t + b * t[0] ** 2 + c * t[0] ** 3
    return Point(np.array(t), r, a + np.outer(2 * b * t[0] + 3 * c * t[0] ** 2, [1.0, 0.0]))


def test_what_is_known_between_two_points_is_met():
    here, other = curve(np.array([0.2, 0.1])), curve(np.array([0.9, 0.1]))
    model = Model(here, other)
    for share in (0.0, 0.4, 1.0):
        s = np.array([0.7 * share, 0.0])
        expected = curve(here.v + s)
        np.testing.assert_allclose(model(s)[0], expected.residual, atol=1e-12)
        np.testing.assert_allclose(model(s)[1], expected.jacobian, atol=1e-12)


@pytest.mark.parametrize("s", [(0.3, 0.2), (-0.3, 0.4)])
def test_derivatives_of_the_model(s):
    model, h = Model(valley((0.5, 0.1)), valley((0.8, 0.9))), 1e-6
    slopes = [(model(np.array(s) + e)[0] - model(np.array(s) - e)[0]) / (2 * h) for e in h * np.eye(2)]
    np.testing.assert_allclose(model(np.array(s))[1], np.transpose(slopes), rtol=1e-7, atol=1e-7)
    straight = Model(valley((0.5, 0.1)), None)
    np.testing.assert_allclose(straight(np.array(s))[1], valley((0.5, 0.1)).jacobian)


def test_an_earlier_point_that_tells_nothing_is_left_out():
    """What its derivatives predict of its residuals is further off than a straight line."""
    here, other = valley((0.5, 0.1)), valley((0.8, 0.9))
    wrong = Point(other.v, other.residual, here.jacobian + 100.0)
    s = np.array([0.1, 0.2])
    np.testing.assert_allclose(Model(here, wrong)(s)[0], Model(here, None)(s)[0])


def test_a_step_within_its_region():
    """On its edge the gradient points along the step; inside the model's minimum is found."""
    here = valley((2.0, 3.0))
    for region in (0.1, 0.5, 50.0):
        model = Model(here, None)
        s, gain = best_step(model, region)
        r, j = model(s)
        gradient = j.T @ r
        assert gain == pytest.approx(here.square - r @ r)
        if np.linalg.norm(s) < 0.999 * region:
            np.testing.assert_allclose(gradient, 0.0, atol=1e-8)
        else:
            assert np.linalg.norm(s) == pytest.approx(region, rel=1e-6)
            along = -(gradient @ s) / (np.linalg.norm(gradient) * region)
            assert along == pytest.approx(1.0, abs=1e-8)


def test_the_point_that_was_known_last():
    points = [valley((x, 0.0)) for x in (0.0, 1.0, 2.0)]
    assert latest(points[2], points) is points[1]
    assert latest(points[1], points) is points[2]
    assert latest(points[0], points[:1]) is None


def banana(p, at):
    """Two unknowns that data hardly tell apart but along a curve."""
    a, b = np.log(p["a"]), np.log(p["b"])
    return {"y": np.array([5.0 + a, 30.0 * (b - a**2), 0.01 * b])}


def test_fewer_evaluations_in_a_curved_valley(monkeypatch):
    def evaluations():
        data = {"y": (banana({"a": np.exp(0.9), "b": np.exp(0.81)}, None)["y"], 0.01)}
        test = pm.Experiment(banana, at=[0.0, 1.0, 2.0], data=data)
        fit = pm.identify(test, start={"a": np.exp(-0.6), "b": np.exp(0.4)}, free=["a", "b"])
        assert fit.values["a"] == pytest.approx(np.exp(0.9), rel=1e-6)
        return fit.evaluations

    found = evaluations()
    monkeypatch.setattr(minimising, "latest", lambda here, known: None)
    assert found < 0.8 * evaluations()

"""What is said of the trust in plastic bodies of few elements."""

import warnings

import pytest

import polarmpm as pm
from tests.helpers.bodies import box

SOIL = pm.VonMises(pm.NeoHookean.from_engineering(E=1e6, nu=0.3), k=4e3, H=2e4)


def said(cells, degree, weight=260.0, steps=6, squeezed=False):
    """Of a cantilever of 3 x 0.8 m under its weight, or of a block that is pressed from all sides."""
    body = pm.Elements(box("quadrilateral", cells, (3.0, 0.8)), material=SOIL, degree=degree)
    problem = pm.QuasiStaticFEM(body)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if squeezed:
            problem.fix(lambda x: x[:, 0] > -1.0, u=lambda t, x: -0.01 * t * x)
        else:
            problem.fix(pm.plane(x=0.0), u=0)
            problem.body_load(force=(0, -weight))
        for _ in problem.march(steps, adaptive=True, progress=False):
            pass
    texts = "".join(str(w.message) for w in caught if w.category is pm.TrustWarning)
    return problem.comm.bcast(texts), problem.trust()


@pytest.mark.parametrize("degree", [1, 2])
def test_one_element_across(degree):
    """They find nine times and twice as much displacement."""
    told, line = said((6, 1), degree, 200.0)
    assert "vary within the elements of a plastic body" in told
    assert "in doubt" in line


def test_linear_elements_near_a_limit_load():
    """16 % too little displacement; elements of degree 2 are 3 % off."""
    told, line = said((12, 3), 1)
    assert "near its limit load the body gives way" in told
    assert "in doubt" in line
    told, line = said((12, 3), 2)
    assert told == ""
    assert "vary within the elements: compare" in line


def test_where_nothing_varies():
    """Far from the limit load, and pressed alike everywhere."""
    assert said((12, 3), 1, 100.0, 2)[0] == ""
    assert said((6, 1), 1, squeezed=True, steps=1)[0] == ""


def test_a_restart_file_has_it(tmp_path_factory):
    """A run that goes on warns no second time, and knows how near the limit load the body was."""

    def cantilever():
        body = pm.Elements(box("quadrilateral", (6, 1), (3.0, 0.8)), material=SOIL, degree=1)
        problem = pm.QuasiStaticFEM(body)
        problem.fix(pm.plane(x=0.0), u=0)
        problem.body_load(force=(0, -200.0))
        return problem

    first, second = cantilever(), cantilever()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        list(first.march(3, progress=False))
    file = first.comm.bcast(tmp_path_factory.mktemp("doubts") / "run.h5")
    pm.save_restart(first, file)
    pm.load_restart(second, file)
    assert second.trust() == first.trust()
    assert second.element_record.state() == first.element_record.state()

"""What a problem offers of the folders above its own: looked up when it is called, so that runs without it
start no output and no figures."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks
from ..tools.meetings import collective

_PACKAGE = __package__.rpartition(".")[0]


class Face:
    """Probes, recovered values and a picture of a problem. All methods are collective."""

    comm: Any
    points: Any
    _probes: dict[str, Any]

    @property
    def probes(self) -> dict[str, Any]:
        """The probes by their names, see `probe`."""
        return dict(self._probes)

    @collective("probe", compare=True)
    def probe(self, name: str, at: Any, fields: Any = "displacement") -> Any:
        """Follow values at a material place through the run, a row a converged step.

            tip = problem.probe("tip", at=(4.0, 0.5), fields=("displacement", "stress"))
            with pm.Table("bar.csv", problem) as table:  # with columns tip_displacement_x and so on
                for step in problem.march(10):
                    table.record(step)
            plt.plot(tip.factor, tip["displacement"][:, 1])

        The present state is the first row. The history goes into restart files.

        Args:
            name: of the probe, by which `problem.probes` has it, and of its columns in tables.
            at: a place in the undeformed body (m), (d,), where values are fitted to the points around it (see
                `recover`), or a selection of points, of which the mean is taken.
            fields: names of fields, or fields of your own, as of `Recorder`.

        Returns:
            The probe: `probe["stress"]` (rows, 3, 3), `probe.factor` (rows,), `probe.now()`.

        Raises:
            InputError: a name that is taken, a place outside of the body, an unknown field.
        """
        if checks.text("name", name) in self._probes:
            raise InputError(f"name = {name!r}: there is a probe of this name")
        return import_module(f"{_PACKAGE}.io.probes").Probe(self, name, at, fields)

    @collective("recover")
    def recover(self, field: Any, at: Any = None) -> np.ndarray:
        """A field's values at places of the undeformed body, smooth from one to the next. Collective.

        Stresses are computed at points, and are best there. Here polynomials of degree 2 are fitted to the
        nearest points of one material, as `bodies.recovery` says.

        Args:
            field: a name, or a field of your own, as of `Recorder`.
            at: a place (d,) or places (m, d) (m), the same on all ranks; None: this rank's nodes of a mesh.

        Returns:
            The value (...), or values (m, ...); of vectors (d,) components.

        Raises:
            InputError: an unknown field, a place outside of the body, or None where there is no mesh.
        """
        found: np.ndarray = import_module(f"{_PACKAGE}.io.probes").recover(self, field, at)
        return found

    @collective("view")
    def view(self, field: Any = "displacement", component: str | None = None, **options: Any) -> Any:
        """A picture of the present state, to be looked at: in a notebook it shows itself, in a script
        `.show()` opens a window and `.save("now.png")` writes it.

        Args:
            field: a name, or a field of your own, as of `Recorder`, or None.
            component: of it, such as "x", "xy" or "1"; by default the size of a vector or tensor.
            **options: of `plot.plot_points` or `plot.plot_mesh`, or `renderer="pyvista"`, see `plot.view`.

        Raises:
            InputError: an unknown field or component, an option that isn't so.
        """
        return import_module(f"{_PACKAGE}.plot").view(self, field, component, **options)

"""What restart files, and points that move to other ranks, need of loads and terms."""

from __future__ import annotations

import numpy as np

from ..conditions.loads import AnyLoad, HandedOver
from ..conditions.supports import Support
from ..errors import InputError
from ..terms.base import Term


class Keeping:
    """Loads and terms of a problem, with what of them is kept from step to step."""

    _loads: list[AnyLoad]
    _terms: list[Term]
    # released since the last converged step: a balanced reset must not carry along what they did
    _leaving: list[Support | Term]

    @property
    def _handed(self) -> list[HandedOver]:
        return [load for load in self._loads if isinstance(load, HandedOver)]

    @property
    def _working_terms(self) -> list[Term]:
        """Terms, with those that have been released since the last converged step."""
        return [*self._terms, *(t for t in self._leaving if isinstance(t, Term))]

    def term_state(self) -> dict[str, np.ndarray]:
        """What a restart needs of the terms, the same on every rank, by names such as "0/u"."""
        return {f"{k}/{name}": a for k, term in enumerate(self._terms) for name, a in term.state().items()}

    def term_rows(self) -> dict[str, np.ndarray]:
        """The terms' rows of the local points, by names such as "term 0.mass"."""
        terms = enumerate(self._working_terms)
        return {f"term {k}.{name}": a for k, term in terms for name, a in term.rows.items()}

    def restore_term_rows(self, rows: dict[str, np.ndarray]) -> None:
        """Put in rows such as those of `term_rows`, of which there may be others."""
        for k, term in enumerate(self._working_terms):
            start = f"term {k}."
            term.rows = {name[len(start) :]: a for name, a in rows.items() if name.startswith(start)}

    def restore_terms(self, arrays: dict[str, np.ndarray], known: int | None = None) -> None:
        """Put in what `term_state` gave, before `restore`; the problem has the same terms.

        Args:
            known: how many there were; those that come after them are new.

        Raises:
            InputError: other terms.
        """
        with_state = [k for k, term in enumerate(self._terms[:known]) if term.state()]
        saved = {int(key.split("/")[0]) for key in arrays}
        if saved != set(with_state):
            raise InputError(
                f"the saved state has {len(saved)} term(s) with a state of their own, the problem has "
                f"{len(with_state)}"
            )
        for term in self._terms[:known]:
            term.committed = True
        for k in with_state:
            start = f"{k}/"
            of_this = {key[len(start) :]: a for key, a in arrays.items() if key.startswith(start)}
            self._terms[k].restore(of_this)

    def load_rows(self) -> dict[str, np.ndarray]:
        """Rows of the local points of the reactions that were handed over, by name."""
        return {f"handed {k}": load.values for k, load in enumerate(self._handed)}

    def restore_load_rows(self, rows: dict[str, np.ndarray]) -> None:
        """Put in rows such as those of `load_rows`, of which there may be others."""
        for k, load in enumerate(self._handed):
            load.values = rows[f"handed {k}"]

"""What a problem tells of its last converged state: fields, energies, reactions and the balance."""

from __future__ import annotations

from typing import Any

from ..conditions.supports import Support
from ..errors import InputError
from ..forms.stresses import MaterialField
from ..terms.obstacles import Obstacle
from ..terms.surfaces import SurfaceSupport
from ..tools.checks import shown
from ..tools.meetings import collective
from .face import Face
from .initial import Initial
from .reactions import Balance, Reaction, point_about, surface_reaction
from .state import Fields, StateFields, choose_fields


class Results(Initial, Face):
    """Results of a problem. All methods are collective."""

    _fields: StateFields

    @collective("fields")
    def fields(self, *names: str | MaterialField) -> Fields:
        """Energy, Cauchy stress and couple stress at the local points, or what is asked for.

        Args:
            *names: any of energy (Pa), stress (Pa), couple_stress (N/m), mean_pressure (Pa), p (the same), q
                (Pa), von_mises (the same), lode_angle (rad), principal_stress (Pa; of the symmetric part, the
                largest first), skew_stress (Pa) and, with plastic materials, plastic_strain (ln(Fp^T Fp)/2)
                and equivalent_plastic_strain (sqrt(2/3 e : e) of its deviator e), with second-gradient ones
                double_stress (N/m), or a `MaterialField`; default: energy and stresses.

        Returns:
            The fields by name; `.energy`, `.stress` and `.couple_stress` for short.

        Raises:
            InputError: an unknown name.
        """
        return self._fields.evaluate(self.points, choose_fields(names, self.points))

    @collective("energy")
    def energy(self) -> float:
        """Strain energy of the body (J)."""
        energy: float = self.comm.allreduce(float(self.fields("energy").energy @ self.points.volume0))
        return energy

    @collective("energies")
    def energies(self) -> dict[str, float]:
        """Energy balance of the run so far, in J (J per unit thickness in plane strain).

        - external: work of the loads, of the supports' reactions on prescribed displacements, and of contact,
          whose springs hold some of it while they are pressed, and whose friction takes some; also what an
          initial stress has stored before the first step;
        - carried: work of the initial stresses and forces that balanced resets carry along, and the energy of
          points that have been removed;
        - stored: strain energy, with what hardening stores;
        - dissipated: by plastic flow;
        - ghost: work against the ghost penalty's forces;
        - patches: work against what holds points to the volume of their patch, see `locking`;
        - terms: work against the forces of other terms that aren't loads or supports;
        - residue: external + carried - stored - dissipated - ghost - patches - terms: the error of the
          trapezoidal rule, which falls with the square of the step, and what relaxes at resets that aren't
          balanced and where couples in space meet a new base of the rotations.
        """
        p, dissipated = self.progress, 0.0
        if self.points.plastic:
            dissipated = self.comm.allreduce(float(self.points.dissipation @ self.points.volume0))
        out = {
            "external": p.external_work,
            "carried": p.carried_work,
            "stored": self.energy(),
            "dissipated": dissipated,
            "ghost": p.ghost_work,
            "patches": p.patch_work,
            "terms": p.term_work,
        }
        gained = p.external_work + p.carried_work
        spent = dissipated + p.ghost_work + p.patch_work + p.term_work
        return out | {"residue": gained - out["stored"] - spent}

    @collective("reaction", compare=True)
    def reaction(self, support: Support | SurfaceSupport | Obstacle, about: Any = None) -> Reaction:
        """Force (N), shape (d,), couple (N m), shape (r,), and moment with which a support holds the body in
        the last converged step, by the components that it prescribes: `force, couple = problem.reaction(s)`,
        or `.force`, `.couple` and `.moment`, see `Reaction`.

        The couple sums the nodes' couples. The moment is that of forces and couples about the point `about`
        (default: the origin), where nodes and body are now; couples count in it.

        Where two supports hold the same unknown, its force belongs to the one that was given first; the
        other's `shared` says what that is. So the reactions of all supports add up.

        Raises:
            InputError: nothing has been solved yet, the support has been released, or not what `fix` has
                returned.
        """
        if not isinstance(support, Support | SurfaceSupport | Obstacle):
            raise InputError(
                f"reaction: support = {shown(support)} is not what fix has returned, or obstacle"
            )
        point, given = point_about(about, self.layout.dim), self.given.of(support)
        if given is None or not isinstance(given.condition, Support | SurfaceSupport | Obstacle):
            raise InputError(f"reaction: {support.name} isn't a support of this problem")
        if given.released is not None:
            raise InputError(f"reaction: {support.name} was released at load factor {given.released:g}")
        e = self._equilibrium
        if isinstance(support, SurfaceSupport | Obstacle):
            if e is not None and support.reaction is not None:
                return surface_reaction(support, point)
        elif e is not None and support in e.supports:
            return e.reaction(support, point)
        raise InputError(f"reaction: no load step has been solved yet with {support.name}")

    def trust(self) -> str:
        """How far the run can be trusted, in a line."""
        if not self.progress.step:
            return "no measure of trust: no step yet"
        return (
            "in equilibrium to the tolerances; what the mesh leaves out isn't measured: compare with cells "
            "of half the size (docs/accuracy.md)"
        )

    @collective("balance", compare=True)
    def balance(self, about: Any = None) -> Balance:
        """Loads, reactions and what else acts on the body in the last converged step: forces, and moments
        about the point `about` (default: the origin) in the current configuration. Print it.

        Raises:
            InputError: nothing has been solved yet.
        """
        point = point_about(about, self.layout.dim)
        if self._equilibrium is None:
            raise InputError("balance: no load step has been solved yet")
        return self._equilibrium.balance(point)

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the last step, prescribed ones included."""
        return 0 if self.system is None else self.system.nodes.total * self.layout.block

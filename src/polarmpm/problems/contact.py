"""Contact with rigid obstacles, in the words of a script."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..bodies.selection import Selection
from ..geometry.shapes import Shape
from ..terms.bodycontact import BodyContact
from ..terms.obstacles import Obstacle
from ..terms.rigid import RigidBody
from ..tools.meetings import collective
from .conditions import Conditions
from .obstacles import add_obstacle
from .touching import add_body_contact


class Contact(Conditions):
    """Obstacles, and contact of bodies with each other. All methods are collective."""

    @collective("obstacle", compare=True)
    def obstacle(
        self,
        phi: Shape | Callable[..., Any],
        *,
        on: Any = None,
        friction: float = 0.0,
        rolling: float = 0.0,
        drilling: float = 0.0,
        stiffness: float | None = None,
        gap: float | None = None,
        barrier: float | None = None,
        motion: Any = None,
        rotation: Any = None,
        about: Any = None,
        body: RigidBody | None = None,
        name: str | None = None,
    ) -> Obstacle:
        """A rigid obstacle that the body touches, presses against and slides on (docs/contact.md).

        Args:
            phi: a shape: `HalfSpace`, `Sphere` (a disc in the plane), `Cylinder`, `Box`, `Polygon`, `Solid`
                (an STL file); or a function (x) or (x, t) of the place (m) and the load factor that gives a
                UFL scalar, positive outside of the obstacle, zero on its surface.
            on: places of the body that may touch it: a `Surface`, or the name of a group of facets of the
                points' mesh; of finite elements also what `elements.facets` takes. Default: the body's whole
                boundary, of material points the corners of their domains that no others share.
            friction: Coulomb's coefficient.
            rolling, drilling: of micropolar bodies: resistance to turning about axes in the surface (in the
                plane: to turning) and about its normal: lengths (m), times the pressure the largest couple
                traction.
            stiffness: pressure per depth (Pa/m); default: ten times the stiffest material's lam + 2 mu over a
                cell.
            gap: largest gap and depth (m) of places under pressure in a converged step (augmented Lagrange
                method). Default: springs alone, whose depth is pressure / stiffness.
            barrier: instead of springs: the pressure sets in at this distance (m) and grows beyond all bounds
                before the surface is touched.
            motion: displacement (m) of the obstacle, as values of `fix`: a number is ramped with the load
                factor, a function of the factor gives it.
            rotation: its turn about the point `about` (default: the origin), an angle (rad) or in space a
                rotation vector. A level set that depends on t moves along its normals only: it drags nothing.
            body: a `RigidBody` whose surface this is, instead of `motion`: it has a mass, loads and motions
                of its own, and is pushed back. The shape is where it is at the beginning.
            name: for messages and results.

        Returns:
            The obstacle, for `reaction` and `release`; its `force`, `moment`, `gap`, `pressure` and
            `traction` are those of the last step.

        Raises:
            InputError: something that isn't so; a shape of another dimension, a body that begins inside of
                it.
        """
        self._check_outside("obstacle")
        options = {
            **{"friction": friction, "rolling": rolling, "drilling": drilling, "stiffness": stiffness},
            **{"gap": gap, "barrier": barrier, "motion": motion, "rotation": rotation, "about": about},
            **{"name": name, "body": body},
        }
        return add_obstacle(self, phi, on, options)

    @collective("contact", compare=True)
    def contact(
        self,
        a: Selection | None = None,
        b: Selection | None = None,
        *,
        on: Any = None,
        friction: float = 0.0,
        stiffness: float | None = None,
        gap: float | None = None,
        name: str | None = None,
    ) -> BodyContact:
        """Contact of bodies with each other, that is of points which are several bodies (`points.separate`,
        `points.join(other, apart=True)`; docs/contact.md). A body has no contact with itself.

        Args:
            a, b: points of different bodies, whose surfaces touch each other. Default: all bodies do.
            on: the bodies' surfaces: a `Surface`, the name of a group of facets of the points' mesh, or a
                list of such. Default: the faces of the points' domains that no others of their body share.
            friction: Coulomb's coefficient.
            stiffness: pressure per depth (Pa/m); default: ten times lam + 2 mu of the softer body over a
                cell.
            gap: largest gap and depth (m) of places under pressure in a converged step (augmented Lagrange
                method). Default: springs alone, whose depth is pressure / stiffness.
            name: for messages and results.

        Returns:
            The contact, for `release`; its `force`, `gap`, `pressure` and `traction` are those of the last
            step.

        Raises:
            InputError: something that isn't so; points that are one body; finite elements. When the next step
                begins: bodies that are inside of each other.
        """
        self._check_outside("contact")
        options = {"friction": friction, "stiffness": stiffness, "gap": gap, "name": name}
        return add_body_contact(self, a, b, on, options)

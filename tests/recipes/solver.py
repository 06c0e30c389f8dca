"""A linear solver of one's own: a Krylov method, scaled by the diagonal."""

# recipe: begin
from petsc4py import PETSc

import numpy as np

import polarmpm as pm
from polarmpm.solvers.linear import ACCURACY, SingularTangent, Tangent


class Diagonal:
    """A Krylov method, preconditioned by the diagonal."""

    def __init__(self, tangent: Tangent):
        self.matrix = tangent.matrix
        self.solution, self.rhs = self.matrix.createVecs()
        self.method = PETSc.KSP().create(self.matrix.comm)
        self.method.setType("cg" if tangent.symmetric else "gmres")
        self.method.getPC().setType("jacobi")
        self.method.setOperators(self.matrix)

    def factor(self) -> None:
        """Nothing to prepare: the diagonal is taken anew."""

    def solve(self, rhs: np.ndarray, accuracy: float = ACCURACY) -> np.ndarray:
        self.method.setTolerances(rtol=accuracy, max_it=10_000)
        self.rhs.array[:] = rhs
        self.method.solve(self.rhs, self.solution)
        if self.method.getConvergedReason() <= 0:
            raise SingularTangent("the Krylov method has not converged")
        return self.solution.array.copy()

    def destroy(self) -> None:
        for thing in (self.method, self.matrix, self.rhs, self.solution):
            thing.destroy()


pm.register_solver("diagonal", Diagonal)
# recipe: end

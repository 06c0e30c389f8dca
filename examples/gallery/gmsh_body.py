"""
A body from gmsh
================

gmsh describes a body; names of its groups become selections and supports. The same model makes material
points (`pm.seed_mesh`) or finite elements (`pm.Elements`), which are taken here.
"""

import gmsh
import matplotlib.pyplot as plt

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
occ = gmsh.model.occ
holes = [(2, occ.addDisk(x, 1, 0, 0.5, 0.5)) for x in (1.2, 2.8)]
occ.cut([(2, occ.addRectangle(0, 0, 0, 4, 2))], holes)
occ.synchronize()
plates = [tag for _, tag in gmsh.model.getEntities(2)]
gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, plates), "plate")
for name, x in (("left", 0.0), ("right", 4.0)):
    lines = gmsh.model.getEntitiesInBoundingBox(x - 0.01, -1, -1, x + 0.01, 3, 1, dim=1)
    gmsh.model.setPhysicalName(1, gmsh.model.addPhysicalGroup(1, [tag for _, tag in lines]), name)
gmsh.option.setNumber("Mesh.MeshSizeMax", 0.2)
gmsh.model.mesh.generate(2)

rubber = pm.NeoHookean.from_engineering(E=1e6, nu=0.4)
elements = pm.Elements(gmsh.model, material=rubber, degree=2)
gmsh.finalize()

problem = pm.QuasiStaticFEM(elements)
problem.fix("left", u=0)
problem.fix("right", ux=3.0, uy=0)
list(problem.march(10, progress=False))

fig, ax = plt.subplots(figsize=(6, 2.4))
stress = problem.fields("stress").stress[:, 0, 0] / 1e3
plot.plot_mesh(elements, stress, at="points", label=r"$\sigma_{xx}$ (kPa)", ax=ax)
plt.show()

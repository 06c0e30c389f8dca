"""One run of Kratos' MPM application for `peer_kratos.py`, by the interpreter of Kratos' environment.

Takes the scene and the run as JSON; the last line of the output is JSON, too. Every node set, material and
load is made here, so that no input files are needed but for the material's.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import KratosMultiphysics as KM
import KratosMultiphysics.MPMApplication as MPM
import numpy as np
from KratosMultiphysics.MPMApplication.mpm_analysis import MpmAnalysis


class Analysis(MpmAnalysis):
    """Counts iterations and the CPU time of the loop over load steps; with `trace` it follows the tip."""

    def prepare(self, trace):
        self.trace, self.path, self.iterations, self.converged = trace, [], [], []
        self.Initialize()
        self.body = self.model["MPM_Material"]
        x = self.at_points(MPM.MP_COORD)
        self.tip = x[:, 0] > x[:, 0].max() - 1e-9

    def at_points(self, variable):
        info = self.body.ProcessInfo
        return np.array([e.CalculateOnIntegrationPoints(variable, info)[0] for e in self.body.Elements])

    def tip_displacement(self):
        return self.at_points(MPM.MP_DISPLACEMENT)[self.tip, :2].mean(axis=0).tolist()

    def SolveSolutionStep(self):
        found = super().SolveSolutionStep()
        self.converged.append(bool(found))
        self.iterations.append(self.body.ProcessInfo[KM.NL_ITERATION_NUMBER])
        return found

    def FinalizeSolutionStep(self):
        super().FinalizeSolutionStep()
        if self.trace:
            self.path.append(self.tip_displacement())


def parameters(scene, run, folder):
    """What Kratos calls project parameters."""
    variables = {
        "THICKNESS": 1.0,
        "MATERIAL_POINTS_PER_ELEMENT": 1,
        "DENSITY": 1000.0,
        "YOUNG_MODULUS": scene["E"],
        "POISSON_RATIO": scene["nu"],
    }
    law = {"name": "HyperElasticNeoHookeanPlaneStrain2DLaw"}
    material = {
        "model_part_name": "Initial_MPM_Material.Beam",
        "properties_id": 1,
        "Material": {"constitutive_law": law, "Variables": variables, "Tables": {}},
    }
    materials = Path(folder) / "materials.json"
    materials.write_text(json.dumps({"properties": [material]}))
    search = {
        "search_algorithm_type": "bin_based",
        "max_number_of_results": 1000,
        # of cells; Kratos' own value keeps points in a cell that they have left, which shows in the path
        "searching_tolerance": 1e-7 if run["trace"] else 1e-5,
        "remove_entities_not_found": True,
    }
    made_here = {"input_type": "use_input_model_part"}
    solver = {
        "solver_type": "Quasi-static",
        "model_part_name": "MPM_Material",
        "domain_size": 2,
        "echo_level": 0,
        "analysis_type": "non_linear",
        "model_import_settings": made_here,
        "grid_model_import_settings": made_here,
        "material_import_settings": {"materials_filename": str(materials)},
        "time_stepping": {"time_step": 1.0 / scene["steps"]},
        "convergence_criterion": f"{run['criterion']}_criterion",
        "residual_relative_tolerance": scene["tolerance"],
        "residual_absolute_tolerance": scene["tolerance"],
        "displacement_relative_tolerance": scene["displacement_tolerance"],
        "displacement_absolute_tolerance": 1e-12,
        "max_iteration": scene["max_iterations"],
        "block_builder": run["builder"] == "block",
        "auxiliary_variables_list": ["NORMAL"],
        "element_search_settings": search,
        "linear_solver_settings": {"solver_type": run["linear_solver"]} | run["linear_settings"],
    }
    root = {
        "model_part_name": "Background_Grid.Root",
        "variable_name": "DISPLACEMENT",
        "constrained": [True, True, True],
        "value": [0.0, 0.0, 0.0],
        "interval": [0.0, "End"],
    }
    share = scene["force"] / (round(scene["height"] / scene["cell"]) * run["per_cell"])
    load = {
        "model_part_name": "Background_Grid.Load",
        "material_points_per_condition": 1,
        "variable_name": "POINT_LOAD",
        "modulus": f"{share!r}*t",
        "direction": [0.0, -1.0, 0.0],
    }
    return {
        "problem_data": {
            "problem_name": "cantilever",
            "parallel_type": "OpenMP",
            "start_time": 0.0,
            "end_time": 1.0 - 1e-9,  # sums of the time step may end a rounding below one
            "echo_level": 0,
        },
        "solver_settings": solver,
        "processes": {
            "constraints_process_list": [
                process("KratosMultiphysics", "assign_vector_variable_process", root)
            ],
            "loads_process_list": [
                process(
                    "KratosMultiphysics.MPMApplication", "apply_mpm_particle_neumann_condition_process", load
                )
            ],
        },
    }


def process(application, module, arguments):
    return {"python_module": module, "kratos_module": application, "Parameters": arguments}


def lattice(part, box, cell, nodes, elements, properties):
    """Quadrilaterals of a box, numbered from `nodes` and `elements` on; returns the nodes' numbers."""
    (x0, y0), (x1, y1) = box
    nx, ny = round((x1 - x0) / cell), round((y1 - y0) / cell)
    for k in range((nx + 1) * (ny + 1)):
        j, i = divmod(k, nx + 1)
        part.CreateNewNode(nodes + k, x0 + i * cell, y0 + j * cell, 0.0)
    for k in range(nx * ny):
        j, i = divmod(k, nx)
        n = nodes + j * (nx + 1) + i
        part.CreateNewElement("Element2D4N", elements + k, [n, n + 1, n + nx + 2, n + nx + 1], properties)
    return range(nodes, nodes + (nx + 1) * (ny + 1))


def build(model, scene, run):
    """Grid, body and loaded places.

    The body's mesh has one cell for each point, so that points lie equally spaced; Kratos puts a single point
    to the centre of a cell.
    """
    grid, body = model["Background_Grid"], model["Initial_MPM_Material"]
    lattice(grid, scene["box"], scene["cell"], 1, 1, grid.CreateNewProperties(0))
    grid.CreateSubModelPart("Root").AddNodes([n.Id for n in grid.Nodes if n.X < 1e-9])
    next_node, next_element = grid.NumberOfNodes() + 1, grid.NumberOfElements() + 1
    spacing = scene["cell"] / run["per_cell"]
    corners = ((0.0, 0.0), (scene["length"], scene["height"]))
    beam, properties = body.CreateSubModelPart("Beam"), body.CreateNewProperties(1)
    nodes = lattice(beam, corners, spacing, next_node, next_element, properties)
    load = grid.CreateSubModelPart("Load")
    for k in range(round(scene["height"] / spacing)):
        at = scene["length"] - spacing / 2, (k + 0.5) * spacing
        load.CreateNewNode(nodes.stop + k, *at, 0.0)
        load.CreateNewCondition("PointCondition2D1N", k + 1, [nodes.stop + k], grid.GetProperties()[0])


def main():
    scene, run = json.loads(sys.argv[1]), json.loads(sys.argv[2])
    KM.Logger.GetDefaultOutput().SetSeverity(KM.Logger.Severity.WARNING)
    model = KM.Model()
    with tempfile.TemporaryDirectory() as folder:
        settings = KM.Parameters(json.dumps(parameters(scene, run, folder)))
        analysis = Analysis(model, settings)
        build(model, scene, run)
        analysis.prepare(run["trace"])
    points = analysis.body.NumberOfElements()
    begin = time.process_time()
    analysis.RunSolutionLoop()
    loop = time.process_time() - begin
    result = {
        "points": points,
        "left": analysis.body.NumberOfElements(),
        "steps": len(analysis.iterations),
        "iterations": sum(analysis.iterations),
        "of_steps": analysis.iterations,
        "unconverged": [k + 1 for k, found in enumerate(analysis.converged) if not found],
        "tip": analysis.tip_displacement(),
        "path": analysis.path,
        "loop_s": loop,
        "process_s": time.process_time(),
    }
    print("\n" + json.dumps(result))


if __name__ == "__main__":
    main()

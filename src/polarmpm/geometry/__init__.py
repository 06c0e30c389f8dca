"""The lattice, its cells and active nodes; meshes, planes and surfaces."""

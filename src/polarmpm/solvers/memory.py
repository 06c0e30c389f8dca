"""Memory that a factor may take."""

from __future__ import annotations

import os

from mpi4py import MPI

_MEMORY = 0.8  # of what is free, for a factor where multigrid fails


def free_memory(comm: MPI.Comm) -> int:
    """Memory (MB) that a rank may take, if all ranks share the machine's; 0 where that isn't known. A factor
    that doesn't fit has to fail before the process is killed for it. Collective."""
    free = 0
    if os.path.exists("/proc/meminfo"):
        with open("/proc/meminfo") as lines:
            free = next((int(line.split()[1]) // 1024 for line in lines if "MemAvailable" in line), 0)
    return int(comm.allreduce(int(_MEMORY * free / comm.size), op=MPI.MIN))

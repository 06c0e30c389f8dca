"""Output: ParaView files and tables."""

from .recorder import Recorder
from .table import Table, read_table

__all__ = ["Recorder", "Table", "read_table"]

"""Output: ParaView files and tables."""

from .fields import Field, field_values
from .recorder import Recorder
from .table import Table, read_table

__all__ = ["Field", "Recorder", "Table", "field_values", "read_table"]

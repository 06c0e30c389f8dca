"""Measured curves from files, with their units."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks

_PREFIXES = {
    "": 1.0,
    "G": 1e9,
    "M": 1e6,
    "k": 1e3,
    "c": 1e-2,
    "m": 1e-3,
    "u": 1e-6,
    "µ": 1e-6,
    "μ": 1e-6,
    "n": 1e-9,
}
_UNITS = {"m": 1.0, "N": 1.0, "Pa": 1.0, "s": 1.0, "rad": 1.0, "J": 1.0, "g": 1e-3, "bar": 1e5}
_PLAIN = {
    **{
        "": 1.0,
        "-": 1.0,
        "1": 1.0,
        "%": 0.01,
        "deg": np.pi / 180,
        "°": np.pi / 180,
        "t": 1e3,
        "min": 60.0,
        "h": 3600.0,
    },
    **{"in": 0.0254, "ft": 0.3048, "lbf": 4.4482216152605, "psi": 6894.757293168361},
}
_MISSING = ("", "nan", "na", "n/a", "-", "none", "null")


def unit(text: str) -> float:
    """What one of a unit is in SI units: "kN" 1000, "N mm" 1e-3, "1/m" 1, "MN/m^2" 1e6, "deg" pi / 180.

    Raises:
        InputError: a unit that isn't known.
    """
    checks.instance("unit", text, str, "a text such as 'mm' or 'kN m' is")
    factor, sign = 1.0, 1
    for part in re.findall(r"[^\s*·/]+|/", text.replace("²", "^2").replace("³", "^3").replace("⁴", "^4")):
        if part == "/":
            sign = -1
            continue
        found = re.fullmatch(r"(.*?)(?:\^|\*\*)?(-?\d+)?", part)
        name, power = (found[1], int(found[2] or 1)) if found and part != "1" else (part, 1)
        factor *= _one(name, text) ** (sign * power)
    return factor


def _one(name: str, whole: str) -> float:
    if name in _PLAIN:
        return _PLAIN[name]
    for own, size in _UNITS.items():
        if name.endswith(own) and name.removesuffix(own) in _PREFIXES:
            return _PREFIXES[name.removesuffix(own)] * size
    prefixes, plain = (", ".join(filter(None, names)) for names in (_PREFIXES, _PLAIN))
    known = f"{', '.join(_UNITS)} with a prefix ({prefixes}), {plain}, and products and quotients of them"
    raise checks.refuse("unit", whole, f"known are {known}")


@dataclass(frozen=True, eq=False)
class Curve:
    """A measured curve in SI units; NaN where a value is missing.

    Attributes:
        x: abscissae (n,), all finite.
        y: values (n,).
        sigma: standard deviations (n,), or None if the file has none.
        columns: names of the columns for x, y (and sigma).
    """

    x: np.ndarray
    y: np.ndarray
    sigma: np.ndarray | None
    columns: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.x)

    def at(self, x: Any) -> np.ndarray:
        """Values at other abscissae, linear between the measured ones; NaN beyond them. The abscissae must
        rise.

        Raises:
            InputError: they don't.
        """
        there = np.isfinite(self.y)
        if not (np.diff(self.x[there]) > 0).all():
            raise InputError("curve: its abscissae have to rise for values in between")
        found: np.ndarray = np.interp(
            checks.numeric("x", x), self.x[there], self.y[there], left=np.nan, right=np.nan
        )
        return found


def read_curve(
    path: str | os.PathLike[str],
    x: str | tuple[str, str],
    y: str | tuple[str, str],
    *,
    sigma: str | tuple[str, str] | None = None,
    delimiter: str | None = None,
    decimal: str = ".",
) -> Curve:
    """Read a curve from a table in a text file, such as CSV.

    The first line that isn't empty or a comment (#) has the names of the columns. A unit is stated in the
    header, "torque (mN m)" or "torque [mN m]", or by the script, `y=("torque", "mN m")`; a column without
    any is refused, "-" stands for numbers without unit. Missing values (empty, "nan", "NA", "-") are NaN;
    rows without abscissa are left out.

    Args:
        x, y, sigma: names of columns (without the unit), or name and unit.
        delimiter: between columns; None: a semicolon, tab or comma, whatever the header has.
        decimal: "." or ",".

    Returns:
        The curve in SI units. All ranks may read it.

    Raises:
        InputError: a file that can't be read, a column or unit that isn't there, an entry that is no number.
    """
    wanted = [("x", x), ("y", y), *([("sigma", sigma)] if sigma is not None else [])]
    columns, arrays = _table(path, wanted, delimiter, decimal)
    there = np.isfinite(arrays[0])
    if not there.any():
        raise InputError(f"path = {os.fspath(path)!r}: column {columns[0]!r} has no numbers")
    kept = [a[there] for a in arrays]
    return Curve(kept[0], kept[1], kept[2] if sigma is not None else None, columns)


@dataclass(frozen=True, eq=False)
class MeasuredField:
    """A field that was measured at places, in SI units; NaN where a value is missing.

    Attributes:
        X: places (n, d), for `Places`.
        values: (n, k), such as displacements.
        columns: names of the columns, of places and values.
    """

    X: np.ndarray
    values: np.ndarray
    columns: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.X)


def read_field(
    path: str | os.PathLike[str],
    places: Sequence[str | tuple[str, str]],
    values: Sequence[str | tuple[str, str]],
    *,
    delimiter: str | None = None,
    decimal: str = ".",
) -> MeasuredField:
    """Read a field from a table in a text file, such as digital image correlation writes: a row a place.

    Args:
        places: columns of the coordinates in the undeformed body, ("x", "y") or with their units.
        values: columns of what was measured there, ("u", "v") or with their units.
        path, delimiter, decimal: see `read_curve`, also for units and missing values.

    Returns:
        The field in SI units; rows without a place are left out.

    Raises:
        InputError: as of `read_curve`.
    """
    for name, specs in (("places", places), ("values", values)):
        if isinstance(specs, str) or not checks.several(specs) or not len(specs):
            raise checks.refuse(name, specs, 'names of columns, ("x", "y"), or names and units')
    wanted = [(f"places[{k}]", spec) for k, spec in enumerate(places)]
    wanted += [(f"values[{k}]", spec) for k, spec in enumerate(values)]
    columns, arrays = _table(path, wanted, delimiter, decimal)
    table, d = np.stack(arrays, axis=1), len(places)
    table = table[np.isfinite(table[:, :d]).all(axis=1)]
    if not len(table):
        raise InputError(f"path = {os.fspath(path)!r}: no row has a place")
    return MeasuredField(table[:, :d], table[:, d:], columns)


def _table(
    path: Any, wanted: Sequence[tuple[str, Any]], delimiter: Any, decimal: Any
) -> tuple[tuple[str, ...], list[np.ndarray]]:
    """Names and numbers (SI) of columns, which are wanted by arguments' names."""
    file = checks.path("path", path)
    checks.choice("decimal", decimal, (".", ","))
    try:
        lines = [line for line in file.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(f"path = {str(file)!r} can't be read: {e}") from None
    lines = [line for line in lines if not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(f"path = {str(file)!r}: there is no table in it")
    if delimiter is None:
        delimiter = next((d for d in (";", "\t", ",") if d in lines[0]), ",")
    checks.text("delimiter", delimiter)
    if len(delimiter) != 1 or delimiter == decimal:
        raise checks.refuse("delimiter", delimiter, f"one character other than {decimal!r} is needed")
    header, *rows = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    _check_widths(file, header, rows, delimiter)
    columns, arrays = [], []
    for name, spec in wanted:
        k, factor = _column(name, spec, header, delimiter)
        columns.append(header[k].strip())
        numbers = [_number(file, i, row, k, decimal) for i, row in enumerate(rows)]
        arrays.append(factor * np.array(numbers, dtype=float))
    return tuple(columns), arrays


def _check_widths(file: Any, header: Sequence[str], rows: Sequence[Sequence[str]], delimiter: str) -> None:
    """Raise InputError where a row has more entries than the header has names."""
    for i, row in enumerate(rows):
        if any(entry.strip() for entry in row[len(header) :]):
            raise InputError(
                f"path = {str(file)!r}: row {i + 1} of the table has {len(row)} entries, its header "
                f"{len(header)}, with {delimiter!r} between them; decimal commas need another delimiter "
                "between columns, such as ';', and decimal=','"
            )


def _column(argument: str, spec: Any, header: Sequence[str], delimiter: str) -> tuple[int, float]:
    """Number of a column, and the size of its unit."""
    if isinstance(spec, str):
        name, stated = spec, None
    else:
        name, stated = checks.sequence(argument, spec, 2, "texts, name and unit,")
        checks.instance(f"{argument}: the unit", stated, str, "a text is")
    name = checks.text(argument, name).strip()
    parts = [re.fullmatch(r"(.*?)\s*(?:\(([^()]*)\)|\[([^]]*)\])?", column.strip()) for column in header]
    found = [k for k, p in enumerate(parts) if p is not None and name in (p[1], header[k].strip())]
    if len(found) != 1:
        known = ", ".join(repr(column.strip()) for column in header)
        what = f"one of the columns {known}" if not found else f"one column only: {known}"
        raise checks.refuse(argument, name, f"{what} (the delimiter is {delimiter!r})")
    part = parts[found[0]]
    assert part is not None
    own = part[2] if part[2] is not None else part[3]
    if stated is None and own is None:
        raise InputError(f'{argument} = {name!r}: its unit isn\'t stated; {argument}=({name!r}, "mm"), say')
    if stated is not None and own is not None and not np.isclose(unit(stated), unit(own), rtol=1e-12):
        raise InputError(f"{argument} = {name!r}: its unit is {stated!r}, but the file says {own!r}")
    return found[0], unit(stated if stated is not None else own)


def _plain(text: str, decimal: str) -> str:
    """A number as Python reads it; one with the other decimal sign, or digits in groups, isn't read."""
    if decimal == ".":
        return text
    return "no number" if "." in text else text.replace(decimal, ".")


def _number(file: Any, line: int, row: Sequence[str], k: int, decimal: str) -> float:
    text = row[k].strip() if k < len(row) else ""
    if text.lower() in _MISSING:
        return np.nan
    try:
        value = float(_plain(text, decimal))
    except ValueError:
        other = "," if decimal == "." else "."
        why = f" with decimal={decimal!r}"
        if re.fullmatch(rf"[+-]?\d*\{other}\d*([eE][+-]?\d+)?", text):
            why += f"; it is one with decimal={other!r}"
        raise InputError(
            f"path = {str(file)!r}: {text!r} in row {line + 1} of the table is no number{why}"
        ) from None
    return value if np.isfinite(value) else np.nan

"""A signal over time in a file, CSV or Parquet: columns by name, with the unit at the end.

``time_s``, which rises, and one of ``speed_rpm``, ``speed_rad_s``, ``position_rad`` and ``torque_nm``. Other
columns are left alone.
"""

from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.loop.scenario import Quantity

TIME: Final = "time_s"
COLUMNS: Final = {
    "speed_rpm": (Quantity.SPEED, RAD_S_PER_RPM),
    "speed_rad_s": (Quantity.SPEED, 1.0),
    "position_rad": (Quantity.POSITION, 1.0),
    "torque_nm": (Quantity.TORQUE, 1.0),
}
"""Quantity of each, and its unit in SI."""
ROWS_MAX: Final = 20_000_000
"""Five hours and a half at 1 kHz: 320 MB while it runs."""


@dataclass(frozen=True, slots=True)
class Signal:
    """The contents of a file, in SI units."""

    quantity: Quantity
    times_s: bytes
    """(n,), doubles, little-endian: as the loop looks them up
    (:class:`servobench.hil.loop.scenario.Table`)."""
    levels: bytes
    """(n,), likewise."""
    points: int
    last_s: float
    least: float
    peak: float
    """Largest magnitude."""
    rate: float
    """Largest change per second between two points."""


def load_signal(path: Path) -> Signal:
    """Load the signal in a file. Raises BadInput, naming file, column and value."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BadInput(str(path), "file", error.strerror or str(error), "a file that is there") from None
    key = path, blake2b(content, digest_size=16).digest()
    if key not in _parsed:
        while len(_parsed) >= _PARSED_MAX:
            del _parsed[next(iter(_parsed))]
        _parsed[key] = _load(path, content)
    return _parsed[key]


_PARSED_MAX: Final = 8
"""A bench names one or two; sixteen bytes per row stay in memory."""
_parsed: dict[tuple[Path, bytes], Signal] = {}
"""Signals by content: two edits within a tick of the file system's clock leave the same time."""


def _load(path: Path, content: bytes) -> Signal:
    table = _read(path, content)
    names = [name for name in COLUMNS if name in table.column_names]
    if TIME not in table.column_names or len(names) != 1:
        expected = f"{TIME} and one of {', '.join(COLUMNS)}"
        raise BadInput(str(path), "columns", ", ".join(table.column_names), expected)
    if not 1 <= table.num_rows <= ROWS_MAX:
        raise BadInput(str(path), "rows", table.num_rows, f"1 to {ROWS_MAX}")
    times = _numbers(table, TIME, path)
    quantity, unit = COLUMNS[names[0]]
    levels = _numbers(table, names[0], path) * unit
    falls = np.flatnonzero(np.diff(times) <= 0.0)
    if falls.size:
        place = int(falls[0]) + 1
        expected = f"more than the row before it, {times[place - 1]:g}"
        raise BadInput(str(path), f"{TIME}[{place}]", float(times[place]), expected)
    rates = np.abs(np.diff(levels)) / np.diff(times)
    return Signal(
        quantity,
        times.astype("<f8").tobytes(),
        levels.astype("<f8").tobytes(),
        points=len(times),
        last_s=float(times[-1]),
        least=float(levels.min()),
        peak=float(np.abs(levels).max()),
        rate=float(rates.max(initial=0.0)),
    )


def _read(path: Path, content: bytes) -> Any:
    import pyarrow as pa
    from pyarrow import csv, parquet

    if path.suffix not in (".csv", ".parquet"):
        raise BadInput(str(path), "path", path.suffix, "a file named .csv or .parquet")
    try:
        file = pa.BufferReader(content)
        return csv.read_csv(file) if path.suffix == ".csv" else parquet.read_table(file)
    except (OSError, pa.ArrowException) as error:
        kind = "CSV with a line of column names" if path.suffix == ".csv" else "Parquet"
        raise BadInput(str(path), "file", str(error).splitlines()[0], kind) from None


def _numbers(table: Any, name: str, path: Path) -> NDArray[np.float64]:
    try:
        numbers: NDArray[np.float64] = np.array(table[name].cast("float64").to_numpy(), np.float64)
    except ValueError as error:  # which pyarrow's own are derived from
        raise BadInput(str(path), name, str(error).splitlines()[0], "numbers") from None
    wrong = np.flatnonzero(~np.isfinite(numbers))
    if wrong.size:
        place = int(wrong[0])
        raise BadInput(str(path), f"{name}[{place}]", float(numbers[place]), "a finite number in every row")
    return numbers

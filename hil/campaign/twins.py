"""Members of a twin: motors drawn from what a fit of recordings has found, with its covariance.

Only keys of the motor file are drawn, at the covariance that they have whatever the others are; the dead time
and the filter of the speed belong to the drive.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.motor_file import load_motor

_OF_DRIVE: Final = "twin."
"""Keys of the table [twin], which no motor has."""
_FRICTION: Final = "_friction_"


class TwinMembers:
    """The motors of a twin's file."""

    def __init__(self, path: Path, named_by: NamedBy) -> None:
        """Read the file. Raises BadInput for one that is no twin's, or in which nothing was fitted."""
        motor = load_motor(path, named_by)
        fitted = [] if motor.twin is None else [key for key in motor.twin.key if key.source == "fitted"]
        places = [place for place, key in enumerate(fitted) if not key.name.startswith(_OF_DRIVE)]
        if motor.twin is None or not places:
            raise BadInput(str(path), "twin.key", "none", "a twin of hil fit with keys of the motor fitted")
        self.names: Final = tuple(fitted[place].name for place in places)
        self._tables = {name: table for name, table in motor.tables.items() if name != "twin"}
        self._mean = np.array([fitted[place].value for place in places])
        covariance = np.array(motor.twin.covariance)[np.ix_(places, places)]
        scale = np.sqrt(np.diag(covariance))
        roundings = 1e-6 * np.eye(len(places))  # of the file's six digits
        self._factor = np.linalg.cholesky(covariance / np.outer(scale, scale) + roundings) * scale[:, None]

    def member(self, normal: Sequence[float]) -> tuple[dict[str, Any], dict[str, float]]:
        """Return a motor's tables and its drawn values by key; ``normal``: (keys,), standard normal."""
        values = self._mean + self._factor @ np.asarray(normal)
        drawn = {
            name: max(value, 0.0) if _FRICTION in name else value
            for name, value in zip(self.names, values.tolist(), strict=True)
        }
        tables = {
            name: dict(table) if isinstance(table, dict) else table for name, table in self._tables.items()
        }
        for name, value in drawn.items():
            table, _, key = name.partition(".")
            tables.setdefault(table, {})[key] = value
        return tables, drawn

"""The largest of what was seen, and where it was seen."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray


class Largest:
    """The largest value so far, and when it was first so large."""

    def __init__(self) -> None:
        self.value: float | None = None
        self.at: int | None = None
        """None: there was no value yet."""

    def look(self, times: NDArray[np.int64], values: NDArray[np.float64 | np.int64]) -> None:
        """Take in instants, (n,) ns, and values, (n,)."""
        if values.size:
            place = int(values.argmax())
            self.note(int(times[place]), float(values[place]))

    def note(self, at: int, value: float) -> None:
        """Take in one value."""
        if self.value is None or value > self.value:
            self.value, self.at = value, at


def largest(values: Iterable[float | None]) -> float | None:
    """Return the largest of the measured values; None if none was measured."""
    return max((value for value in values if value is not None), default=None)

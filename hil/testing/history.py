"""One axis of a recorded run, cycle by cycle, for the assertions."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.cia402.profile import State, state_of
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NS_PER_S, NS_PER_US
from servobench.hil.loop.cycle_record import CAUSES, FATE_SAMPLE, NOTHING
from servobench.hil.reviewing.network_meter import LossRuns
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.arguments import checked

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Stretch(NamedTuple):
    """Cycles of unchanged reference and load, after a change of one of them."""

    first: int
    end: int
    """One beyond the last cycle."""
    at_s: float
    """When the change was complete."""
    what: str
    """The change in words."""


class AxisHistory:
    """Columns of (n,) values, one for each cycle; velocity and error are NaN where no reading was used."""

    def __init__(self, name: str, rows: Rows, channels: Callable[[], Sequence[str]] = tuple) -> None:
        """``rows``: (n,) of ROW_DTYPE in run time, of this axis, in order of sequence; ``channels``: names of
        the controller's own channels."""
        self.name = name
        self.time_s: Floats = rows["due_at"] / NS_PER_S
        self.reference_rad_s: Floats = rows["reference_rad_s"]
        self.load_nm: Floats = rows["load_torque_nm"]
        self.torque_nm: Floats = rows["command_torque_nm"]
        self.commanded: Flags = rows["command_handed_at"] != NOTHING
        self.sampled: Flags = rows["fate"] == FATE_SAMPLE
        self.velocity_rad_s: Floats = np.where(self.sampled, rows["velocity_rad_s"], np.nan)
        self.error_rad_s: Floats = self.reference_rad_s - self.velocity_rad_s
        self.statusword: NDArray[np.int64] = rows["statusword"]
        self.compute_us: Floats = np.where(
            rows["compute_ns"] == NOTHING, np.nan, rows["compute_ns"] / NS_PER_US
        )
        """Computing time of compensator and controller."""
        self._fate = rows["fate"]
        self._rows = rows
        self._channels = channels

    def channel(self, name: str) -> Floats:
        """Return the controller's values under this name, (n,). Raises ValueError: it has no such channel."""
        names = self._channels()
        if name not in names:
            raise ValueError(f"channel {name!r}: {self.name} has {', '.join(names) or 'none'}")
        values: Floats = self._rows[f"channel_{list(names).index(name)}"]
        return values

    @property
    def scale_rad_s(self) -> float:
        """The largest |reference|: 100 % of speed percentages, as in the summary of a run."""
        return float(np.abs(self.reference_rad_s).max(initial=0.0))

    @checked
    def window(self, from_s: float, until_s: float) -> Flags:
        """Return the cycles with a usable reading in [from_s, until_s)."""
        inside: Flags = self.sampled & (self.time_s >= from_s) & (self.time_s < until_s)
        return inside

    def stretches(self) -> list[Stretch]:
        """Split the run at its changes of reference and load. Both start from 0."""
        reference = np.diff(self.reference_rad_s, prepend=0.0)
        load = np.diff(self.load_nm, prepend=0.0)
        changed = np.flatnonzero((reference != 0.0) | (load != 0.0))
        ends = [*changed[1:], self.time_s.size]
        return [
            Stretch(int(first), int(end), float(self.time_s[first]), self._change(int(first), reference))
            for first, end in zip(changed, ends, strict=True)
            if end > first + 1
        ]

    def readings_lost(self) -> LossRuns:
        """Return consecutive losses of readings; ``at`` is in run time."""
        losses = LossRuns()
        losses.add(~self.sampled, self._rows["due_at"])
        return losses

    def dropouts(self) -> dict[str, int]:
        """Count the dropped cycles, by cause."""
        return {cause.value: int((self._fate == place).sum()) for place, cause in enumerate(CAUSES, start=1)}

    def states(self) -> list[tuple[float, State | None]]:
        """Return when the drive's statusword began to show another state, and which."""
        changes: list[tuple[float, State | None]] = []
        for place in np.flatnonzero(self.sampled):
            word = int(self.statusword[place])
            state = None if word == NOTHING else state_of(word)
            if not changes or changes[-1][1] is not state:
                changes.append((float(self.time_s[place]), state))
        return changes

    def _change(self, place: int, reference: Floats) -> str:
        if reference[place]:
            rpm = self.reference_rad_s[place] * RPM_PER_RAD_S
            return f"the reference of {self.reference_rad_s[place]:.4g} rad/s ({rpm:.4g} r/min)"
        return f"the load of {self.load_nm[place]:.4g} N m"

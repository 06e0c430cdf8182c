"""Rows of an axis out of a log, in the form of a recording's."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import STATE_BITS, State, state_of
from servobench.hil.loop.cycle_record import CAUSES, COLUMNS, FATE_SAMPLE, NOTHING
from servobench.hil.loop.samples import DropoutCause
from servobench.hil.reviewing.log_content import ObjectValues
from servobench.hil.reviewing.log_cycles import CyclicPdo, SyncGrid, held_values, within_cycle
from servobench.hil.rows.records import ROW_DTYPE, Rows

_LOST, _LATE, _MISSED = (
    1 + CAUSES.index(cause) for cause in (DropoutCause.LOST, DropoutCause.LATE, DropoutCause.MISSED)
)
_ENABLED: Final = [word for word in range(STATE_BITS + 1) if state_of(word) is State.OPERATION_ENABLED]
_READ: Final = (
    ("velocity_rad_s", "received_at", Object.VELOCITY_ACTUAL_VALUE),
    ("position_rad", "position_told_at", Object.POSITION_ACTUAL_VALUE),
    ("torque_nm", "torque_told_at", Object.TORQUE_ACTUAL_VALUE),
)
_COMMANDS: Final = {
    "cst": ("command_torque_nm", Object.TARGET_TORQUE),
    "csv": ("command_speed_rad_s", Object.TARGET_VELOCITY),
    "vl": ("command_speed_rad_s", Object.VL_TARGET_VELOCITY),
    "csp": ("command_position_rad", Object.TARGET_POSITION),
    "ip": ("command_position_rad", Object.TARGET_POSITION),
}


@dataclass(frozen=True, slots=True)
class AxisCycles:
    """What a log tells of the cycles of an axis."""

    grid: SyncGrid
    reading: CyclicPdo
    command: CyclicPdo | None
    objects: Mapping[tuple[int, int], ObjectValues]
    zero_ns: int
    """From where the rows' times count."""

    def rows(self, axis: int, mode: str, deadline_ns: int) -> Rows:
        """Return (n,) of ROW_DTYPE: the cycles in which a reading was to come and those without SYNC between,
        while the drive was enabled; all of them if it never was, or if nobody told.

        What a drive in csv, csp, ip or vl is given stands for the reference: nobody knows what the host
        wanted.
        """
        chosen, grid, reading = self._chosen(), self.grid, self.reading
        rows = np.empty(int(np.count_nonzero(chosen)), ROW_DTYPE)
        for column in COLUMNS:
            rows[column.name] = np.nan if column.is_real else NOTHING
        at, there, delay = grid.at[chosen] - self.zero_ns, grid.there[chosen], reading.delay_ns[chosen]
        late = (delay > deadline_ns) | reading.late[chosen]
        sample = there & (delay >= 0) & ~late
        fate = np.where(sample, FATE_SAMPLE, np.where(delay < 0, _LOST, _LATE))
        rows["sequence"] = np.arange(1, rows.size + 1)
        rows["axis"], rows["due_at"] = axis, at
        rows["fate"] = np.where(there, fate, _MISSED)
        rows["certain"] = ~reading.uncertain[chosen]
        rows["sync_handed_at"] = rows["sync_on_bus_at"] = np.where(there, at, NOTHING)
        rows["delay_ns"] = np.where(there & (delay >= 0), delay, NOTHING)
        rows["sampled_at"] = np.where(sample, at, NOTHING)
        rows["sampled_at_error_ns"] = np.where(sample, 0, NOTHING)
        for name, told, index in _READ:
            rows[name] = np.where(sample, self._in_cycles(index)[chosen], np.nan)
            rows[told] = np.where(sample, reading.received_at[chosen] - self.zero_ns, NOTHING)
        self._add_commands(rows, mode, chosen)
        return rows

    def _chosen(self) -> NDArray[np.bool_]:
        """(m,) Of the grid."""
        chosen = self.reading.expected.copy()
        within = np.flatnonzero(chosen)
        if within.size:
            chosen[within[0] : within[-1]] |= ~self.grid.there[within[0] : within[-1]]
        words = self.objects.get((Object.STATUSWORD, 0))
        if words is not None and words.at.size:
            held = np.nan_to_num(held_values(words.at, words.raw, self.grid)).astype(np.int64)
            enabled = np.isin(held & STATE_BITS, _ENABLED)
            if np.any(chosen & enabled):
                chosen &= enabled
        with_sync = np.flatnonzero(chosen & self.grid.there)
        if with_sync.size:  # while a drive is being enabled its host may send SYNCs as it likes
            chosen[: with_sync[0]] = chosen[with_sync[-1] + 1 :] = False
        return chosen

    def _add_commands(self, rows: Rows, mode: str, chosen: NDArray[np.bool_]) -> None:
        name, index = _COMMANDS[mode]
        sent = self._in_cycles(index)
        rows[name] = sent[chosen]
        acting = np.concatenate(([np.nan], sent[:-1]))[chosen]
        if mode in ("csv", "vl"):
            rows["reference_rad_s"] = acting
        elif mode != "cst":
            rows["reference_position_rad"], rows["reference_rad_s"] = acting, 0.0
        if self.command is not None:
            handed = self.command.received_at[chosen]
            for instant in ("command_handed_at", "command_on_bus_at", "command_effective_at"):
                rows[instant] = np.where(handed >= 0, handed - self.zero_ns, NOTHING)
            rows["command_fate"] = np.where(handed >= 0, 0, NOTHING)

    def _in_cycles(self, index: int) -> NDArray[np.float64]:
        values, grid = self.objects.get((index, 0)), self.grid
        return np.full(grid.at.size, np.nan) if values is None else within_cycle(values.at, values.si, grid)

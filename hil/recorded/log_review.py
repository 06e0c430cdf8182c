"""A log of another program reviewed by a bench file: cycles, delays, losses, states and EMCYs of drives.

Nobody recorded what the host meant, so a log is judged by what passed on the bus alone, and never *passes*:
of the bench's limits those on dropouts, delays and missed SYNCs are held against it, the others are named.

Rows of an axis out of a log, in the form of a recording's.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import STATE_BITS, State, state_of
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.recorded_bench import review_plan
from servobench.hil.loop.cycle_record import CAUSES, COLUMNS, FATE_SAMPLE, NOTHING
from servobench.hil.loop.samples import DropoutCause
from servobench.hil.recorded.log_axis import AxisReview, axis_review
from servobench.hil.recorded.recorded_run import RunSignals
from servobench.hil.reviewing.log_content import (
    CyclicPdo,
    LogContent,
    ObjectValues,
    SyncGrid,
    held_values,
    sync_grid,
    within_cycle,
)
from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.reviewing.trace.node_objects import KnownNodes, NodeKey, SheetFile
from servobench.hil.rows.records import ROW_DTYPE, Rows
from servobench.hil.verdict.metrics import LIMITED, Beside, VerdictLimits
from servobench.hil.verdict.verdict import Check, ExitStatus, LimitResult

JUDGED: Final = ("dropouts_percent_max", "delay_p99_us_max", "missed_percent_max", "losses_in_a_row_max")
"""Limits that a log can be held against."""
_FAULTY: Final = frozenset({State.FAULT, State.FAULT_REACTION})
_SHOWN_MAX: Final = 50
"""Findings of one kind and axis that are listed one by one."""


@dataclass(frozen=True, slots=True)
class LogReview:
    """Result of a review."""

    path: Path
    config: BenchConfig
    content: LogContent
    grids: Mapping[str, SyncGrid]
    """By interface; those with SYNCs."""
    axes: tuple[AxisReview, ...]
    signals: RunSignals
    checks: tuple[Check, ...]
    findings: tuple[tuple[ExitStatus, str], ...]
    """The gravest first."""
    unjudged: tuple[str, ...]
    """Limits of the bench that a log does not tell."""
    notes: tuple[str, ...]

    @property
    def exit_status(self) -> ExitStatus:
        return self.findings[0][0] if self.findings else ExitStatus.PASSED

    @property
    def verdict(self) -> str:
        """In words; a log never passes."""
        words = {
            ExitStatus.PEER_FAULT: "bus, drive or safety",
            ExitStatus.INCOMPLETE: "not measured",
            ExitStatus.FAILED: "limits broken",
        }
        return words.get(self.exit_status, "limits kept" if self.checks else "nothing was asked")

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        figures = self.signals.review.figures()
        return {
            "log": str(self.path),
            "bench": self.config.bench.name,
            "verdict": {
                "outcome": self.verdict,
                "exit_status": int(self.exit_status),
                "limits": [asdict(check) | {"result": check.result.value} for check in self.checks],
                "findings": [text for _, text in self.findings],
                "not_told_by_a_log": list(self.unjudged),
            },
            "frames": self.content.frames,
            "duration_s": (self.content.end_ns - self.content.begin_ns) / NS_PER_S,
            "sync": {name: self._sync(name, grid) for name, grid in self.grids.items()},
            "axes": {axis.name: axis.as_json() for axis in self.axes},
            "dropouts": asdict(figures.dropouts),
            "cycles": figures.cycles,
            "notes": list(self.notes),
        }

    def _sync(self, name: str, grid: SyncGrid) -> dict[str, Any]:
        begin = self.content.begin_ns
        silences = self.content.buses[name].silences
        return {
            "syncs": int(np.count_nonzero(grid.there)),
            "period_us": grid.period_ns / NS_PER_US,
            "bench_period_us": self.config.loop.period_us,
            "jitter_us": grid.jitter_ns / NS_PER_US,
            "missed": grid.missed,
            "silences_s": [[(a - begin) / NS_PER_S, (b - begin) / NS_PER_S] for a, b in silences],
        }


def review_log(path: Path, config: BenchConfig) -> LogReview:
    """Review a log by the drives, units and limits of a bench.

    Raises BadInput for a file that holds no frame, no times, or no SYNC.
    """
    log = BusLog(path)
    content = LogContent(log, _known(config))
    _refuse(path, log, content)
    grids = {
        name: sync_grid(bus.syncs, bus.silences, config.loop.period, content.end_ns)
        for name, bus in content.buses.items()
        if bus.syncs.size > 1
    }
    if not grids:
        raise BadInput(str(path), "", "fewer than two SYNCs (80h)", "a log of drives that are run by SYNC")
    axes = tuple(axis_review(name, config.drive[name], content, grids) for name in sorted(config.drive))
    signals = _signals(config, content, grids, axes)
    checks = tuple(_checks(config.verdict.limits, signals))
    findings = sorted([*_findings(axes, config), *_broken(checks)], key=lambda each: _GRAVITY.index(each[0]))
    unjudged = [key for key, limit in asdict(config.verdict.limits).items() if limit is not None]
    return LogReview(
        path, config, content, grids, axes, signals, checks, tuple(findings),
        tuple(key for key in unjudged if key not in JUDGED),
        (*log.notes(), *_notes(config, content, grids, axes)),
    )  # fmt: skip


_GRAVITY: Final = (ExitStatus.PEER_FAULT, ExitStatus.INCOMPLETE, ExitStatus.FAILED)


def _refuse(path: Path, log: BusLog, content: LogContent) -> None:
    from servobench.hil.reviewing.trace.bus_log import KINDS

    if not content.frames:
        raise BadInput(str(path), "", log.first_malformed or log.damage or "no frame", KINDS)
    if content.timeless:
        raise BadInput(str(path), "", f"{content.timeless} frames without times", "a log with times")


def _known(config: BenchConfig) -> KnownNodes:
    """Data sheets and scales of the bench's drives; the log's interfaces have names of their own."""
    several = len({drive.segment for drive in config.drive.values()}) > 1
    overrides: dict[NodeKey, Any] = {}
    sheets = []
    for drive in config.drive.values():
        channel = (drive.segment or "") if several else ""
        if drive.commissioned is not None:
            overrides[channel, drive.node] = drive.commissioned.override
        if drive.eds is not None:
            sheets.append(SheetFile(Path(drive.eds), drive.node, channel))
    return KnownNodes(sheets, overrides)


def _signals(
    config: BenchConfig, content: LogContent, grids: Mapping[str, SyncGrid], axes: Sequence[AxisReview]
) -> RunSignals:
    """Rows as a recording has them, as far as a log tells; times count from its first frame."""
    plan = review_plan(config, {}, real_time=True)
    quantities = {"cst": "torque", "csv": "speed", "vl": "speed", "csp": "position", "ip": "position"}
    planned = tuple(replace(axis, quantity=quantities[axis.mode]) for axis in plan.axes)
    deadline = config.loop.deadline
    signals = RunSignals(replace(plan, axes=planned, limits=VerdictLimits()), deadline)
    for number, axis in enumerate(axes):
        if axis.reading is not None:
            grid = grids.get(axis.channel) or next(iter(grids.values()))
            command = None if axis.command is None else axis.command.cyclic
            cycles = AxisCycles(grid, axis.reading.cyclic, command, axis.objects, content.begin_ns)
            signals.add(cycles.rows(number, config.drive[axis.name].mode, deadline))
    return signals


def _checks(limits: VerdictLimits, signals: RunSignals) -> Iterator[Check]:
    figures = signals.review.figures()
    for key, limit in asdict(limits).items():
        if limit is None or key not in JUDGED:
            continue
        value, place = LIMITED[key].value(figures, Beside(figures.rows)), figures.worst.get(key)
        result = LimitResult.NOT_MEASURED if value is None else LimitResult.KEPT
        result = LimitResult.BROKEN if value is not None and value > limit else result
        yield Check(key, value, limit, result, "" if place is None else place.axis)


def _broken(checks: Sequence[Check]) -> Iterator[tuple[ExitStatus, str]]:
    for check in checks:
        if check.result is LimitResult.BROKEN:
            yield ExitStatus.FAILED, f"{check.metric} = {check.limit:g}, found {check.value:.4g}"
        elif check.result is LimitResult.NOT_MEASURED:
            yield ExitStatus.INCOMPLETE, f"{check.metric} = {check.limit:g}, and nothing was measured"


def _findings(axes: Sequence[AxisReview], config: BenchConfig) -> Iterator[tuple[ExitStatus, str]]:
    for axis in axes:
        timeout_s = config.drive[axis.name].heartbeat_timeout_ms * NS_PER_MS / NS_PER_S
        texts = [
            f"EMCY {text} at {at:.6f} s"
            for at, text in axis.emergencies
            if not text.startswith("error reset")
        ]
        texts += [
            f"{state} at {at:.6f} s"
            for at, state in axis.states
            if any(state == bad.value for bad in _FAULTY)
        ]
        if axis.heartbeat_gap_s is not None and axis.heartbeat_gap_s > timeout_s:
            texts.append(f"no heartbeat for {axis.heartbeat_gap_s:.3f} s, more than {timeout_s:g} s")
        for text in texts[:_SHOWN_MAX]:
            yield ExitStatus.PEER_FAULT, f"{axis.name}: {text}"
        if len(texts) > _SHOWN_MAX:
            yield ExitStatus.PEER_FAULT, f"{axis.name}: {len(texts) - _SHOWN_MAX} more"
        if axis.reading is None:
            found = ", ".join(pdo.frames.name for pdo in axis.pdos) or "no PDO"
            yield (
                ExitStatus.INCOMPLETE,
                f"{axis.name}: no TPDO of node {axis.node} comes with the SYNCs ({found})",
            )


def _notes(
    config: BenchConfig, content: LogContent, grids: Mapping[str, SyncGrid], axes: Sequence[AxisReview]
) -> Iterator[str]:
    for name, grid in grids.items():
        bench_ns = config.loop.period
        if abs(grid.period_ns - bench_ns) * 20 >= bench_ns:
            yield (
                f"SYNCs{f' of {name}' if name else ''} come every {grid.period_ns / NS_PER_US:.1f} us; "
                f"the bench has loop.period_us = {config.loop.period_us}"
            )
        for begin, end in content.buses[name].silences:
            at_s = (begin - content.begin_ns) / NS_PER_S
            yield f"nothing was recorded for {(end - begin) / NS_PER_S:.3f} s from {at_s:.6f} s on"
    for axis in axes:
        for pdo in axis.pdos:
            if not pdo.objects:
                yield (
                    f"{axis.name}: the mapping of {pdo.frames.name} is neither in the log nor in a data "
                    f"sheet; drive.{axis.name}.eds gives it"
                )
            if np.count_nonzero(pdo.cyclic.uncertain):
                count = np.count_nonzero(pdo.cyclic.uncertain)
                yield f"{axis.name}: {count} {pdo.frames.name} may answer the next SYNC: they fill the period"


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

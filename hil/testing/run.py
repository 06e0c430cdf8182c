"""A finished run of a bench, and assertions about it.

Every claim raises AssertionError with the figures that it rests on. An assertion about a run that was cut
short fails.
"""

import json
import warnings
from collections.abc import Callable
from functools import cached_property, wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.recording.run_metadata import read_summary
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.rows.events import event_json, read_events
from servobench.hil.rows.records import Rows
from servobench.hil.rows.records_file import read_table, rows_of_table
from servobench.hil.rows.run_files import EVENTS_FILE, RECORDS_FILE
from servobench.hil.rows.seal import SEALED, check_seal
from servobench.hil.rows.side_rows import BeginEvent, StateEvent, TextEvent
from servobench.hil.testing.history import AxisHistory, Stretch
from servobench.hil.testing.wire import Intended, Wire, intended_frames, pdo_plans, read_wire
from servobench.hil.verdict.arguments import checked
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import RunVerdict, VerdictKind

__tracebackhide__ = True
"""Hides this file from pytest's tracebacks: a failed assertion is shown where the test makes it."""
P = ParamSpec("P")
R = TypeVar("R")


def _claim(method: Callable[Concatenate["Run", P], R]) -> Callable[Concatenate["Run", P], R]:
    """Wrap an assertion so that a failure names the recording."""
    checking = checked(method)

    @wraps(method)
    def told(run: "Run", /, *given: P.args, **named: P.kwargs) -> R:
        try:
            return checking(run, *given, **named)
        except AssertionError as error:
            place = run.place
            raise AssertionError(str(error).removesuffix(place) + place) from None

    return told


class Run:
    """One run, from its recording or from the memory of this process."""

    def __init__(
        self,
        config: BenchConfig,
        kept: Path | MemoryRecorder,
        error: BenchError | None = None,
        summary: Summary | None = None,
    ) -> None:
        """``kept``: the folder of its recording, or the recorder that kept its rows; then with its
        ``summary``."""
        self.config = config
        self.error = error
        """The error that ended it, for a run that was meant to end so."""
        self._kept = kept
        self._summary = summary

    # ---- what there is to look at ---------------------------------------------------------------------

    @property
    def folder(self) -> Path:
        """Its recording. Raises ValueError if none was requested."""
        if isinstance(self._kept, Path):
            return self._kept
        raise ValueError("this run was not recorded; run it with record=DIR")

    @cached_property
    def _sealed(self) -> Path:
        """The folder of its recording, checked against the seal once; warns if it is not sealed, or not up to
        its end. Raises BadInput."""
        if (seal := check_seal(self.folder)) != SEALED:
            warnings.warn(f"{self.folder}: {seal}", stacklevel=2)
        return self.folder

    @property
    def place(self) -> str:
        """Place to look, for a message."""
        return f"\nrecording: {self._kept if isinstance(self._kept, Path) else 'none was asked for'}"

    @cached_property
    def summary(self) -> Summary:
        """Figures and verdict, as printed by ``hil run --json``."""
        return self._summary or read_summary(self._sealed)

    @property
    def verdict(self) -> RunVerdict:
        """Its verdict; see docs/verdict.md."""
        return self.summary.verdict

    @property
    def digest(self) -> str:
        """Digest of every field of every record; in simulated time the same for the same seed."""
        return self.summary.digest

    @cached_property
    def table(self) -> pa.Table:
        """Every planned cycle of every axis, by column: ``records.arrow``, with units and codes as metadata
        of the fields (docs/recording.md). ``table.to_pandas()``, ``polars.from_arrow(table)``."""
        if isinstance(self._kept, MemoryRecorder):
            return self._kept.table()
        return read_table(self._sealed / RECORDS_FILE)

    @cached_property
    def rows(self) -> Rows:
        """(n,) of ROW_DTYPE: the same for numpy, NaN or -2**63 for unknown values."""
        return rows_of_table(self.table)

    def column(self, name: str, axis: str | None = None) -> NDArray[Any]:
        """Return the (n,) values of a column of docs/recording.md, one for each cycle of an axis.

        Whole numbers are float64 with NaN where some are not known. Raises ValueError.
        """
        if name not in self.table.column_names:
            raise ValueError(f"column {name!r}: there are {', '.join(self.table.column_names)}")
        mine = self.table.column("axis").to_numpy() == self.config.axes.index(self._axis_name(axis))
        values: NDArray[Any] = self.table.column(name).to_numpy()[mine]
        return values

    @cached_property
    def events(self) -> list[dict[str, Any]]:
        """The entries of events.jsonl, in order of time."""
        if isinstance(self._kept, MemoryRecorder):
            events, zero = self._kept.told()
            shown = [each for each in events if isinstance(each, TextEvent | StateEvent | BeginEvent)]
            return [event_json(each, zero) for each in shown]
        return sorted(read_events(self._sealed / EVENTS_FILE), key=lambda event: event["at_ns"])

    @cached_property
    def wire(self) -> Wire:
        """Every frame that the bench sent or received, from connecting to the drives to their release."""
        if isinstance(self._kept, Path):
            return read_wire(self._sealed)
        frames = Wire()
        for frame in self._kept.frames():
            frames.take(*frame)
        return frames

    def axis(self, name: str | None = None) -> AxisHistory:
        """Return one axis, cycle by cycle; ``name`` may be omitted if there is only one."""
        name = self._axis_name(name)
        mine = self.rows[self.rows["axis"] == self.config.axes.index(name)]
        return AxisHistory(name, mine, lambda: self._channels.get(name, ()))

    @cached_property
    def _channels(self) -> dict[str, list[str]]:
        """Names of each controller's own channels, by axis."""
        channels: dict[str, list[str]] = json.loads(self.table.schema.metadata[b"channels"])
        return channels

    # ---- what may be claimed --------------------------------------------------------------------------

    @_claim
    def assert_passed(self) -> None:
        """Assert that the run passed, by every condition of docs/verdict.md: there were limits, and all were
        kept."""
        verdict = self.summary.verdict
        if verdict.outcome is VerdictKind.NOTHING_ASKED:
            raise AssertionError(f"{self.config.source or 'the bench'} has no limit in [verdict] to keep")
        if not verdict.passed:
            raise AssertionError("\n".join(f"{each.outcome}: {each.text}" for each in verdict.findings))

    @_claim
    def assert_settles(
        self,
        *,
        within_s: float,
        band_percent: float = 2.0,
        axis: str | None = None,
        after_s: float | None = None,
    ) -> list[float]:
        """Assert that after every change of reference or load the speed is in the band after ``within_s``,
        and stays.

        The band is +-``band_percent`` of the largest |reference|. ``after_s``: only the change at that time.
        A stretch between two changes that is shorter than ``within_s`` is not judged. Returns how long each
        settling took, s.
        """
        self._assert_completed()
        history = self.axis(axis)
        band_rad_s = self._scale(history) * band_percent / 100.0
        judged = [
            stretch
            for stretch in _chosen(history, after_s)
            if history.time_s[stretch.end - 1] - stretch.at_s >= within_s
        ]
        if not judged:
            raise AssertionError(f"{history.name}: no stretch of {within_s:g} s after a change to settle in")
        return [_settling_s(history, stretch, within_s, band_rad_s, band_percent) for stretch in judged]

    @_claim
    def assert_error_below(
        self,
        *,
        percent: float | None = None,
        rad_s: float | None = None,
        rms_rad_s: float | None = None,
        from_s: float = 0.0,
        until_s: float = float("inf"),
        axis: str | None = None,
    ) -> None:
        """Assert a bound of |reference - speed| in every cycle of [from_s, until_s) that has a reading.

        ``percent``: of the largest |reference|. ``rms_rad_s``: the root of its mean square instead.
        """
        if percent is None and rad_s is None and rms_rad_s is None:
            raise ValueError("give at least one of percent, rad_s and rms_rad_s")
        self._assert_completed()
        history = self.axis(axis)
        inside = history.window(from_s, until_s)
        if not inside.any():
            raise AssertionError(f"{history.name}: no reading between {from_s:g} s and {until_s:g} s")
        error, at_s = np.abs(history.error_rad_s[inside]), history.time_s[inside]
        worst = int(error.argmax())
        where = f"{error[worst]:.4g} rad/s at {at_s[worst]:.3f} s"
        if percent is not None:
            error_percent = 100.0 * float(error[worst]) / self._scale(history)
            if error_percent > percent:
                raise AssertionError(
                    f"{history.name}: speed error {error_percent:.3g} % ({where}), "
                    f"at most {percent:g} % asked for"
                )
        if rad_s is not None and error[worst] > rad_s:
            raise AssertionError(f"{history.name}: speed error {where}, at most {rad_s:g} rad/s asked for")
        rms = float(np.sqrt(np.mean(error**2)))
        if rms_rad_s is not None and rms > rms_rad_s:
            raise AssertionError(
                f"{history.name}: speed error {rms:.4g} rad/s rms (peak {where}), "
                f"at most {rms_rad_s:g} rad/s rms asked for"
            )

    @_claim
    def assert_dropouts_handled(
        self, *, at_least: int = 1, in_a_row_max: int | None = None, axis: str | None = None
    ) -> None:
        """Assert that readings were lost, late or stale, and that the loop handled it.

        That is: the run was completed, a set-point went out in every cycle, and the drive stayed in OPERATION
        ENABLED. With fewer than ``at_least`` dropouts nothing was shown, which fails too.
        """
        self._assert_completed()
        history = self.axis(axis)
        causes, lost = history.dropouts(), history.readings_lost()
        counted = ", ".join(f"{count} {cause}" for cause, count in causes.items())
        if sum(causes.values()) < at_least:
            raise AssertionError(
                f"{history.name}: {counted} in {history.time_s.size} cycles, at least {at_least} dropouts "
                "are needed to show how they are handled"
            )
        silent = history.time_s[~history.commanded]
        if silent.size:
            raise AssertionError(
                f"{history.name}: no set-point was sent in {silent.size} of {history.time_s.size} cycles, "
                f"first at {silent[0]:.3f} s ({counted})"
            )
        if in_a_row_max is not None and lost.at is not None and lost.most > in_a_row_max:
            raise AssertionError(
                f"{history.name}: {lost.most} readings lost in a row, the last at {lost.at / NS_PER_S:.3f} "
                f"s, at most {in_a_row_max} asked for ({counted})"
            )
        _stayed(history, State.OPERATION_ENABLED)

    @_claim
    def assert_reached(self, state: State, *, by_s: float | None = None, axis: str | None = None) -> None:
        """Assert that the drive was seen in ``state``, from enabling it to its release; ``by_s``: no later
        than then."""
        name = self.axis(axis).name
        seen = self._states(name)
        times = [at_s for at_s, label in seen if label == state.value]
        told = ", ".join(f"{label} at {at_s:.3f} s" for at_s, label in seen) or "in no state"
        if not times:
            raise AssertionError(f"{name}: never in '{state.value}'; it was seen {told}")
        if by_s is not None and times[0] > by_s:
            raise AssertionError(
                f"{name}: in '{state.value}' at {times[0]:.3f} s, at {by_s:g} s asked for; it was seen {told}"
            )

    @_claim
    def assert_stayed(self, state: State, *, axis: str | None = None) -> None:
        """Assert that every reading of the loop shows ``state``."""
        _stayed(self.axis(axis), state)

    @_claim
    def assert_no_unintended_frame(self, *, allow: tuple[str, ...] = ()) -> None:
        """Assert that only regular frames of the bench and its drives were on the wire.

        NMT, SYNC, heartbeats, SDO, and the PDOs of the bench in their lengths: an EMCY, an unsolicited PDO or
        another node's frame fails. ``allow``: patterns of :mod:`servobench.hil.testing.wire`.
        """
        rules: list[Intended] = []
        if self.config.loop.sync != "own":
            rules.append(Intended("080#", False))
        for name, plan in pdo_plans(self.config).items():
            rules += intended_frames(self.config.host.node, self.config.drive[name].node, plan)
        self.wire.assert_only(rules, allow)

    # ---- inside ---------------------------------------------------------------------------------------

    def _axis_name(self, name: str | None) -> str:
        axes = self.config.axes
        if name is None and len(axes) == 1:
            return axes[0]
        if name is None or name not in axes:
            raise ValueError(f"axis {name!r}: say one of {', '.join(axes)}")
        return name

    def _assert_completed(self) -> None:
        verdict = self.summary.verdict
        if not verdict.completed:
            raise AssertionError(f"the run was cut short: {verdict.reason}")

    def _scale(self, history: AxisHistory) -> float:
        scale = history.scale_rad_s
        if not scale:
            raise ValueError(f"{history.name} has no reference to take percent of; give the error in rad/s")
        return scale

    def _states(self, axis: str) -> list[tuple[float, str]]:
        """Return when the drive was seen in another state, including events before and after the loop."""
        track = f"{axis} drive"
        states = [
            (event["at_ns"] / NS_PER_S, str(event["state"]).lower())
            for event in self.events
            if event.get("track") == track
        ]
        states += [(at_s, state.value) for at_s, state in self.axis(axis).states() if state is not None]
        return sorted(states)


def _stayed(history: AxisHistory, state: State) -> None:
    for at_s, seen in history.states():
        if seen is not state:
            label = "no state of CiA 402" if seen is None else f"'{seen.value}'"
            raise AssertionError(f"{history.name}: {label} at {at_s:.3f} s, '{state.value}' expected")
    if not history.sampled.any():
        raise AssertionError(f"{history.name}: no reading tells a state")


def _chosen(history: AxisHistory, after_s: float | None) -> list[Stretch]:
    stretches = history.stretches()
    if after_s is None:
        return stretches
    tolerance_s = 1.5 * float(np.median(np.diff(history.time_s)))
    chosen = [stretch for stretch in stretches if abs(stretch.at_s - after_s) <= tolerance_s]
    if not chosen:
        there = ", ".join(f"{stretch.at_s:.3f} s" for stretch in stretches) or "nowhere"
        raise ValueError(f"{history.name}: nothing changes at {after_s:g} s; changes end at {there}")
    return chosen


def _settling_s(
    history: AxisHistory, stretch: Stretch, within_s: float, band_rad_s: float, band_percent: float
) -> float:
    part = slice(stretch.first, stretch.end)
    since_s = history.time_s[part] - stretch.at_s
    error = np.abs(history.error_rad_s[part])
    outside = since_s[error > band_rad_s]
    settled_s = float(outside[-1]) if outside.size else 0.0
    after = error[(since_s >= within_s) & ~np.isnan(error)]
    place = f"{history.name}: {within_s:g} s after {stretch.what} at {stretch.at_s:.3f} s"
    if not after.size:
        raise AssertionError(f"{place} there is no reading any more")
    if settled_s >= within_s:
        percent = 100.0 * float(after.max()) / history.scale_rad_s
        raise AssertionError(
            f"{place} the speed is still up to {percent:.3g} % ({after.max():.4g} rad/s) off, the band is "
            f"{band_percent:g} %; last outside of it after {settled_s:.3f} s"
        )
    return settled_s

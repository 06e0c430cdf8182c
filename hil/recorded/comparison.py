"""Recorded runs held against the first of them: aligned on scenario time, in bounded memory.

Two rows belong together if they are of the same axis and the same planned cycle. Compared is what the digest
is over; where two runs first differ in it, the bench or the network was another one. How far apart measured
signals are is taken of cycles that have a reading in both.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import numpy as np
from pydantic import Field, create_model

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.configuration.config_files import Section, load_file
from servobench.hil.loop.cycle_record import FATE_SAMPLE, NAMES
from servobench.hil.recorded.recorded_run import RecordedRun, RunSignals
from servobench.hil.reviewing.envelope import Largest, largest
from servobench.hil.rows.records import DIGESTED, ROW_DTYPE, Rows
from servobench.hil.rows.seal import doubt
from servobench.hil.verdict.metrics import METRICS, Beside, compared_values
from servobench.hil.verdict.summary_text import number

_SIGNALS: Final = ("velocity_rad_s", "torque_nm", "command_torque_nm", "reference_rad_s", "load_torque_nm")
_COMPARED: Final = [
    place for place in DIGESTED if NAMES[place] not in ("axis", "clock_offset_ns", "device_time_ns")
]
"""Places of the columns; every one has eight bytes."""
_COLUMNS_MAX: Final = 8
"""Columns shown of a divergence: more say nothing new."""


Tolerance = Annotated[float | None, Field(ge=0)]
T = TypeVar("T", bound=Section)


def _with_metrics(section: type[T]) -> type[T]:
    """Return the section with a tolerance for each metric that is compared."""
    keys: dict[str, Any] = {each.compared: (Tolerance, None) for each in METRICS.values() if each.compared}
    return create_model(
        section.__name__, __base__=section, __module__=__name__, __doc__=section.__doc__, **keys
    )


@_with_metrics
class Tolerances(Section):
    """How much worse than the baseline a run may be, each in its own unit; what is absent is not judged."""

    speed_difference_rms_rad_s: Tolerance = None
    """RMS difference of the measured speeds, cycle by cycle."""
    speed_difference_max_rad_s: Tolerance = None


def load_tolerances(path: Path) -> Tolerances:
    """Raises BadInput or BadInputs."""
    return load_file(Tolerances, path, "a file of tolerances", NamedBy("--tolerances", "", str(path)))


class Difference:
    """Differences in one signal of one axis."""

    def __init__(self) -> None:
        self.largest = Largest()
        """By size, and when, run time."""
        self._count, self._square_sum = 0, 0.0

    def add(self, due_at: np.ndarray[Any, Any], apart: np.ndarray[Any, Any]) -> None:
        """(n,) instants and differences; what is no number is left out."""
        known = ~np.isnan(apart)
        apart = np.abs(apart[known])
        self._count += apart.size
        self._square_sum += float((apart * apart).sum())
        self.largest.look(due_at[known], apart)

    @property
    def rms(self) -> float | None:
        """None: no cycle has both."""
        return math.sqrt(self._square_sum / self._count) if self._count else None


@dataclass(slots=True)
class Divergence:
    """Where two runs first differ."""

    axis: str
    cycle: int
    at_ns: int
    columns: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Regression:
    """A figure beside that of the baseline."""

    name: str
    baseline: float | None
    value: float | None
    tolerance: float
    kept: bool | None
    """None: it is not measured in both."""


@dataclass
class Against:
    """A run beside the first one."""

    run: RecordedRun
    signals: RunSignals
    differences: dict[str, dict[str, Difference]] = field(default_factory=dict)
    """By axis and signal."""
    divergence: Divergence | None = None
    """None: every cycle that both have is the same."""
    cycles_of_both: int = 0
    regressions: list[Regression] = field(default_factory=list)
    """Violations of the tolerances, if there are tolerances."""

    @cached_property
    def figures(self) -> dict[str, float | None]:
        """Compared figures, by the names of :class:`Tolerances`."""
        figures = self.signals.review.figures()
        return compared_values(figures, Beside(figures.rows))


def compare_runs(runs: Sequence[RecordedRun], tolerances: Tolerances | None = None) -> list[Against]:
    """The first one beside itself, then each other. Raises BadInput for runs that share no axis or period."""
    base = runs[0]
    for run in runs[1:]:
        if not set(run.axes) & set(base.axes):
            raise BadInput(
                "RUN", "axes", ", ".join(run.axes), f"one of {', '.join(base.axes)}, as in {base.folder}"
            )
        if run.config.loop.period != base.config.loop.period:
            expected = f"{base.config.loop.period_us}, as in {base.folder}"
            raise BadInput(str(run.folder), "loop.period_us", run.config.loop.period_us, expected)
    compared = [_beside(base, run) for run in runs]
    if tolerances is not None:
        for each in compared[1:]:
            each.regressions = list(_regressions(compared[0], each, tolerances))
    return compared


def _beside(base: RecordedRun, run: RecordedRun) -> Against:
    beside = Against(run, RunSignals(run.review, run.config.loop.deadline))
    if run is base:
        for rows in run.rows():
            beside.signals.add(rows)
        return beside
    shared = {name: (base.axes.index(name), run.axes.index(name)) for name in run.axes if name in base.axes}
    beside.differences = {name: {signal: Difference() for signal in _SIGNALS} for name in shared}
    others = _RowsByAxis(base, [theirs for theirs, _ in shared.values()])
    for rows in run.rows():
        beside.signals.add(rows)
        for name, (theirs, ours) in shared.items():
            mine = rows.compress(rows["axis"] == ours)
            if mine.size:  # a batch may end between two axes of a cycle: each goes as far as it has come
                _hold(beside, name, others.up_to(theirs, int(mine["sequence"][-1])), mine)
    return beside


class _RowsByAxis:
    """The rows of a run, axis by axis as far as they are asked for."""

    def __init__(self, run: RecordedRun, axes: Sequence[int]) -> None:
        self._batches = run.rows()
        self._held = {axis: np.empty(0, ROW_DTYPE) for axis in axes}

    def up_to(self, axis: int, cycle: int) -> Rows:
        """Those up to a cycle that were not taken yet."""
        while not (self._held[axis]["sequence"][-1:] >= cycle).any():
            batch = next(self._batches, None)
            if batch is None:
                break
            for each, held in self._held.items():
                self._held[each] = np.concatenate((held, batch.compress(batch["axis"] == each)))
        held = self._held[axis]
        end = int(np.searchsorted(held["sequence"], cycle, side="right"))
        self._held[axis] = held[end:]
        return held[:end]


def _hold(beside: Against, name: str, other: Rows, mine: Rows) -> None:
    _, left, right = np.intersect1d(other["sequence"], mine["sequence"], return_indices=True)
    base, own = other[left], mine[right]
    if not base.size:
        return
    beside.cycles_of_both += base.size
    read = (base["fate"] == FATE_SAMPLE) & (own["fate"] == FATE_SAMPLE)
    for signal, difference in beside.differences[name].items():
        measured = signal in ("velocity_rad_s", "torque_nm")
        apart = own[signal] - base[signal]
        difference.add(own["due_at"], np.where(read, apart, np.nan) if measured else apart)
    if beside.divergence is None or own["due_at"][0] < beside.divergence.at_ns:
        _look_for_divergence(beside, name, base, own)


def _look_for_divergence(beside: Against, name: str, base: Rows, own: Rows) -> None:
    """In the columns of the digest, bit by bit; a drive's clock begins where it was switched on."""
    left, right = (np.ascontiguousarray(rows).view(np.int64).reshape(rows.size, -1) for rows in (base, own))
    differs = left[:, _COMPARED] != right[:, _COMPARED]
    places = np.flatnonzero(differs.any(axis=1))
    if not places.size:
        return
    place = int(places[0])
    at = int(own["due_at"][place])
    if beside.divergence is None or at < beside.divergence.at_ns:
        columns = tuple(NAMES[_COMPARED[column]] for column in np.flatnonzero(differs[place]))
        beside.divergence = Divergence(name, int(own["sequence"][place]), at, columns)


def _regressions(base: Against, other: Against, tolerances: Tolerances) -> Iterator[Regression]:
    """Smaller is better in every figure."""
    values = {**other.figures, **_speed_apart(other)}
    references = {**base.figures, "speed_difference_rms_rad_s": 0.0, "speed_difference_max_rad_s": 0.0}
    for name, value in values.items():
        tolerance = getattr(tolerances, name)
        if tolerance is None:
            continue
        reference = references[name]
        kept = None if value is None or reference is None else value <= reference + tolerance
        if value is None and reference is None:
            kept = True  # neither run had such a step
        yield Regression(name, reference, value, tolerance, kept)


def _speed_apart(other: Against) -> dict[str, float | None]:
    apart = [signals["velocity_rad_s"] for signals in other.differences.values()]
    return {
        "speed_difference_rms_rad_s": largest(each.rms for each in apart),
        "speed_difference_max_rad_s": largest(each.largest.value for each in apart),
    }


def comparison_json(compared: Sequence[Against]) -> dict[str, Any]:
    """Plain values."""
    return {
        "baseline": str(compared[0].run.folder),
        "runs": [
            {
                "run": str(each.run.folder),
                "seal": each.run.seal,
                "figures": each.figures,
                "cycles_of_both": each.cycles_of_both,
                "differences": {
                    axis: {
                        signal: {"rms": one.rms, "max": one.largest.value, "at_ns": one.largest.at}
                        for signal, one in signals.items()
                    }
                    for axis, signals in each.differences.items()
                },
                "first_divergence": None if each.divergence is None else asdict(each.divergence),
                "regressions": [asdict(one) for one in each.regressions],
            }
            for each in compared
        ],
    }


def comparison_lines(compared: Sequence[Against]) -> list[str]:
    """Figures side by side, then each run beside the first."""
    lines = [f"{place}  {each.run.title()}{doubt(each.run.seal)}" for place, each in enumerate(compared)]
    lines += ["", f"{'':28}" + "".join(f"{place:>12}" for place in range(len(compared)))]
    for name in compared[0].figures:
        values = [each.figures[name] for each in compared]
        lines.append(f"{name:28}" + "".join(f"{number(value):>12}" for value in values))
    for place, each in enumerate(compared[1:], start=1):
        lines += ["", f"{place} beside 0: {each.cycles_of_both} cycles of both"]
        lines += _apart(each)
        lines += [_judged(one) for one in each.regressions]
    return lines


def _apart(each: Against) -> Iterator[str]:
    divergence = each.divergence
    if divergence is None:
        yield "  every cycle of both is the same"
        return
    more = len(divergence.columns) - _COLUMNS_MAX
    named = ", ".join(divergence.columns[:_COLUMNS_MAX]) + (f" and {more} more" if more > 0 else "")
    at_s = divergence.at_ns / NS_PER_S
    yield f"  first divergence: {divergence.axis}, cycle {divergence.cycle} at {at_s:.6f} s, in {named}"
    for axis, signals in each.differences.items():
        for signal, one in signals.items():
            if one.largest.value and one.largest.at is not None:
                sizes = f"rms {number(one.rms):>10}  largest {number(one.largest.value):>10}"
                yield f"  {axis} {signal:20} {sizes} at {one.largest.at / NS_PER_S:.3f} s"


def _judged(one: Regression) -> str:
    result = {True: "within", False: "EXCEEDED", None: "not measured in both"}[one.kept]
    return (
        f"  {one.name:28} {number(one.value):>10}, baseline {number(one.baseline):>10} "
        f"+ {one.tolerance:g}: {result}"
    )

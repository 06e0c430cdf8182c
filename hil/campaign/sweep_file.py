"""Sweep files: the bench, the varied values, the number of runs, the stopping rule, and the user's functions:
changes to a run's bench, and a check of the run.
"""

import traceback
from collections.abc import Callable
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import Field, model_validator

from servobench.drivers.errors import BadInput, BenchError
from servobench.hil.configuration.config_files import Section, validated
from servobench.hil.control.own_code import OBJECT_PATTERN, OwnCodeFailed, object_of, source_of
from servobench.hil.machine.held_process import FAILURES, OWN_FILES, held_process, told

RUNS_MAX = 10_000_000
"""More is a slip of the pen: at 20 runs a second and core it takes 100 cores more than an hour."""

Key = Annotated[str, Field(min_length=1, description="a dotted key of the bench, e.g. loop.deadline_us")]


class CampaignSection(Section):
    """``[campaign]``"""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="a name of letters, digits, . _ -")
    bench: str = Field(min_length=1, description="the path of a bench file, from the sweep file on")
    seeds: int = Field(default=1, ge=1, le=RUNS_MAX)
    """Runs per point, each with its own seed and draw, the same at all points."""
    first_seed: int = Field(default=1, ge=0, lt=2**62)
    allow_uncertified: bool = False
    """Like --allow-uncertified of hil run."""
    failures_recorded: int = Field(default=3, ge=0, le=1000)
    """Number of first failed runs that are repeated with everything recorded."""


class Vary(Section):
    """``[[vary]]``: an axis of the grid, as values, as a range, or as rows of several keys."""

    key: Key | None = None
    keys: Annotated[tuple[Key, ...], Field(strict=False)] = ()
    values: Annotated[tuple[Any, ...], Field(strict=False)] = ()
    rows: Annotated[tuple[Annotated[tuple[Any, ...], Field(strict=False)], ...], Field(strict=False)] = ()
    start: float | None = Field(default=None, alias="from")
    to: float | None = None
    count: int | None = Field(default=None, ge=2, le=RUNS_MAX)
    spacing: Literal["linear", "log"] = "linear"
    whole: bool = False
    """True: a range is rounded to whole numbers."""
    labels: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Names in reports instead of the values."""

    @model_validator(mode="after")
    def _one_kind(self) -> "Vary":
        ranged = [self.start is not None, self.to is not None, self.count is not None]
        kinds = [bool(self.values), bool(self.rows), all(ranged)]
        if sum(kinds) != 1 or (any(ranged) and not all(ranged)):
            raise ValueError("one of: values; rows beside keys; or from, to and count")
        if bool(self.rows) != bool(self.keys) or (self.key is None) == (not self.keys):
            raise ValueError("key beside values or a range, keys beside rows")
        if any(len(row) != len(self.keys) for row in self.rows):
            raise ValueError(f"in each of rows {len(self.keys)} values, one for each of keys")
        if self.spacing == "log" and all(ranged) and min(self.start or 0.0, self.to or 0.0) <= 0.0:
            raise ValueError("from and to above 0 where the spacing is log")
        if self.labels and len(self.labels) != max(len(self.values), len(self.rows), self.count or 0):
            raise ValueError("as many labels as values")
        return self


class Draw(Section):
    """``[[draw]]``: a key whose values are drawn."""

    key: Key
    distribution: Literal["uniform", "log_uniform", "normal"]
    low: float | None = None
    high: float | None = None
    mean: float | None = None
    deviation: float | None = Field(default=None, gt=0)
    whole: bool = False
    """True: values are rounded to whole numbers."""

    @model_validator(mode="after")
    def _its_parameters(self) -> "Draw":
        normal = self.distribution == "normal"
        needed = ("mean", "deviation") if normal else ("low", "high")
        for name in ("mean", "deviation", "low", "high"):
            given = getattr(self, name) is not None
            if given != (name in needed):
                raise ValueError(f"{' and '.join(needed)} for {self.distribution}, and no other of them")
        if self.low is not None and self.high is not None:
            if self.low >= self.high:
                raise ValueError("low below high")
            if self.distribution == "log_uniform" and self.low <= 0.0:
                raise ValueError("low above 0 for log_uniform")
        return self


class DrawnTwin(Section):
    """``[[twin]]``: a motor that is drawn from what a fit has found."""

    key: Key
    file: str = Field(min_length=1, description="the path of a twin of hil fit, from the sweep file on")


class Drawing(Section):
    """``[drawing]``: how what is drawn is drawn together."""

    method: Literal["random", "latin_hypercube", "sobol"] = "random"
    seed: int = Field(default=0, ge=0, lt=2**63)


class Stop(Section):
    """``[stop]``: when to end before all planned runs are done."""

    rate_width: float | None = Field(default=None, gt=0, lt=1)
    """The pass rate of every point of the grid is known to an interval no wider than this."""
    confidence: float = Field(default=0.95, gt=0.5, lt=1)
    """Confidence of that interval, and of those in the report."""


class Adaptive(Section):
    """``[adaptive]``: draws that concentrate where runs fail, in rounds, with correcting weights."""

    guide: str = Field(description="a figure of the runs, e.g. speed_error_peak_percent")
    """The larger, the nearer to failing. It only guides; the verdict decides about failures."""
    focus: Literal["failures", "boundary"] = "failures"
    """``failures``: for rare ones; ``boundary``: to where runs that pass and runs that do not meet."""
    round_runs: int = Field(default=200, ge=20, le=100_000)
    """There are as many rounds as it takes, in at most half of ``campaign.seeds``; the rest counts."""


class Own(Section):
    """``[own]``: user functions; see :class:`servobench.hil.campaign.sweep_file.OwnFunctions`."""

    changes: str | None = Field(default=None, pattern=OBJECT_PATTERN)
    """Function that changes the bench, by the seed of a run."""
    check: str | None = Field(default=None, pattern=OBJECT_PATTERN)
    """Function that checks every run."""


class SweepFile(Section):
    """A whole sweep file."""

    campaign: CampaignSection = Field(description="the table [campaign] with name and bench")
    change: dict[str, Any] = Field(default_factory=dict)
    """Dotted keys of the bench and their values, the same in every run."""
    vary: Annotated[tuple[Vary, ...], Field(strict=False)] = ()
    draw: Annotated[tuple[Draw, ...], Field(strict=False)] = ()
    twin: Annotated[tuple[DrawnTwin, ...], Field(strict=False)] = ()
    drawing: Drawing = Drawing()
    stop: Stop = Stop()
    adaptive: Adaptive | None = None
    own: Own = Own()


def sweep_from(tables: Any, source: str) -> SweepFile:
    """Make a sweep from the tables of a file. Raises BadInput or BadInputs."""
    sweep = validated(SweepFile, tables, source)
    varied = [key for axis in sweep.vary for key in (axis.keys or (axis.key or "",))]
    varied += [draw.key for draw in sweep.draw] + [twin.key for twin in sweep.twin]
    for number, key in enumerate(varied):
        if key in varied[:number]:
            raise BadInput(source, "vary", key, "each key once")
    for twin in sweep.twin:
        for key in (*varied, *sweep.change):
            if key.startswith(f"{twin.key}."):
                raise BadInput(source, "twin.key", twin.key, f"a motor of which nothing else is set: {key}")
    if "bench.seed" in (*varied, *sweep.change):
        raise BadInput(source, "vary", "bench.seed", "campaign.seeds and campaign.first_seed for the seeds")
    _check_drawing(sweep, source)
    return sweep


def _check_drawing(sweep: SweepFile, source: str) -> None:
    method, seeds = sweep.drawing.method, sweep.campaign.seeds
    if method == "sobol" and seeds & (seeds - 1):
        expected = "a power of two: points of drawing.method sobol are balanced only then"
        raise BadInput(source, "campaign.seeds", seeds, expected)
    if sweep.adaptive is not None:
        _check_adaptive(sweep, source)
    if method != "random" and sweep.stop.rate_width is not None:
        expected = "random: an end when enough was seen takes draws that do not depend on each other"
        raise BadInput(source, "drawing.method", method, expected)


def _check_adaptive(sweep: SweepFile, source: str) -> None:
    if not (sweep.draw or sweep.twin) or sweep.vary:
        expected = "tables [[draw]] or [[twin]] and none [[vary]] beside [adaptive]: it is over what is drawn"
        raise BadInput(source, "vary" if sweep.vary else "draw", len(sweep.vary or sweep.draw), expected)
    assert sweep.adaptive is not None
    if (least := 2 * sweep.adaptive.round_runs) > sweep.campaign.seeds:
        expected = f"{least} at least, two rounds of adaptive.round_runs"
        raise BadInput(source, "campaign.seeds", sweep.campaign.seeds, expected)
    if sweep.drawing.method != "random":
        raise BadInput(source, "drawing.method", sweep.drawing.method, "random beside [adaptive]")
    if sweep.stop.rate_width is not None:
        raise BadInput(source, "stop.rate_width", sweep.stop.rate_width, "none beside [adaptive]")


EXPECTED: Final = "a function, as MODULE:NAME or FILE.py:NAME beside the sweep file"
T = TypeVar("T")


class OwnFunctions:
    """The functions named by ``[own]`` of a sweep.

    ``changes(seed)`` returns what is changed in the bench, by dotted keys. ``check(seed, run)`` calls
    ``run()`` once, which runs the bench and returns a :class:`hil.Run`; it returns or yields defects in
    words.
    """

    def __init__(self, own: Own, source: Path) -> None:
        """``source``: the sweep file. Runs none of them. Raises BadInput for a missing file."""
        self._source = str(source)
        given = own.model_dump(exclude_none=True)
        self._names = {
            key: str(source.parent / name) if ".py:" in name else name for key, name in given.items()
        }
        self._digests = {key: self._digest(key) for key in self._names}
        self.checks = "check" in self._names

    def changes(self, seed: int) -> dict[str, Any]:
        """Return the changes for the run with ``seed``. Raises BadInput or OwnCodeFailed."""
        if "changes" not in self._names:
            return {}
        # a copy: keys below its tables may be changed further
        return self._called("changes", seed, lambda function: deepcopy(dict(function(seed))))

    def findings(self, seed: int, run: Callable[[], Any]) -> list[str]:
        """Return the findings of the check. Raises BadInput or OwnCodeFailed, and BenchError as ``run``."""
        return self._called("check", seed, lambda function: list(map(str, function(seed, run))))

    def _called(self, key: str, seed: int, call: Callable[[Any], T]) -> T:
        name = self._names[key]
        try:
            function = _function(name, self._digests[key])
        except FAILURES as error:
            raise BadInput(self._source, f"own.{key}", name, EXPECTED, told(error)) from error
        try:
            with held_process():
                return call(function)
        except FAILURES as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            if isinstance(error, BenchError) and last.filename not in OWN_FILES:
                raise  # of its run
            where = f"{Path(last.filename).name}:{last.lineno} in {last.name}"
            raise OwnCodeFailed(f"{name}, seed {seed}: {where}: {told(error)}") from error

    def _digest(self, key: str) -> str:
        try:
            return source_of(self._names[key])[1]
        except ValueError as error:
            raise BadInput(self._source, f"own.{key}", self._names[key], EXPECTED, str(error)) from error


@cache
def _function(name: str, _digest: str) -> Any:
    """Load a function once, and again when its file has changed: in a notebook campaigns follow each
    other."""
    return object_of(name)

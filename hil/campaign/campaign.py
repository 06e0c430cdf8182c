"""A campaign from its sweep to its table: runs, stops, resumes, and states its results."""

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from servobench.drivers.errors import BadInput, BenchError
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.campaign.on_dask import dask_client, rows_on_dask
from servobench.hil.campaign.plan import CampaignPlan, GridAxis
from servobench.hil.campaign.pool import RowSource, rows_of
from servobench.hil.campaign.statistics import ConfidenceInterval, anytime, clopper_pearson, weighted_rate
from servobench.hil.campaign.store import RunStore, open_campaign, plan_in, schema_of, stored_runs
from servobench.hil.campaign.worker import Finished, NotTheSame, Row, Workshop
from servobench.hil.machine.stopping import StopRequest, stop_signals
from servobench.hil.reviewing.certificate_meter import CertificateState
from servobench.hil.verdict.arguments import checked
from servobench.hil.verdict.verdict import ExitStatus

STORED_EVERY_NS: Final = 5 * NS_PER_S
"""At most this much work is repeated after a kill."""
FAILURES_FOLDER: Final = "failures"
REPLAYS_FOLDER: Final = "replays"


class CampaignProgress(NamedTuple):
    """Progress of a campaign."""

    done: int
    planned: int
    passed: int
    runs_per_s: float
    left_s: float
    """Until all planned runs are done; a stopping rule may end it before."""


class CounterExample(BenchError):
    """A run within the premises of a certificate violated it: one of the two is wrong."""

    exit_status = ExitStatus.COUNTER_EXAMPLE


class NothingCertified(BenchError):
    """No run could be checked against a certificate."""

    exit_status = ExitStatus.INCOMPLETE


class Campaign:
    """The stored runs of a campaign, and claims about them."""

    def __init__(self, folder: Path, plan: CampaignPlan) -> None:
        """``folder``: that of the campaign."""
        self.folder = folder
        self.plan = plan

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> "Campaign":
        """Load the campaign in ``folder``. Raises BadInput."""
        return cls(Path(folder), plan_in(Path(folder)))

    @cached_property
    def table(self) -> pa.Table:
        """One row per run, in order of their numbers; units and meanings are metadata of the fields."""
        return stored_runs(self.folder, schema_of(self.plan))

    def column(self, name: str) -> NDArray[Any]:
        """Return the (n,) values of a column; NaN where a figure was not measured."""
        values: NDArray[Any] = self.table.column(name).to_numpy()
        return values

    @checked
    def at(self, axis: GridAxis, place: int) -> NDArray[np.bool_]:
        """Return (n,) True for runs with the ``place``-th value of an axis."""
        value = axis.labels[place] if axis.numbers is None else axis.numbers[place]
        mask: NDArray[np.bool_] = self.column(axis.title) == value
        return mask

    @property
    def sequential(self) -> bool:
        """True if the campaign could end early: its intervals allow for that."""
        return self.plan.sweep.stop.rate_width is not None

    @property
    def adaptive(self) -> bool:
        """True if draws were adaptive: its rate comes from weighted runs."""
        return self.plan.sweep.adaptive is not None

    @property
    def nominal(self) -> NDArray[np.bool_]:
        """(n,) True for runs drawn from the sweep's own distributions, all with the same weight."""
        adaptive = self.plan.sweep.adaptive
        numbers = np.arange(self.table.num_rows)
        return numbers < (numbers.size if adaptive is None else adaptive.round_runs)

    @checked
    def failure_rate(self, confidence: float | None = None) -> ConfidenceInterval:
        """Return the failure rate of a campaign with one point; otherwise see :meth:`pass_rate`."""
        if not self.adaptive:
            return self.pass_rate(0, confidence).complement
        counts = self.column("counts").astype(bool)
        failed = ~self.column("passed").astype(bool)
        confidence = confidence or self.plan.sweep.stop.confidence
        return weighted_rate(self.column("weight")[counts], failed[counts], confidence)

    @checked
    def pass_rate(self, point: int = 0, confidence: float | None = None) -> ConfidenceInterval:
        """Return the pass rate at a point of the grid; ``confidence``: default that of the sweep file.

        There is none over several points: they share their seeds, and no point is more likely than another.
        """
        if self.adaptive:
            return self.failure_rate(confidence).complement
        passed = self.column("passed")[self.column("point") == point]
        confidence = confidence or self.plan.sweep.stop.confidence
        of_runs = anytime if self.sequential else clopper_pearson
        return of_runs(int(passed.sum()), passed.size, confidence)

    @checked
    def assert_pass_rate(self, *, at_least: float, confidence: float = 0.95) -> None:
        """Assert that at every point of the grid the true pass rate is at least ``at_least``.

        The one-sided confidence holds for all points together. It also fails if there are too few runs. The
        rate is over the seeds and the draws.
        """
        __tracebackhide__ = True
        for point in range(self.plan.points):
            rate = self.pass_rate(point, 1.0 - 2.0 * (1.0 - confidence))
            if rate.low < at_least:
                runs = np.flatnonzero(self.column("point") == point)
                failed = runs[~self.column("passed")[runs].astype(bool)]
                first = f", the first of them run {failed[0]}" if failed.size else ""
                where = self.plan.point_title(point)
                raise AssertionError(
                    f"{where + ': ' if where else ''}{runs.size - failed.size} of {runs.size} runs passed "
                    f"({failed.size} did not{first}): with {100 * confidence:g} % confidence the rate is at "
                    f"least {rate.low:.6g}, {at_least:g} asked for\ncampaign: {self.folder}"
                )

    def assert_certificate(self) -> None:
        """Assert that every run within the premises of its controller's certificate kept it, and that some
        were; :attr:`table` has the premises that the others left."""
        __tracebackhide__ = True
        try:
            self.hold_certificate()
        except (CounterExample, NothingCertified) as error:
            raise AssertionError(str(error)) from error

    @property
    def found(self) -> dict[int, list[str]]:
        """Findings of the user's check, by number of the run, for runs with any."""
        if not self.plan.own.checks:
            return {}
        findings = self.table.column("findings").to_pylist()
        return {number: texts for number, texts in enumerate(findings) if texts}

    def assert_nothing_found(self) -> None:
        """Assert that the user's check found nothing in any run."""
        __tracebackhide__ = True
        if self.found:
            raise AssertionError("\n".join(self.found_lines()))

    def found_lines(self) -> list[str]:
        """Return the findings, with the commands that repeat those runs."""
        lines = [f"run {number}: {text}" for number, texts in self.found.items() for text in texts]
        again = [f"hil campaign replay {self.folder} --run {number}" for number in self.found]
        return lines + again

    def hold_certificate(self) -> None:
        """Raise CounterExample for the first run that is one, NothingCertified if none could be one."""
        states = self.column("certificate").astype(str)
        exceeded = np.flatnonzero(states == CertificateState.EXCEEDED)
        if exceeded.size:
            raise counter_example(self.table.slice(int(exceeded[0]), 1).to_pylist()[0], self.folder)
        if not (states == CertificateState.KEPT).any():
            by_state = ", ".join(
                f"{count} {name or 'without a certificate'}" for name, count in counted(states).items()
            )
            raise NothingCertified(f"no run could be held against a certificate: {by_state}")

    @checked
    def replay(self, number: int, record: Path | None = None) -> Finished:
        """Repeat run ``number`` with everything recorded; ``record``: where, default below the campaign. Its
        check, if any, sees the recording.

        Raises BadInput: there is no such run; NotTheSame: its digest is another one.
        """
        if not 0 <= number < self.table.num_rows:
            raise BadInput("--run", "", number, f"a run of the campaign: 0 to {self.table.num_rows - 1}")
        learn(self.plan, self.table)
        folder = record or self.folder / REPLAYS_FOLDER / f"run-{number:09d}"
        done = Workshop(self.plan).finished(self.plan.run(number), folder)
        digest = self.table.column("digest")[number].as_py()
        if done.summary.digest != digest:
            raise NotTheSame(
                f"run {number}: digest {done.summary.digest}, in the campaign {digest}; see {folder}"
            )
        return done


def learn(plan: CampaignPlan, table: pa.Table) -> None:
    """Derive adaptive draws from the rows before them."""
    if plan.rounds is not None and plan.sweep.adaptive is not None:
        plan.rounds.take(table.select(["run", "passed", plan.sweep.adaptive.guide]).to_pylist())


def counter_example(row: Row, folder: Path) -> CounterExample:
    """Return the error, with the command that repeats the run."""
    return CounterExample(
        f"counter-example: run {row['run']} kept all premises of its certificate, and the gain from load to "
        f"speed error is at least {row['load_gain_least_rad_s_nm']:.4g} rad/s per N m, certified "
        f"{row['load_gain_certified_rad_s_nm']:.4g}; hil campaign replay {folder} --run {row['run']}"
    )


def counted(values: Iterable[Any]) -> dict[str, int]:
    """Count the occurrences of each text."""
    return dict(sorted(Counter(map(str, values)).items()))


class Enough:
    """The stopping rule, fed with rows in order of their number: it cannot depend on who ran them when."""

    def __init__(self, plan: CampaignPlan, against_certificate: bool = False) -> None:
        self._plan = plan
        self._against_certificate = against_certificate
        self._passed = [0] * plan.points
        self._next = 1

    def __call__(self, row: Mapping[str, Any]) -> bool:
        """Take in the next row; return True if it was the last one needed."""
        if self._against_certificate and row["certificate"] == CertificateState.EXCEEDED:
            return True
        width = self._plan.sweep.stop.rate_width
        self._passed[row["point"]] += bool(row["passed"])
        replicates, rest = divmod(row["run"] + 1, self._plan.points)
        if width is None or rest or replicates < self._next:
            return False
        # the sequence holds at any time; each look costs two roots for each point
        self._next = replicates + max(1, replicates // 20)
        confidence = self._plan.sweep.stop.confidence
        return all(anytime(passed, replicates, confidence).width <= width for passed in self._passed)


@checked
def run_campaign(
    sweep: str | os.PathLike[str] | CampaignPlan,
    out: str | os.PathLike[str],
    *,
    workers: int | None = None,
    dask: str | None = None,
    resume: bool = False,
    against_certificate: bool = False,
    seconds: float | None = None,
    stop: StopRequest | None = None,
    progress: Callable[[CampaignProgress], object] = lambda _: None,
    note: Callable[[str], object] = lambda _: None,
) -> Campaign:
    """Run a sweep file to its end; from any thread.

    ``out``: folder of the campaign, new or empty; with ``resume`` also that of the same sweep, which goes on
    where its stored runs end. ``workers``: processes; default: one per core, 1: this one. ``dask``: address
    of a Dask scheduler, whose workers run it instead. ``against_certificate``: a counter-example ends it; see
    :meth:`Campaign.hold_certificate`. ``seconds``: it ends after this time, and continues with ``resume``.
    ``note`` is told what shows that a campaign that is resumed was killed.
    Raises BadInput or BadInputs, RunRefused for a run that cannot be run, WorkerDied, ClusterLost,
    Interrupted; stored runs then remain, and can be resumed.
    """
    plan = sweep if isinstance(sweep, CampaignPlan) else CampaignPlan.load(Path(sweep))
    campaign = Campaign(Path(out), plan)
    with (
        stop_signals(stop) as asked,
        _row_maker(plan, workers, dask, asked) as make_rows,
        open_campaign(campaign.folder, plan, resume) as store,
    ):
        if store.cut_short:
            note(f"{store.cut_short}; its {store.count} runs are as they were written")
        _run(plan, store, make_rows, progress, Enough(plan, against_certificate), seconds)
        _record_failures(campaign)
    return campaign


RowMaker = Callable[[range], RowSource]


@contextmanager
def _row_maker(
    plan: CampaignPlan, workers: int | None, dask: str | None, stop: StopRequest
) -> Iterator[RowMaker]:
    """Return the maker of the rows. Raises BadInput before anything is written."""
    if dask is None:
        cores = len(os.sched_getaffinity(0))
        yield lambda numbers: rows_of(plan, numbers, workers or cores, stop)
        return
    if workers is not None:
        raise BadInput(
            "--workers", "", workers, "nothing beside --dask", "its workers are those of the cluster"
        )
    with dask_client(dask) as client:
        yield lambda numbers: rows_on_dask(client, plan, numbers, stop)


def _run(
    plan: CampaignPlan,
    store: RunStore,
    make_rows: RowMaker,
    progress: Callable[[CampaignProgress], object],
    enough: Enough,
    seconds: float | None,
) -> None:
    passed = 0
    learn(plan, store.table())
    for row in store.table().select(["run", "point", "passed", "certificate"]).to_pylist():
        passed += row["passed"]
        if enough(row):
            return
    clock = MonotonicClock()
    began = stored_at = clock.now()
    first, fresh = store.count, list[Row]()
    rows = make_rows(range(max(0, first - 1), plan.count))  # the last that is stored once more
    try:
        for row in rows:
            if row["run"] < first:
                _require_same(row, store)
                continue
            fresh.append(row)
            if plan.rounds is not None:
                plan.rounds.take([row])
            passed += row["passed"]
            now, done = clock.now(), row["run"] + 1
            runs_per_s = (done - first) * NS_PER_S / max(1, now - began)
            progress(CampaignProgress(done, plan.count, passed, runs_per_s, (plan.count - done) / runs_per_s))
            if enough(row) or (seconds is not None and now - began >= seconds * NS_PER_S):
                break
            if now - stored_at >= STORED_EVERY_NS:
                store.append(fresh)
                fresh, stored_at = [], now
    finally:
        store.append(fresh)
        rows.close()


def _require_same(row: Row, store: RunStore) -> None:
    """Raise NotTheSame for a run whose row differs from the stored one.

    The findings of a user's check are ignored: they may name files and times.
    """
    (stored,) = store.table().slice(row["run"], 1).to_pylist()
    if others := [name for name, value in stored.items() if name != "findings" and row[name] != value]:
        was, now = (", ".join(f"{name} {each[name]}" for name in others) for each in (stored, row))
        raise NotTheSame(
            f"run {row['run']} comes to another row than is stored in {store.folder}: {now}; stored: {was}. "
            "Something that it rests on is in no file that is watched, or the processor computes otherwise"
        )


def _record_failures(campaign: Campaign) -> None:
    """Record the first runs that did not pass; with a check those with findings."""
    most = campaign.plan.sweep.campaign.failures_recorded
    failed = np.flatnonzero(~campaign.column("passed").astype(bool))
    for number in (list(campaign.found) if campaign.plan.own.checks else failed)[:most]:
        folder = campaign.folder / FAILURES_FOLDER / f"run-{number:09d}"
        if not (folder / "summary.json").exists():
            shutil.rmtree(folder, ignore_errors=True)  # what a killed campaign has left of a recording
            campaign.replay(int(number), folder)

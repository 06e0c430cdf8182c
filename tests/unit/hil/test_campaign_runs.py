"""A campaign from its sweep to its table: when it stores, stops and goes on; with rows that are made up."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.campaign import campaign as runner
from servobench.hil.campaign.campaign import Campaign, CampaignProgress, Enough, run_campaign
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.statistics import anytime
from servobench.hil.campaign.worker import FIGURES, NotTheSame
from servobench.hil.configuration.config_files import toml_text
from tests.unit.hil.made_campaigns import plan_of
from tests.unit.hil.test_campaign_plan import LOSS, tables

pytestmark = pytest.mark.usefixtures("forked_children")

KEY: str = LOSS["key"]
FAILING = 4
"""Run that does not pass."""


class Rows:
    """Who makes rows in place of benches: what was asked for, and whether it was ended."""

    def __init__(self) -> None:
        self.asked: list[tuple[range, int]] = []
        self.closed = 0
        self.breaks_at: int | None = None
        self.certificates: dict[int, str] = {}

    def __call__(self, plan: CampaignPlan, numbers: range, workers: int, _stop: Any) -> Iterator[Any]:
        self.asked.append((numbers, workers))
        return self._rows(plan, numbers)

    def _rows(self, plan: CampaignPlan, numbers: range) -> Iterator[Any]:
        try:
            for number in numbers:
                if number == self.breaks_at:
                    raise BusDown("the bus is down")
                yield self.row(plan, number)
        finally:
            self.closed += 1

    def row(self, plan: CampaignPlan, number: int) -> dict[str, Any]:
        planned = plan.run(number)
        passed = number != FAILING
        return {
            "run": number,
            "point": planned.point,
            "replicate": planned.replicate,
            "seed": planned.seed,
            "weight": 1.0,
            "counts": True,
            **planned.labels,
            "outcome": "passed" if passed else "not passed",
            "passed": passed,
            "completed": True,
            "reason": "",
            "certificate": self.certificates.get(number, ""),
            "premises_left": "",
            "premises_unknown": "",
            "digest": f"{number:04x}",
            **dict.fromkeys(FIGURES, 1.0),
            **({"findings": ["rang"] if number in (1, 2, 6) else []} if plan.own.checks else {}),
        }


class Clock:
    """Each look is a step later."""

    step_s = 2

    def __init__(self) -> None:
        self._at = -self.step_s * NS_PER_S

    def now(self) -> Instant:
        self._at += self.step_s * NS_PER_S
        return Instant(self._at)


class Again:
    """Runs repeated in place of benches."""

    digests: dict[int, str]
    folders: list[tuple[int, Path | None]]

    def __init__(self, _plan: CampaignPlan) -> None:
        """It needs nothing."""

    def finished(self, planned: Any, record: Path | None = None) -> Any:
        self.folders.append((planned.number, record))
        digest = self.digests.get(planned.number, f"{planned.number:04x}")
        return SimpleNamespace(summary=SimpleNamespace(digest=digest))


@pytest.fixture(autouse=True)
def rows(monkeypatch: pytest.MonkeyPatch) -> Rows:
    made = Rows()
    monkeypatch.setattr(runner, "rows_of", made)
    monkeypatch.setattr(runner, "MonotonicClock", Clock)
    Again.digests, Again.folders = {}, []
    monkeypatch.setattr(runner, "Workshop", Again)
    return made


@pytest.fixture
def sweep(tmp_path: Path) -> Callable[..., Path]:
    """A sweep file of three points, with a seed or more each."""

    def write(seeds: int = 3, **more: Any) -> Path:
        section = {"seeds": seeds, **more.pop("campaign", {})}
        path = tmp_path / "sweep.toml"
        path.write_text(toml_text(tables(campaign=section, vary=[LOSS], **more)))
        return path

    return write


def stored(folder: Path) -> list[int]:
    """How many rows each file of the store holds, by the numbers in their names."""
    begins = [int(path.stem.split("-")[1]) for path in sorted((folder / "runs").iterdir())]
    ends = [*begins[1:], Campaign.load(folder).table.num_rows]
    return [end - begin for begin, end in zip(begins, ends, strict=True)]


def test_a_campaign_runs_all_that_its_sweep_plans(
    rows: Rows, sweep: Callable[..., Path], tmp_path: Path
) -> None:
    told: list[CampaignProgress] = []
    done = run_campaign(sweep(), tmp_path / "out", workers=2, progress=told.append)
    assert rows.asked == [(range(9), 2)]
    assert rows.closed == 1
    assert done.folder == tmp_path / "out"
    assert done.column("run").tolist() == list(range(9))
    assert done.column("point").tolist() == [0, 1, 2] * 3
    assert done.column("digest").tolist() == [f"{number:04x}" for number in range(9)]
    # a look each 2 s, one before the first row
    assert told == [(n + 1, 9, n + (n < FAILING), 0.5, 2.0 * (8 - n)) for n in range(9)]
    again = Campaign.load(str(tmp_path / "out"))
    assert again.table.equals(done.table)
    assert again.plan.identity == done.plan.identity


def test_as_many_workers_as_there_are_cores_if_none_are_said(
    rows: Rows, sweep: Callable[..., Path], tmp_path: Path
) -> None:
    run_campaign(CampaignPlan.load(sweep(1)), str(tmp_path / "out"))
    assert rows.asked == [(range(3), len(os.sched_getaffinity(0)))]


@pytest.mark.long
@pytest.mark.usefixtures("rows")
def test_a_campaign_whose_seal_ends_as_a_kill_leaves_it_says_so(
    sweep: Callable[..., Path], tmp_path: Path
) -> None:
    """Its last line away or cut anywhere: nobody but --resume accepts it, and that tells it."""
    run_campaign(sweep(), tmp_path / "out", workers=1)
    seal = tmp_path / "out" / "seal"
    whole = seal.read_bytes()
    last = whole[:-1].rindex(b"\n") + 1
    for cut in (last, *range(last + 1, len(whole), 9), len(whole) - 1):
        seal.write_bytes(whole[:cut])
        lacks = "no last line" if cut == last else "a whole last line: a kill leaves an incomplete one"
        with pytest.raises(BadInput, match=rf"seal.*{lacks}.*--resume goes on with it"):
            Campaign.load(tmp_path / "out")
        notes: list[str] = []
        run_campaign(sweep(), tmp_path / "out", workers=1, resume=True, note=notes.append)
        told = "no last line" if cut == last else "an incomplete last line"
        assert notes == [f"{seal}: {told}, as a kill leaves it; its 9 runs are as they were written"]
        assert seal.read_bytes() == whole
    notes.clear()
    run_campaign(sweep(), tmp_path / "out", workers=1, resume=True, note=notes.append)
    assert notes == []
    for cut in range(0, last, 23):
        seal.write_bytes(whole[:cut])
        with pytest.raises(BadInput):
            run_campaign(sweep(), tmp_path / "out", workers=1, resume=True)


@pytest.mark.parametrize(
    ("step_s", "files"), [(2, [3, 3, 3]), (4, [2, 2, 2, 2, 1]), (5, [1] * 9), (1, [5, 4])]
)
def test_rows_are_stored_when_five_seconds_of_them_came(
    sweep: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    step_s: int,
    files: list[int],
) -> None:
    monkeypatch.setattr(Clock, "step_s", step_s)
    run_campaign(sweep(), tmp_path / "out", workers=1)
    assert stored(tmp_path / "out") == files


@pytest.mark.long
@pytest.mark.parametrize(("seconds", "count"), [(3.9, 2), (4.0, 2), (4.1, 3), (100.0, 9)])
def test_time_that_is_up_ends_it_and_it_goes_on_where_its_runs_end(
    rows: Rows, sweep: Callable[..., Path], tmp_path: Path, seconds: float, count: int
) -> None:
    part = run_campaign(sweep(), tmp_path / "out", workers=1, seconds=seconds)
    assert part.table.num_rows == count
    told: list[CampaignProgress] = []
    whole = run_campaign(sweep(), tmp_path / "out", workers=1, resume=True, progress=told.append)
    assert whole.column("run").tolist() == list(range(9))
    assert rows.asked == [(range(9), 1), (range(count - 1, 9), 1)]
    if count < 9:
        first = told[0]
        assert (first.done, first.passed, first.runs_per_s) == (count + 1, count + 1, 0.5)
        assert told[-1].passed == 8
        assert told[-1].left_s == 0.0


def test_what_came_before_an_error_stays(rows: Rows, sweep: Callable[..., Path], tmp_path: Path) -> None:
    rows.breaks_at = 7
    with pytest.raises(BusDown):
        run_campaign(sweep(), tmp_path / "out", workers=1)
    assert Campaign.load(tmp_path / "out").column("run").tolist() == list(range(7))
    assert rows.closed == 1
    rows.breaks_at = None
    run_campaign(sweep(), tmp_path / "out", workers=1, resume=True)
    assert rows.asked[1][0] == range(6, 9)


def test_a_counter_example_ends_it_where_one_is_looked_for(
    rows: Rows, sweep: Callable[..., Path], tmp_path: Path
) -> None:
    rows.certificates = {3: "exceeded", 2: "kept"}
    assert run_campaign(sweep(), tmp_path / "all", workers=1).table.num_rows == 9
    done = run_campaign(sweep(), tmp_path / "out", workers=1, against_certificate=True)
    assert done.column("certificate").tolist() == ["", "", "kept", "exceeded"]
    rows.asked.clear()
    run_campaign(sweep(), tmp_path / "out", workers=1, against_certificate=True, resume=True)
    assert rows.asked == [], "its stored rows were enough"


def test_workers_of_its_own_and_those_of_a_cluster_are_not_both_had(
    rows: Rows, sweep: Callable[..., Path], tmp_path: Path
) -> None:
    with pytest.raises(BadInput) as caught:
        run_campaign(sweep(), tmp_path / "out", workers=2, dask="tcp://h:1")
    expected = "--workers: found 2, expected nothing beside --dask; its workers are those of the cluster"
    assert str(caught.value) == expected
    assert not (tmp_path / "out").exists()
    assert rows.asked == []


def test_a_cluster_makes_the_rows_where_one_is_named(
    rows: Rows, sweep: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []

    @contextmanager
    def client(address: str) -> Iterator[str]:
        yield f"client of {address}"
        seen.append("gone")

    def on_dask(its: str, plan: CampaignPlan, numbers: range, _stop: Any) -> Iterator[Any]:
        seen.append((its, numbers))
        return rows._rows(plan, numbers)

    monkeypatch.setattr(runner, "dask_client", client)
    monkeypatch.setattr(runner, "rows_on_dask", on_dask)
    done = run_campaign(sweep(), tmp_path / "out", dask="tcp://h:1")
    assert seen == [("client of tcp://h:1", range(9)), "gone"]
    assert rows.asked == []
    assert done.table.num_rows == 9


def test_the_runs_that_did_not_pass_are_recorded_once(sweep: Callable[..., Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_campaign(sweep(), out, workers=1)
    place = out / "failures" / "run-000000004"
    assert Again.folders == [(FAILING, place)]
    place.mkdir(parents=True)
    (place / "half").touch()  # of a campaign that was killed
    run_campaign(sweep(), out, workers=1, resume=True)
    assert Again.folders == [(FAILING, place)] * 2
    assert not place.exists(), "what was left of it is gone first"
    place.mkdir()
    (place / "summary.json").touch()
    run_campaign(sweep(), out, workers=1, resume=True)
    assert len(Again.folders) == 2
    assert (place / "summary.json").exists()


@pytest.mark.parametrize(("most", "recorded"), [(0, []), (1, [1]), (2, [1, 2]), (9, [1, 2, 6])])
def test_with_a_check_the_first_runs_that_it_says_something_of_are_recorded(
    sweep: Callable[..., Path], tmp_path: Path, most: int, recorded: list[int]
) -> None:
    (tmp_path / "own.py").write_text("def check(seed, run):\n    return []\n")
    own = {"check": "own.py:check"}
    done = run_campaign(sweep(campaign={"failures_recorded": most}, own=own), tmp_path / "out", workers=1)
    assert [number for number, _ in Again.folders] == recorded
    assert done.found == {1: ["rang"], 2: ["rang"], 6: ["rang"]}


def test_a_run_is_repeated_below_the_campaign_or_where_it_is_said(
    rows: Rows, sweep: Callable[..., Path], tmp_path: Path
) -> None:
    done = run_campaign(sweep(), tmp_path / "out", workers=1)
    Again.folders.clear()
    assert done.replay(0).summary.digest == "0000"
    assert done.replay(8, tmp_path / "here").summary.digest == "0008"
    replays = tmp_path / "out" / "replays"
    assert Again.folders == [(0, replays / "run-000000000"), (8, tmp_path / "here")]
    Again.digests = {8: "beef"}
    with pytest.raises(NotTheSame) as caught:
        done.replay(8)
    place = replays / "run-000000008"
    assert str(caught.value) == f"run 8: digest beef, in the campaign 0008; see {place}"
    assert rows.closed == 1


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (-1, "replay: number: found -1, expected no negative number"),
        (9, "--run: found 9, expected a run of the campaign: 0 to 8"),
    ],
)
def test_a_run_that_is_not_there_is_not_repeated(
    sweep: Callable[..., Path], tmp_path: Path, number: int, words: str
) -> None:
    done = run_campaign(sweep(), tmp_path / "out", workers=1)
    with pytest.raises((BadInput, ValueError)) as caught:
        done.replay(number)
    assert str(caught.value) == words


def rule(points: int, width: float | None, against_certificate: bool = False) -> Enough:
    stop = {"confidence": 0.9} if width is None else {"confidence": 0.9, "rate_width": width}
    losses = {"key": KEY, "values": [place / 8.0 for place in range(points)]}
    return Enough(plan_of(stop=stop, vary=[losses]), against_certificate)


def at(run: int, passed: bool = True, points: int = 1, certificate: str = "") -> dict[str, Any]:
    return {"run": run, "point": run % points, "passed": passed, "certificate": certificate}


def test_nothing_is_ever_enough_without_a_rule() -> None:
    enough = rule(1, None)
    assert not any(enough(at(run, certificate="exceeded")) for run in range(300))


def test_a_counter_example_is_enough_where_one_is_looked_for() -> None:
    enough = rule(2, None, against_certificate=True)
    assert [enough(at(run, False, 2, state)) for run, state in enumerate(["", "kept", "exceeded"])] == [
        False,
        False,
        True,
    ]


@pytest.mark.parametrize("points", [1, 2, 5])
def test_the_rule_ends_at_the_first_look_at_which_every_point_is_known(points: int) -> None:
    """Looks: after each of the first 39 replicates, and then a twentieth further each time."""
    width, looks, replicate = 0.05, [], 1
    while replicate < 2_000:
        looks.append(replicate)
        replicate += max(1, replicate // 20)
    first = next(n for n in looks if anytime(n, n, 0.9).width <= width)
    assert first > 40
    enough = rule(points, width)
    ended = next(run for run in range(100_000) if enough(at(run, points=points)))
    assert ended == first * points - 1


def test_one_point_that_is_not_known_keeps_the_others_running() -> None:
    enough, count = rule(2, 0.3), 0
    for run in range(10_000):
        passed = run % 2 == 0 or run % 4 == 1
        count += run % 2 and passed
        if enough(at(run, passed, 2)):
            break
    replicates = (run + 1) // 2
    assert anytime(int(count), replicates, 0.9).width <= 0.3
    assert anytime(int(count), replicates - 1, 0.9).width > 0.29
    assert anytime(replicates // 4, replicates // 4, 0.9).width <= 0.3, "the other was known long ago"

"""What a worker of a campaign runs and answers, and what a row keeps of a run."""

import gc
import io
import json
import signal
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servobench.drivers.errors import BadInput, BusDown
from servobench.hil.campaign import worker
from servobench.hil.campaign.plan import CampaignPlan, Drawn, PlannedRun
from servobench.hil.campaign.worker import (
    FIGURES,
    Finished,
    Workshop,
    certificate_state,
    refusal,
    row_of_run,
)
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.control.own_code import OwnCodeFailed
from servobench.hil.machine.stopping import Interrupted, StopRequest
from servobench.hil.recording.recorder import recorder_of
from servobench.hil.verdict.figures import StepResponse
from servobench.hil.verdict.metrics import Beside
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import Finding, VerdictKind
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.test_campaign_plan import LOSS, plan, tables
from tests.unit.hil.test_report import summary

PLANNED = PlannedRun(7, 1, 3, 44, {}, {"load.nm": 0.5}, 0.25, False)
TWO_AXES: Any = SimpleNamespace(axes=("a", "b"))


def certificate(state: str, seen: float | None, certified: float | None, **more: Any) -> dict[str, Any]:
    gain = {"seen": seen, "seen_at_least": None if seen is None else 0.5 * seen, "certified": certified}
    return {"state": state, "gain_rad_s_nm": gain, "premises_left": [], "premises_unknown": [], **more}


def certified(certificates: Mapping[str, Any]) -> Summary:
    return replace(summary(), certificates=certificates)


def figures(of: Summary, axes: int = 1) -> dict[str, float | None]:
    beside = Beside(of.cycles * axes, of.bus_load_percent)
    return {name: figure.value(of, beside) for name, figure in FIGURES.items()}


def test_the_figures_are_those_of_the_summary() -> None:
    whole = replace(summary(), torque_rms_nm=0.125, step_response=StepResponse())
    gains = dict.fromkeys(("load_gain_rad_s_nm", "load_gain_least_rad_s_nm", "load_gain_certified_rad_s_nm"))
    known = {
        "speed_error_peak_rad_s": 6.68,
        "speed_error_peak_percent": 4.25,
        "speed_error_rms_rad_s": 0.7,
        "after_load_percent": None,
        "torque_rms_nm": 0.125,
        "dropouts_percent": pytest.approx(100 * 96 / 2000),
        "delay_p99_us": 987.5,
        "delay_max_us": 1044.25,
        "bus_load_percent": 51.4,
        **gains,
        "cycles": 2000.0,
    }
    assert figures(whole) == known
    assert figures(whole, 2)["dropouts_percent"] == pytest.approx(100 * 96 / 4000)
    assert figures(replace(whole, cycles=0))["dropouts_percent"] is None


def test_the_gain_is_that_of_the_axis_nearest_to_its_certificate() -> None:
    found = figures(
        certified(
            {
                "a": certificate("kept", 8.0, 10.0),
                "b": certificate("kept", 0.9, 1.0),
                "c": certificate("kept", 99.0, None),
                "d": certificate("kept", None, 1.0),
            }
        )
    )
    names = ("load_gain_rad_s_nm", "load_gain_least_rad_s_nm", "load_gain_certified_rad_s_nm")
    assert [found[name] for name in names] == [0.9, 0.45, 1.0]


@pytest.mark.parametrize(
    ("states", "told"),
    [
        ([], ""),
        (["kept"], "kept"),
        (["kept", "exceeded"], "exceeded"),
        (["premise left", "kept"], "premise left"),
    ],
)
def test_of_several_certificates_the_state_that_weighs_most_is_told(states: list[str], told: str) -> None:
    each = {str(place): certificate(state, 1.0, 2.0) for place, state in enumerate(states)}
    assert certificate_state(certified(each)) == told


def test_a_row_keeps_what_was_planned_what_came_of_it_and_what_a_check_says() -> None:
    left = certificate("premise left", 1.0, 2.0, premises_left=["delay: 2 ms", "loss: 3"])
    other = certificate("kept", 1.0, 2.0, premises_left=["delay: 3 ms"], premises_unknown=["bandwidth"])
    done = certified({"a": left, "b": other})
    row = row_of_run(PLANNED, Finished(TWO_AXES, done, ["rang"]))
    assert row == {
        "run": 7,
        "point": 1,
        "replicate": 3,
        "seed": 44,
        "weight": 0.25,
        "counts": False,
        "load.nm": 0.5,
        "outcome": "passed",
        "passed": True,
        "completed": True,
        "reason": "",
        "certificate": "premise left",
        "premises_left": "a delay: 2 ms; a loss: 3; b delay: 3 ms",
        "premises_unknown": "b bandwidth",
        "digest": "ab" * 16,
        **figures(done, 2),
        "findings": ["rang"],
    }
    alone = row_of_run(PLANNED, Finished(TWO_AXES, certified({"a": left}), None))
    assert alone["premises_left"] == "delay: 2 ms; loss: 3"
    assert "findings" not in alone


def test_a_run_that_was_interrupted_is_no_row() -> None:
    ended = summary().also(Finding(VerdictKind.INTERRUPTED, "ended by SIGTERM"))
    with pytest.raises(Interrupted, match=r"^ended by SIGTERM$"):
        row_of_run(PLANNED, Finished(TWO_AXES, ended, None))


def test_what_has_no_row_is_answered_by_its_words_its_notes_and_its_status() -> None:
    error = BusDown("the bus is down")
    assert refusal(error) == {"error": "the bus is down", "status": BusDown.exit_status}
    error.add_note("run 3: {}")
    error.add_note("again")
    assert refusal(error)["error"] == "the bus is down; run 3: {}; again"


class Bench:
    """Runs no bench: notes what it was asked for, and ends as it is told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[dict[str, Any]] = []
        self.error: Exception | None = None
        self.concluded = False
        monkeypatch.setattr(worker, "run_bench", self)

    def __call__(self, _config: Any, **asked: Any) -> Summary:
        self.asked.append(asked)
        if self.concluded:
            asked["concluded"](summary(passed=False))
        if self.error is not None:
            raise self.error
        return summary()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_runs_of_a_chunk_are_run_with_their_seeds_and_nothing_is_kept(bench: Bench) -> None:
    stop = StopRequest()
    shop = Workshop(
        plan(vary=[LOSS], campaign={"seeds": 2, "first_seed": 30, "allow_uncertified": True}), stop
    )
    answers = list(shop.answers([[4, [[], 1.0, True]], [0, [[], 0.5, False]]]))
    rows = [answer["row"] for answer in answers]
    assert [(row["run"], row["point"], row["seed"], row["weight"], row["counts"]) for row in rows] == [
        (4, 1, 31, 1.0, True),
        (0, 0, 30, 0.5, False),
    ]
    assert all(answer.keys() == {"row", "took_ns", "files"} and answer["took_ns"] >= 0 for answer in answers)
    first = bench.asked[0]
    assert (first["seed"], first["record"], first["keep"], first["stop"]) == (31, None, False, stop)
    assert (first["allow_uncertified"], first["privileged"]) == (True, False)


def test_a_run_that_is_recorded_is_kept(bench: Bench, tmp_path: Path) -> None:
    shop = Workshop(plan())
    done = shop.finished(plan().run(0), tmp_path / "run")
    assert (done.summary, done.findings) == (summary(), None)
    assert (bench.asked[0]["record"], bench.asked[0]["keep"]) == (tmp_path / "run", True)
    assert bench.asked[0]["stop"] is None


def test_a_run_that_failed_is_told_by_its_verdict_if_it_came_to_one(bench: Bench) -> None:
    bench.error, bench.concluded = BusDown("the bus is down"), True
    assert Workshop(plan()).row(0)["passed"] is False
    bench.concluded = False
    with pytest.raises(BusDown) as caught:
        Workshop(plan(vary=[LOSS])).row(1)
    assert caught.value.__notes__ == [f"run 1: {{'{LOSS['key']}': 0.1}}"]
    bench.error, bench.concluded = Interrupted("ended by SIGTERM"), True
    with pytest.raises(Interrupted):
        Workshop(plan()).row(0)


def test_a_run_that_would_be_on_a_bus_in_real_time_is_refused(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "def changes(seed):\n    return {'bus.spec': 'hub:x'} if seed > 1 else {}\n"
    )
    path = tmp_path / "sweep.toml"
    path.write_text(toml_text(tables(own={"changes": "own.py:changes"}, campaign={"seeds": 2})))
    shop = Workshop(CampaignPlan.load(path))
    assert shop.row(0)["passed"]
    with pytest.raises(BadInput) as caught:
        shop.row(1)
    expected = "'simulated': a campaign runs in simulated time"
    assert (caught.value.key, caught.value.value, caught.value.expected) == ("bus.spec", "hub:x", expected)
    assert len(bench.asked) == 1


def test_a_draw_that_is_known_elsewhere_is_taken(bench: Bench) -> None:
    key = {"key": "loop.deadline_us", "distribution": "uniform", "low": 1000.0, "high": 2000.0, "whole": True}
    row = Workshop(plan(draw=[key], campaign={"seeds": 2})).row(1, Drawn((0.25,), 2.0, False))
    assert (row["loop.deadline_us"], row["weight"], row["counts"]) == (1250.0, 2.0, False)
    assert len(bench.asked) == 1


@pytest.mark.parametrize(("runs", "collections"), [(49, 0), (50, 1), (99, 1), (100, 2)])
def test_garbage_is_collected_each_fifty_runs(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, runs: int, collections: int
) -> None:
    shop, calls = Workshop(plan()), list[None]()
    monkeypatch.setattr(gc, "collect", lambda: calls.append(None))
    monkeypatch.setattr(worker, "row_of_run", lambda *_: {})
    monkeypatch.setattr(shop, "finished", lambda _planned: bench)
    for _ in range(runs):
        shop.row(0)
    assert len(calls) == collections


def checked(tmp_path: Path, code: str) -> Any:
    (tmp_path / "own.py").write_text(code)
    path = tmp_path / "sweep.toml"
    path.write_text(toml_text(tables(own={"check": "own.py:check"})))
    return CampaignPlan.load(path)


def test_a_check_is_given_the_run(bench: Bench, tmp_path: Path) -> None:
    code = (
        "def check(seed, run):\n    done = run()\n    return [done.digest, type(done).__name__, str(seed)]\n"
    )
    done = Workshop(checked(tmp_path, code)).finished(checked(tmp_path, code).run(0), tmp_path / "run")
    assert done.findings == ["ab" * 16, "Run", "1"]
    assert done.summary == summary()
    assert (bench.asked[0]["record"], bench.asked[0]["recording"]) == (tmp_path / "run", recorder_of)


def test_a_check_without_a_recording_looks_at_all_of_the_memory(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memories: list[Any] = []

    class Memory:
        def __init__(self, plan: Any, keep_all: bool) -> None:
            memories.append((plan.name, keep_all))

    def run_bench(config: Any, **asked: Any) -> Summary:
        asked["recording"](plan_for(tmp_path))
        return bench(config, **asked)

    monkeypatch.setattr(worker, "MemoryRecorder", Memory)
    monkeypatch.setattr(worker, "run_bench", run_bench)
    code = "def check(seed, run):\n    return [type(vars(run())['_kept']).__name__]\n"
    its = checked(tmp_path, code)
    assert Workshop(its).row(0)["findings"] == ["Memory"]
    assert memories == [("synthetic", True)]
    assert (bench.asked[0]["record"], bench.asked[0]["keep"]) == (None, False)


@pytest.mark.parametrize(("calls", "told"), [("", "0 times"), ("run(); run()", "2 times")])
def test_a_check_runs_the_bench_once(bench: Bench, tmp_path: Path, calls: str, told: str) -> None:
    its = checked(tmp_path, f"def check(seed, run):\n    {calls or 'pass'}\n    return []\n")
    with pytest.raises(OwnCodeFailed) as caught:
        Workshop(its).finished(its.run(0), tmp_path / "run")
    assert str(caught.value) == f"the check called run() {told}, expected once"
    assert len(bench.asked) == calls.count("run")


def test_a_worker_refuses_a_sweep_that_has_changed(tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    path.write_text(toml_text(tables()))
    identity = CampaignPlan.load(path).identity
    assert isinstance(Workshop.of_sweep(str(path), identity), Workshop)
    path.write_text(toml_text(tables(campaign={"seeds": 9})))
    with pytest.raises(BadInput, match=f"{path}: found .BLAKE2b .*, expected BLAKE2b "):
        Workshop.of_sweep(str(path), identity)


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Have a worker in this process: its answers go into a file, and what it asked of the system is noted."""
    place, asked = tmp_path / "said", list[Any]()
    monkeypatch.setattr(signal, "signal", lambda *what: asked.append(what))

    def serve(*lines: Any) -> tuple[int, list[Any]]:
        lines_in = "".join(json.dumps(each) + "\n" for each in lines)
        with place.open("w", buffering=1) as answers:

            def opened(*what: Any, buffering: int) -> Any:
                asked.append((*what, buffering))
                return answers

            own = SimpleNamespace(
                dup=lambda number: number, dup2=lambda *what: asked.append(what), fdopen=opened
            )
            monkeypatch.setattr(worker, "os", own)
            monkeypatch.setattr(worker, "sys", SimpleNamespace(stdin=io.StringIO(lines_in)))
            status = worker.main()
        assert asked == [(signal.SIGINT, signal.SIG_IGN), (1, "w", 1), (2, 1)]
        asked.clear()
        return status, [json.loads(line) for line in place.read_text().splitlines()]

    return serve


def test_a_worker_runs_chunks_until_nothing_more_comes(bench: Bench, said: Any, tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    path.write_text(toml_text(tables(campaign={"seeds": 3})))
    order = {"sweep": str(path), "identity": CampaignPlan.load(path).identity}
    chunks = [[2, [[], 1.0, True]], [0, [[], 1.0, True]]], [[1, [[], 1.0, True]]]
    status, answers = said(order, *chunks)
    assert status == 0
    assert answers[0] == {"ready": True}
    assert [answer["row"]["run"] for answer in answers[1:]] == [2, 0, 1]
    assert [asked["seed"] for asked in bench.asked] == [3, 1, 2]


def test_a_worker_that_cannot_go_on_says_why(bench: Bench, said: Any, tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    path.write_text(toml_text(tables()))
    identity = CampaignPlan.load(path).identity
    identity["program"]["numpy"] = "1.0"
    status, answers = said({"sweep": str(path), "identity": identity})
    answer = answers[-1]
    assert (status, answer["status"]) == (2, 2)
    assert f"{path}: identity.program.numpy: found '1.0'" in answer["error"]
    assert bench.asked == []

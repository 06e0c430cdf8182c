"""Who runs which runs of a campaign, and in which order their rows leave; with workers made up."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.campaign import pool
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.pool import Chunks, RunRefused, WorkerDied, WorkerPool, rows_of
from servobench.hil.machine.stopping import Interrupted, StopRequest
from tests.unit.hil.made_campaigns import INERTIA, plan_of


def plan() -> CampaignPlan:
    """Each of its runs draws another inertia."""
    return plan_of(seeds=10_000, draw=[INERTIA])


def answer(number: int, took_ns: int = NS_PER_S) -> dict[str, Any]:
    return {"row": {"run": number}, "took_ns": took_ns, "files": {}}


def test_the_first_chunks_are_one_run_each() -> None:
    planned = plan()
    chunks = Chunks(planned, range(5, 9))
    assert [chunks.next(1) for _ in range(5)] == [[5], [6], [7], [8], None]
    assert chunks.drawn([5, 7]) == [[5, planned.drawn(5)], [7, planned.drawn(7)]]


def test_rows_leave_in_order_of_their_number() -> None:
    chunks = Chunks(plan(), range(3))
    for _ in range(3):
        chunks.next(2)
    assert chunks.take(answer(2)) == 2
    assert chunks.take(answer(1)) == 1
    assert list(chunks.rows()) == []
    assert chunks.left
    chunks.take(answer(0))
    assert [row["run"] for row in chunks.rows()] == [0, 1, 2]
    assert not chunks.left


@pytest.mark.parametrize(("rows", "size"), [(0, 1), (6, 1), (7, 2), (22, 9), (44, 85), (60, 263)])
def test_chunks_grow_to_half_a_second_of_what_runs_cost(rows: int, size: int) -> None:
    """The cost follows each row by a tenth: after n rows of 1 ms it is 499 x 0.9^n + 1 ms."""
    assert size == int(500 / (499 * 0.9**rows + 1))
    chunks = Chunks(plan(), range(10_000))
    for _ in range(60):
        chunks.next(1)
    for number in range(rows):
        chunks.take(answer(number, NS_PER_MS))
    chunk = chunks.next(1)
    assert chunk == list(range(60, 60 + size))


def test_dear_runs_stay_alone_and_a_run_of_no_time_is_no_division_by_zero() -> None:
    chunks = Chunks(plan(), range(2_000))
    chunks.next(1)
    chunks.take(answer(0, 10 * NS_PER_S))
    assert chunks.next(1) == [1]
    for number in range(1, 400):
        chunks.take(answer(number, 0))
    assert len(chunks.next(1) or []) > 100


@pytest.mark.parametrize(("workers", "most"), [(1, 64), (16, 64), (17, 68), (100, 400)])
def test_nobody_runs_far_ahead_of_a_row_that_is_missing(workers: int, most: int) -> None:
    """Of chunks of one run: so many beyond the one that is due, 64 at the least and 4 for each worker."""
    chunks = Chunks(plan(), range(1_000))
    handed = [chunk for _ in range(1_000) if (chunk := chunks.next(workers)) is not None]
    assert len(handed) == most + 1
    chunks.take(answer(0))
    list(chunks.rows())
    assert chunks.next(workers) == [most + 1]
    assert chunks.next(workers) is None


def test_what_depends_on_rows_waits_for_them() -> None:
    waiting = plan_of(seeds=60, draw=[INERTIA], adaptive={"guide": "torque_rms_nm", "round_runs": 20})
    chunks = Chunks(waiting, range(18, 60))
    assert [chunks.next(1) for _ in range(3)] == [[18], [19], None]
    assert waiting.rounds is not None
    waiting.rounds.take({"run": number, "torque_rms_nm": 1.0, "passed": True} for number in range(20))
    assert [chunks.next(1) for _ in range(2)] == [[20], [21]]


def test_what_a_worker_left_comes_first() -> None:
    chunks = Chunks(plan(), range(4))
    first, second = chunks.next(2), chunks.next(2)
    assert first is not None
    assert second is not None
    chunks.put_back([first, second])
    assert [chunks.next(2) for _ in range(4)] == [[0], [1], [2], [3]]


@pytest.mark.parametrize("status", [2, 3])
def test_an_error_of_a_worker_is_raised_with_its_status(status: int) -> None:
    with pytest.raises(RunRefused, match="so it is") as caught:
        Chunks(plan(), range(1)).take({"error": "so it is", "status": status})
    assert caught.value.exit_status == status


WORKER = """
import json, os, signal, sys
from pathlib import Path

def tell(what):
    sys.stdout.write(json.dumps(what) + "\\n")
    sys.stdout.flush()

def first(name):  # whether this process is the first to come here
    try:
        (Path(__file__).parent / name).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True

asked = json.loads(sys.stdin.readline())
assert set(asked["identity"]) == {{"sweep", "program", "files"}} and os.path.isabs(asked["sweep"])
{before}
tell({{"ready": True}})
for line in sys.stdin:
    for number, drawn in json.loads(line):
        {each}
        tell({{"row": {{"run": number, "drawn": drawn, "by": os.getpid()}}, "took_ns": 10**9, "files": {{}}}})
"""
KILL = "os.kill(os.getpid(), signal.SIGKILL)"


@pytest.fixture
def workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Have other workers; all that were started are gone in the end."""
    started: list[pool.Worker] = []

    class Noted(pool.Worker):
        def __init__(self, plan: Any) -> None:
            super().__init__(plan)
            started.append(self)

    def put(before: str = "pass", each: str = "pass") -> list[pool.Worker]:
        program = tmp_path / "worker.py"
        program.write_text(WORKER.format(before=before, each=each))
        monkeypatch.setattr(
            pool, "python_command", lambda _module: [sys.executable, "-S", "-I", str(program)]
        )
        monkeypatch.setattr(pool, "Worker", Noted)
        return started

    yield put
    assert all(worker.process.returncode is not None for worker in started)
    assert all(worker.output.closed for worker in started)


def run(numbers: range, count: int, stop: StopRequest | None = None) -> list[dict[str, Any]]:
    return list(WorkerPool(plan(), count, stop or StopRequest()).rows(numbers))


def test_rows_of_several_workers_come_in_order(workers: Any) -> None:
    started = workers()
    rows = run(range(3, 15), 2)
    planned = plan()
    assert [(row["run"], row["drawn"]) for row in rows] == [
        (number, json.loads(json.dumps(planned.drawn(number)))) for number in range(3, 15)
    ]
    assert len(started) == 2
    assert {row["by"] for row in rows} <= {worker.process.pid for worker in started}


def test_no_more_workers_are_started_than_there_are_runs(workers: Any) -> None:
    started = workers()
    assert len(run(range(1), 4)) == 1
    assert len(started) == 1


def test_the_run_of_a_worker_that_was_killed_is_run_again(workers: Any) -> None:
    started = workers(each=f"if number == 2 and first('killed'): {KILL}")
    assert [row["run"] for row in run(range(5), 1)] == [0, 1, 2, 3, 4]
    assert len(started) == 2


def test_a_run_that_kills_three_workers_is_named(workers: Any) -> None:
    started = workers(each=f"if number == 1: {KILL}")
    with pytest.raises(WorkerDied, match="run 1: 3 workers died with it, with status -9"):
        run(range(4), 1)
    assert len(started) == 3


def test_a_worker_that_ends_before_it_is_ready_is_told_at_once(workers: Any) -> None:
    started = workers(before="sys.exit(5)")
    with pytest.raises(WorkerDied, match="a worker ended with status 5 before its first run"):
        run(range(4), 1)
    assert len(started) == 1


def test_workers_that_are_killed_before_they_are_ready_are_tried_thrice(workers: Any) -> None:
    started = workers(before=f"{KILL} if first('a') or first('b') else None")
    assert len(run(range(2), 1)) == 2
    assert len(started) == 3


def test_three_in_a_row_that_are_killed_at_their_start_are_no_accident(workers: Any) -> None:
    started = workers(before=KILL)
    with pytest.raises(
        WorkerDied, match="3 workers in a row died before their first run, the last with status -9"
    ):
        run(range(2), 1)
    assert len(started) == 3


def test_a_worker_that_is_ready_ends_a_row_of_lost_starts(workers: Any) -> None:
    """Two starts are lost, then a worker dies in its second run, then two starts more."""
    late = "(Path(__file__).parent / 'was ready').exists() and (first('c') or first('d'))"
    before = f"{KILL} if first('a') or first('b') or ({late}) else None"
    started = workers(before=before, each=f"if number == 1 and first('was ready'): {KILL}")
    assert [row["run"] for row in run(range(3), 1)] == [0, 1, 2]
    assert len(started) == 6


def test_who_asks_for_the_end_gets_it(workers: Any) -> None:
    workers()
    stop = StopRequest()
    stop.ask("SIGTERM")
    with pytest.raises(Interrupted, match="ended by SIGTERM"):
        run(range(100), 2, stop)


def test_workers_are_gone_once_no_more_rows_are_taken(workers: Any) -> None:
    workers()
    rows = (made := WorkerPool(plan(), 2, StopRequest())).rows(range(100))
    assert next(rows)["run"] == 0
    assert len(made.process_ids) == 2
    rows.close()
    assert made.process_ids == []


def test_one_worker_alone_is_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    class Here:
        def __init__(self, _plan: Any, stop: StopRequest) -> None:
            self.stop = stop

        def row(self, number: int) -> dict[str, Any]:
            if number == 7:
                self.stop.ask("the test")
            return {"run": number}

    monkeypatch.setattr(pool, "Workshop", Here)
    rows = rows_of(plan(), range(6, 10), 1, StopRequest())
    assert [next(rows)["run"], next(rows)["run"]] == [6, 7]
    with pytest.raises(Interrupted, match="ended by the test"):
        next(rows)

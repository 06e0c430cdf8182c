"""Runs in a thread that is not the main one: callers stop them, and however they end the drive rests."""

import json
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from servobench import Command, Context, Controller, SetPoint, TorqueSetPoint
from servobench.drivers.cia402.profile import State
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.bench import run_bench
from servobench.hil.machine.progress import Progress, no_progress
from servobench.hil.machine.stopping import StopRequest
from servobench.hil.verdict.summary import Summary
from tests.scenario.processes import EXAMPLES
from tests.swarm.witness import DriveWitness, witnessed

LIMIT_S = 60.0
TURNING_RAD_S = 50.0
REST_RAD_S = 1.0


@contextmanager
def running(
    folder: Path, progress: Progress, stop: StopRequest | None = None, controller: Controller | None = None
) -> Iterator[tuple[Future[Summary], list[DriveWitness]]]:
    """A run in a thread of its own, and the witnesses of its drives."""
    config = load_bench(EXAMPLES / "ling2012.toml")
    short = config.model_copy(update={"bench": config.bench.model_copy(update={"duration_s": 0.6})})
    drives: list[DriveWitness] = []
    with witnessed(drives), ThreadPoolExecutor(1) as pool:
        yield (
            pool.submit(
                run_bench,
                short,
                bus_spec=None,
                time=None,
                seed=None,
                record=folder,
                view=False,
                progress=progress,
                controllers=None if controller is None else {"axis1": controller},
                privileged=False,
                stop=stop,
            ),
            drives,
        )


def verdict_in(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "summary.json").read_text())["verdict"]
    return found


def assert_rests(drive: DriveWitness) -> None:
    seen = drive.testimony()
    assert abs(seen.speed_rad_s) < REST_RAD_S
    assert seen.states[-1][1] is State.SWITCH_ON_DISABLED


class Rendezvous:
    """Progress that stands still once, where another thread is to act."""

    def __init__(self, phase: str, elapsed_s: float) -> None:
        self._at = phase, elapsed_s
        self.reached, self.left = Event(), Event()

    def __call__(self, phase: str, elapsed_s: float) -> None:
        if not self.reached.is_set() and phase == self._at[0] and elapsed_s >= self._at[1]:
            self.reached.set()
            assert self.left.wait(LIMIT_S)


@pytest.mark.parametrize(("phase", "elapsed_s"), [("connecting", 0.0), ("enabling", 0.0), ("running", 0.3)])
def test_its_caller_stops_it(tmp_path: Path, phase: str, elapsed_s: float) -> None:
    stop, place = StopRequest(), Rendezvous(phase, elapsed_s)
    with running(tmp_path / "run", place, stop) as (run, drives):
        assert place.reached.wait(LIMIT_S)
        turning = abs(drives[0].testimony().speed_rad_s) > TURNING_RAD_S
        stop.ask()
        place.left.set()
        run.exception()
    assert turning is (phase == "running")
    verdict = verdict_in(tmp_path / "run")
    assert (verdict["outcome"], verdict["exit_status"]) == ("interrupted", 130)
    assert verdict["reason"] == "ended by its caller"
    assert_rests(drives[0])


class Raising(Controller):
    """A controller that turns the shaft until it raises."""

    def __init__(self, error: type[BaseException]) -> None:
        self._error = error

    def output(self, _context: Context) -> SetPoint:
        return TorqueSetPoint(1.0)

    def update(self, context: Context, _command: Command) -> None:
        if context.estimate.velocity_rad_s > TURNING_RAD_S:
            raise self._error


@pytest.mark.parametrize("error", [ZeroDivisionError, SystemExit])
def test_one_that_raises_leaves_its_drive_at_rest(tmp_path: Path, error: type[BaseException]) -> None:
    with running(tmp_path / "run", no_progress, controller=Raising(error)) as (run, drives):
        raised = run.exception()
    assert type(raised) is error
    assert verdict_in(tmp_path / "run")["exit_status"] == 70
    assert_rests(drives[0])

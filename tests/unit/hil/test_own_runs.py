"""Benches run from Python: by ``hil.run``, and by the fixture of the pytest plugin, on the simulated bus."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servobench import run
from servobench.drivers.errors import BadInput, BenchError, LimitExceeded
from servobench.hil.configuration.motor_file import LING2012, load_motor
from servobench.hil.machine.stopping import StopRequest
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.hosted import DriveHost

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("forked_children")]

EXAMPLES = Path(__file__).parents[3] / "examples"
BENCH = EXAMPLES / "ling2012.toml"
SHORT: dict[str, Any] = {
    "bench.duration_s": 0.1,
    "load.axis1": [],
    "reference.axis1": [{"at_s": 0.0, "kind": "step", "speed_rpm": 100.0}],
}
OTHER = EXAMPLES / "motors" / "azaiz2007.toml"


@pytest.fixture
def bench(tmp_path: Path) -> BenchRunner:
    return BenchRunner("simulated", DriveHost("simulated", tmp_path), tmp_path / "runs", EXAMPLES)


def test_runs_of_a_test_are_recorded_side_by_side(bench: BenchRunner, tmp_path: Path) -> None:
    first = bench(BENCH, SHORT, faults={}, seed=5)
    assert first.folder == tmp_path / "runs" / "run-1"
    assert (first.summary.seed, first.summary.cycles) == (5, 100)
    assert first.error is None
    assert first.summary.dropouts.total == 0, "without the faults of the file"
    with pytest.raises(AssertionError) as missed:
        bench(BENCH, SHORT, faults={}, ends_in=LimitExceeded)
    second = tmp_path / "runs" / "run-2"
    told = f"the run ended without an error, LimitExceeded expected\nrecording: {second}"
    assert str(missed.value) == told
    assert (second / "summary.json").exists()


def test_a_bench_is_put_together_as_the_test_says(bench: BenchRunner, tmp_path: Path) -> None:
    config = bench.load(BENCH, {"loop.deadline_us": 700})
    assert config.loop.deadline_us == 700
    assert "probability" in config.resolved_text()
    assert bench.load(BENCH, faults={}).faults is None
    plan = tmp_path / "plan.toml"
    plan.write_text("[[loss]]\nprobability = 0.25\n")
    for faults in (plan, {"loss": [{"probability": 0.25}]}):
        assert "probability = 0.25" in bench.load(BENCH, faults=faults).resolved_text()
    for motor in (OTHER, load_motor(OTHER)):
        config = bench.load(BENCH, motor=motor)
        assert config.drive["axis1"].motor == load_motor(OTHER)
    assert bench.load(BENCH).drive["axis1"].motor == LING2012


def test_tables_are_read_from_the_folder_of_the_test(bench: BenchRunner) -> None:
    tables = tomllib.loads(BENCH.read_text(encoding="utf-8"))
    tables["drive"]["axis1"]["motor"] = "motors/azaiz2007.toml"
    config = bench.load(tables)
    assert config.drive["axis1"].motor == load_motor(OTHER)
    assert tables["drive"]["axis1"]["motor"] == "motors/azaiz2007.toml", "the tables of the test stay"


def test_an_error_that_is_expected_comes_back_with_the_run(bench: BenchRunner, tmp_path: Path) -> None:
    nobodys: dict[str, Any] = {"axis9": object()}
    ended = bench(BENCH, SHORT, controllers=nobodys, ends_in=BadInput)
    assert isinstance(ended.error, BadInput)
    for expected in (LimitExceeded, None):
        with pytest.raises(BadInput, match="axis9") as caught:
            bench(BENCH, SHORT, controllers=nobodys, ends_in=expected)
    assert caught.value.__notes__ == [f"recording: {tmp_path / 'runs' / 'run-3'}"]


def test_a_run_is_kept_in_memory_if_no_recording_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[tuple[str, float]] = []
    done = run(BENCH, SHORT, seed=9, progress=lambda phase, at_s: seen.append((str(phase), at_s)))
    assert list(tmp_path.iterdir()) == []
    assert done.summary.cycles == 100
    assert done.summary.seed == 9
    assert len(done.wire.find("080#*", sent=True)) >= 100
    assert seen[-1][1] <= 0.1
    recorded = run(BENCH, SHORT, seed=9, record=True)
    assert recorded.summary.digest == done.summary.digest
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("ling2012-2")
    assert (folder / "summary.json").exists()


def test_functions_of_the_time_take_the_place_of_references() -> None:
    done = run(BENCH, SHORT, signals={"reference.axis1.speed_rpm": lambda at_s: 60.0 + 600.0 * at_s})
    reference = done.column("reference_rad_s")
    np.testing.assert_allclose(reference, 2 * np.pi * (1.0 + 10.0 * 1e-3 * np.arange(100)), rtol=1e-9)


def test_who_asks_for_the_end_gets_a_run_that_says_so() -> None:
    stop = StopRequest()
    stop.ask("the test")
    with pytest.raises(BenchError, match="ended by the test"):
        run(BENCH, SHORT, stop=stop)


def test_a_bus_in_real_time_needs_a_recording() -> None:
    with pytest.raises(BadInput, match="a folder: on a bus in real time another process records"):
        run(BENCH, SHORT, bus="hub:none")

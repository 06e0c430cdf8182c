"""Runs, campaigns and signals that a test asks for: what they are made of; with runs that are made up."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

import servobench
from servobench.drivers.errors import BadInput, BusDown, LimitExceeded
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.motor_file import LING2012, load_motor
from servobench.hil.machine.stopping import Interrupted, StopRequest
from servobench.hil.recording.recorder import recorder_of
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.testing import bench_runs, campaign_runs
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.campaign_runs import CampaignRunner
from servobench.hil.testing.signals import with_signals
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import Finding, VerdictKind
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.test_report import summary

pytestmark = pytest.mark.usefixtures("forked_children")

EXAMPLES = Path(__file__).parents[3] / "examples"
LING, THREE = EXAMPLES / "ling2012.toml", EXAMPLES / "three_axes.toml"


class Runs:
    """What was asked for, and how it ends."""

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        self.error: BaseException | None = None
        self.summary = summary()

    def __call__(self, config: Any, **asked: Any) -> Summary:
        self.asked.append({"config": config, **asked})
        if self.error is not None:
            raise self.error
        return self.summary


class Host:
    """Drives that are on the bus, and those that were started."""

    def __init__(self, *there: int) -> None:
        self.there = set(there)
        self.started: list[Any] = []

    def missing(self, nodes: list[int]) -> list[int]:
        return [node for node in nodes if node not in self.there]

    def start(self, nodes: list[int], wish: Any, loads: dict[int, str]) -> None:
        self.started.append((nodes, wish, loads))
        self.there |= set(nodes)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Runs:
    made = Runs()
    monkeypatch.setattr(bench_runs, "run_bench", made)
    monkeypatch.setattr("servobench.hil.execution.bench.run_bench", made)
    return made


def runner(tmp_path: Path, bus: str = "simulated", host: Host | None = None) -> BenchRunner:
    its: Any = host or Host()
    return BenchRunner(bus, its, tmp_path, EXAMPLES)


@pytest.mark.long
def test_a_run_is_asked_for_as_the_test_says(runs: Runs, tmp_path: Path) -> None:
    controllers: Any = {"axis1": object()}
    bench = runner(tmp_path)
    done = bench(LING, {"loop.deadline_us": 900}, seed=5, time="real", controllers=controllers)
    (asked,) = runs.asked
    assert asked.pop("config") == done.config
    assert done.config.loop.deadline_us == 900
    assert asked == {
        "bus_spec": "simulated",
        "time": "real",
        "seed": 5,
        "record": tmp_path / "run-1",
        "controllers": controllers,
        "privileged": False,
    }
    assert (done.folder, done.error) == (tmp_path / "run-1", None)
    assert bench(LING).folder == tmp_path / "run-2"


@pytest.mark.long
def test_an_error_passes_with_its_recording_or_is_the_one_expected(runs: Runs, tmp_path: Path) -> None:
    runs.error = BusDown("the bus is down")
    bench = runner(tmp_path)
    done = bench(LING, ends_in=BusDown)
    assert done.error is runs.error
    for number, expected in ((2, None), (3, LimitExceeded)):
        runs.error = BusDown("the bus is down")
        with pytest.raises(BusDown) as caught:
            bench(LING, ends_in=expected)
        assert caught.value.__notes__ == [f"recording: {tmp_path / f'run-{number}'}"]
    runs.error = None
    with pytest.raises(AssertionError) as missed:
        bench(LING, ends_in=BusDown)
    told = f"the run ended without an error, BusDown expected\nrecording: {tmp_path / 'run-4'}"
    assert str(missed.value) == told


def test_who_interrupts_a_run_interrupts_pytest(runs: Runs, tmp_path: Path) -> None:
    runs.summary = summary().also(Finding(VerdictKind.INTERRUPTED, "ended by SIGINT"))
    with pytest.raises(KeyboardInterrupt):
        runner(tmp_path)(LING)
    runs.error = Interrupted("ended by SIGINT")
    with pytest.raises(KeyboardInterrupt):
        runner(tmp_path)(LING, ends_in=Interrupted)


def test_parts_of_a_bench_are_put_in_its_place(tmp_path: Path) -> None:
    bench = runner(tmp_path)
    assert bench.load(LING, faults={}).faults is None
    assert bench.load(LING).faults is not None
    plan = tmp_path / "plan.toml"
    plan.write_text("[[loss]]\nprobability = 0.25\n")
    for faults in (plan, str(plan), {"loss": [{"probability": 0.25}]}):
        assert "probability = 0.25" in bench.load(LING, faults=faults).resolved_text()
    other = EXAMPLES / "motors" / "azaiz2007.toml"
    for motor in (other, load_motor(other)):
        drives = bench.load(THREE, motor=motor).drive
        assert {name: drive.motor for name, drive in drives.items()} == dict.fromkeys(
            drives, load_motor(other)
        )
        assert len(drives) == 3
    with pytest.raises(BadInput) as caught:
        bench.load(LING, faults=tmp_path / "none.toml")
    assert caught.value.source == "faults"
    tables = Bench.load(LING).tables
    named = {**tables, "drive": {"axis1": {**tables["drive"]["axis1"], "motor": "motors/azaiz2007.toml"}}}
    assert bench.load(named).drive["axis1"].motor == load_motor(other)


@pytest.mark.usefixtures("runs")
def test_drives_that_are_not_there_are_started_by_motor(tmp_path: Path) -> None:
    """That of axis2 turns a motor of its own."""
    own = LING2012.model_dump(mode="json")
    own["mechanics"]["inertia_kg_m2"] = 0.0016
    ling = LING2012.model_dump(mode="json")
    motors = {"drive.axis1.motor": ling, "drive.axis2.motor": own, "drive.axis3.motor": ling}
    limits = {f"drive.{name}.limits.torque_max_nm": 5.0 for name in ("axis1", "axis2", "axis3")}
    changes = {**motors, **limits, "bench.seed": 7, "bus.bitrate_bit_s": 800_000}
    host = Host()
    config = runner(tmp_path, "hub:x", host)(THREE, changes).config
    nodes = {name: drive.node for name, drive in config.drive.items()}
    assert [started[0] for started in host.started] == [[nodes["axis1"], nodes["axis3"]], [nodes["axis2"]]]
    assert [wish.motor for _, wish, _ in host.started] == [
        config.drive[name].motor for name in ("axis1", "axis2")
    ]
    assert [(wish.seed, wish.bitrate_bit_s) for _, wish, _ in host.started] == [(7, 800_000)] * 2
    runner(tmp_path / "again", "hub:x", host)(THREE, changes)
    assert len(host.started) == 2, "they are there by now"
    some = Host(nodes["axis1"], nodes["axis2"])
    runner(tmp_path / "some", "hub:x", some)(THREE, changes)
    assert [started[0] for started in some.started] == [[nodes["axis3"]]]
    simulated = Host()
    runner(tmp_path / "simulated", "simulated", simulated)(THREE, changes)
    assert simulated.started == [], "a simulated bus brings its own"


def test_loads_from_files_are_told_to_the_drives_that_bear_them(runs: Runs, tmp_path: Path) -> None:
    path = tmp_path / "load.csv"
    path.write_text("time_s,torque_nm\n0,0\n1,0.5\n")
    host = Host()
    load = [{"kind": "file", "path": str(path)}]
    config = runner(tmp_path, "hub:x", host)(THREE, {"load.axis2": load}).config
    assert len(runs.asked) == 1
    told = {node: Path(file) for _, _, loads in host.started for node, file in loads.items()}
    assert told == {config.drive["axis2"].node: path}


def signalled(signals: dict[str, Callable[[float], float]], **changes: Any) -> Any:
    short = {"bench.duration_s": 0.01, "load.axis1": [], "reference.axis1": []}
    bench = Bench.load(LING).changed({**short, **changes})
    return with_signals(bench, signals).config


def test_functions_of_the_time_are_asked_for_each_cycle_and_kept() -> None:
    asked: list[float] = []

    def speed(at_s: float) -> float:
        asked.append(at_s)
        return 100.0 * at_s

    config = signalled({"reference.axis1.speed_rpm": speed, "load.axis1.torque_nm": lambda _: 0.25})
    assert asked == pytest.approx([0.001 * cycle for cycle in range(11)])
    tables = [
        parquet.read_table(entries[0].path) for entries in (config.reference["axis1"], config.load["axis1"])
    ]
    assert [table.column_names for table in tables] == [["time_s", "speed_rpm"], ["time_s", "torque_nm"]]
    assert tables[0].column("speed_rpm").to_pylist() == pytest.approx([0.1 * cycle for cycle in range(11)])
    assert tables[1].column("torque_nm").to_pylist() == [0.25] * 11
    np.testing.assert_allclose(tables[1].column("time_s"), asked)
    slow = signalled(
        {"load.axis1.torque_nm": lambda _: 1}, **{"loop.period_us": 2000, "loop.deadline_us": 3500}
    )
    assert parquet.read_table(slow.load["axis1"][0].path).num_rows == 6


@pytest.mark.parametrize(
    "key", ["speed.axis1.speed_rpm", "reference.axis1", "reference.axis1.speed", "load.a.b.torque_nm", "load"]
)
def test_a_signal_is_named_by_table_axis_and_column(key: str) -> None:
    with pytest.raises(BadInput) as caught:
        signalled({key: lambda _: 0.0})
    error = caught.value
    assert (error.source, error.key, error.value) == ("signals", key, key)
    assert error.expected.startswith("reference.AXIS.COLUMN or load.AXIS.COLUMN, of the columns ")
    assert "speed_rpm" in error.expected


def test_campaigns_run_a_sweep_or_its_tables_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[Any] = []

    def run_campaign(sweep: Path, out: Path, workers: int) -> str:
        ran.append((sweep, out.name, workers))
        return "a campaign"

    monkeypatch.setattr(campaign_runs, "run_campaign", run_campaign)
    its = CampaignRunner(tmp_path, EXAMPLES)
    assert its("sweep.toml") == "a campaign"  # type: ignore[comparison-overlap]
    tables = {"campaign": {"name": "x", "bench": "ling2012.toml"}}
    its(tables, workers=3)
    assert ran == [("sweep.toml", "campaign-1", 1), (tmp_path / "sweep-2.toml", "campaign-2", 3)]
    assert (tmp_path / "sweep-2.toml").read_text() == f'[campaign]\nname = "x"\nbench = "{LING}"\n'
    assert tables["campaign"]["bench"] == "ling2012.toml", "the tables of the test stay"
    its({"campaign": "none"})
    assert (tmp_path / "sweep-3.toml").read_text() == 'campaign = "none"\n'


def test_a_bench_is_run_from_python_in_memory_or_recorded(runs: Runs, tmp_path: Path) -> None:
    stop, network = StopRequest(), tmp_path / "n.toml"
    done = servobench.run(
        LING,
        {"loop.deadline_us": 900},
        record=tmp_path / "run",
        seed=5,
        network=str(network),
        allow_uncertified=True,
        stop=stop,
        time="real",
        bus="simulated",
    )
    asked = runs.asked[0]
    assert asked["config"].loop.deadline_us == 900
    known = (
        "bus_spec",
        "time",
        "seed",
        "record",
        "keep",
        "network",
        "allow_uncertified",
        "privileged",
        "stop",
    )
    assert [asked[name] for name in known] == [
        "simulated", "real", 5, tmp_path / "run", True, network, True, False, stop,
    ]  # fmt: skip
    assert asked["recording"] is recorder_of
    assert (done.folder, done.summary) == (Path("runs/x"), runs.summary)


@pytest.mark.parametrize(("record", "keep"), [(True, True), (False, False)])
def test_a_folder_is_chosen_for_a_recording_that_names_none(
    runs: Runs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: bool, keep: bool
) -> None:
    made: list[MemoryRecorder] = []

    class Noted(MemoryRecorder):
        def __init__(self, plan: Any, keep_all: bool) -> None:
            assert keep_all
            self.plan = plan
            made.append(self)

    monkeypatch.setattr("servobench.hil.recording.run_recorder.MemoryRecorder", Noted)
    call = runs.__call__

    def run_bench(config: Any, **asked: Any) -> Summary:
        if not record:
            asked["recording"](plan_for(tmp_path))
        return call(config, **asked)

    monkeypatch.setattr("servobench.hil.execution.bench.run_bench", run_bench)
    done = servobench.run(LING, record=record)
    assert (runs.asked[0]["record"], runs.asked[0]["keep"], runs.asked[0]["network"]) == (None, keep, None)
    assert len(made) == (not record)
    assert vars(done)["_kept"] == (Path("runs/x") if record else made[0])


def test_in_real_time_a_run_needs_a_folder(runs: Runs) -> None:
    with pytest.raises(BadInput) as caught:
        servobench.run(LING, bus="hub:x")
    told = "a folder: on a bus in real time another process records"
    assert str(caught.value) == f"run: record: found False, expected {told}"
    assert runs.asked == []
    servobench.run(LING, record=True, bus="hub:x")
    assert SimpleNamespace(**runs.asked[0]).bus_spec == "hub:x"

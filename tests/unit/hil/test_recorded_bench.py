"""What a recording knows of its bench beforehand, all of it, and the files of the user that it keeps."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.configuration.bench_file import bench_from, load_bench
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.assembly import axis_code
from servobench.hil.execution.recorded_bench import keep_files, recording_plan, review_plan
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.rows.recording_plan import (
    AxisPlan,
    CertifiedPlan,
    ObservedDrive,
    ObservedSignal,
    PlannedSetPoint,
    RecordingPlan,
    ReviewPlan,
)
from servobench.hil.verdict.metrics import VerdictLimits
from tests.unit.hil.test_signal_file import written

EXAMPLES: Final = Path(__file__).parents[3] / "examples"
FIRST: Final = EXAMPLES / "first" / "bench.toml"


def bench(name: str, **tables: Any) -> BenchConfig:
    """An example of which some tables are others."""
    raw = tomllib.loads((EXAMPLES / name).read_text())
    return bench_from({**raw, **tables}, name, EXAMPLES)


def plan_of(config: BenchConfig, folder: Path | None = None, real_time: bool = False) -> RecordingPlan:
    return recording_plan(config, folder, axis_code(config, {}, real_time=False), {}, real_time=real_time)


def drives_of(config: BenchConfig, **changes: dict[str, Any]) -> BenchConfig:
    """``config`` with changed tables of its drives."""
    drives = dict(config.drive)
    for axis, change in changes.items():
        drives[axis] = drives[axis].model_copy(update=change)
    return config.model_copy(update={"drive": drives})


# ---- figures and verdict --------------------------------------------------------------------------------


def test_a_review_is_planned_by_the_limits_and_motors_of_the_axes() -> None:
    config = bench("three_axes.toml", verdict={"settling_ms": 120, "settling_band_percent": 3.0})
    certified = CertifiedPlan(1000, delay_us=700.0)

    def planned(name: str, torque_nm: float, speed_rpm: float, known: CertifiedPlan | None) -> AxisPlan:
        motor, speed = config.drive[name].motor.parameters, speed_rpm * RAD_S_PER_RPM
        most = torque_nm / motor.inertia_kg_m2
        return AxisPlan(name, most, motor.rated_torque_nm, known, torque_nm, speed, "speed", "cst")

    assert review_plan(config, {"axis2": certified}, real_time=True) == ReviewPlan(
        (
            planned("axis1", 5.0, 2500.0, None),
            planned("axis2", 5.0, 2500.0, certified),
            planned("axis3", 8.5, 1500.0, None),
        ),
        VerdictLimits(),
        Duration(120 * NS_PER_MS),
        3.0,
        Duration(NS_PER_MS),
    )


def test_a_drive_that_is_given_positions_is_reviewed_by_them() -> None:
    (axis,) = review_plan(load_bench(EXAMPLES / "position_csp.toml"), {}, real_time=False).axes
    assert (axis.quantity, axis.mode) == ("position", "csp")


@pytest.mark.parametrize(
    ("file", "certified", "smallest"),
    [
        (None, [None], None),
        (0.3, [None], 0.3),
        (None, [0.2, 0.1], 0.1),
        (0.3, [0.4], 0.3),
        (0.3, [None, 0.2], 0.2),
    ],
)
@pytest.mark.parametrize("real_time", [False, True])
def test_the_least_swing_of_torque_is_asked_and_compute_times_where_drives_wait(
    file: float | None, certified: list[float | None], smallest: float | None, real_time: bool
) -> None:
    verdict: dict[str, Any] = {"compute_us_max": 200.0, "dropouts_percent_max": 1.0}
    if file is not None:
        verdict["torque_rms_nm_max"] = file
    config = bench("three_axes.toml", verdict=verdict)
    plans = {
        f"axis{number}": CertifiedPlan(1000, torque_rms_nm_max=asked)
        for number, asked in enumerate(certified, start=1)
    }
    assert review_plan(config, plans, real_time=real_time).limits == VerdictLimits(
        dropouts_percent_max=1.0,
        compute_us_max=200.0 if real_time else None,
        torque_rms_nm_max=smallest,
    )


# ---- the recording --------------------------------------------------------------------------------------


@pytest.mark.parametrize("real_time", [False, True])
def test_the_plan_of_a_recording_is_its_bench_s(tmp_path: Path, real_time: bool) -> None:
    config = bench("two_segments.toml")
    plan = plan_of(config, tmp_path, real_time)
    assert plan == RecordingPlan(
        folder=tmp_path,
        name="two_segments",
        seed=5,
        bus="simulated",
        real_time=real_time,
        deadline=Duration(2 * NS_PER_MS),
        review=review_plan(config, {}, real_time=real_time),
        bench_toml=config.resolved_text(),
        frames=config.recording.frames,
        segments=("feed",),
        faults=config.faults is not None,
        period_us=1000,
        set_points=plan.set_points,
        channels={},
        observed={},
        sources="{}",
        notes=plan.notes,
    )
    assert replace(plan, folder=None, bench_toml="") == plan_of(config, None, real_time)


@pytest.mark.parametrize("struck", [False, True])
def test_whether_there_are_faults_is_known(struck: bool) -> None:
    config = bench("three_axes.toml")
    faults = bench("three_axes.toml", faults={"loss": [{"probability": 0.1}]}) if struck else config
    assert plan_of(faults).faults is struck


def test_code_of_ones_own_is_named_with_its_digest_and_channels() -> None:
    config = load_bench(FIRST)
    (axis,) = config.axes
    code = axis_code(config, {}, real_time=False)[axis]
    (own,) = code.own.values()
    plan = plan_of(config)
    assert json.loads(plan.sources) == {f"{axis}.controller": {"object": own.name, "blake2b": own.digest}}
    channels = tuple(code.controller.channels())
    assert plan.channels == ({axis: channels} if channels else {})


def test_objects_for_the_recording_alone_are_named_by_drive_and_segment() -> None:
    raw = tomllib.loads((EXAMPLES / "two_segments.toml").read_text())
    raw["drive"]["feed"]["observe"] = [
        {"object": "2101:1", "type": "int16", "name": "current d", "unit": "A", "scale": 0.01}
    ]
    config = bench_from(raw, "bench.toml", EXAMPLES)
    assert plan_of(config).observed == {
        "feed": ObservedDrive(2, 1, (ObservedSignal((0x2101, 1), "h", "current d", "A", 0.01),), 1_000_000)
    }


def test_notes_that_differ_are_told_of_each_axis() -> None:
    """Current loops where one is not a PI loop."""
    config = bench("three_axes.toml")
    hinf = load_bench(EXAMPLES / "azaiz2007_hinf.toml").drive["axis1"].current_control
    config = drives_of(config, axis2={"current_control": hinf})
    motors = {axis: config.drive[axis].motor.motor.name for axis in config.axes}
    assert plan_of(config).notes == {
        "bus": "simulated",
        "motor": ", ".join(f"{axis} {name}" for axis, name in motors.items()),
        "controller": "pid",
        "compensator": "arrival",
        "current loops": "axis1 -, axis2 q continuous, d continuous, axis3 -",
    }


# ---- set-points and files -------------------------------------------------------------------------------


def with_files(folder: Path) -> BenchConfig:
    speeds = written(folder / "speeds.csv", {"time_s": [0.0, 0.5], "speed_rpm": [0.0, 100.0]})
    torques = written(folder / "torques.csv", {"time_s": [0.0, 0.25], "torque_nm": [0.0, 0.5]})
    return bench(
        "ling2012.toml",
        reference={
            "axis1": [
                {"at_s": 0.1, "kind": "step", "speed_rpm": 50.0},
                {"at_s": 0.4, "kind": "file", "path": str(speeds)},
            ]
        },
        load={"axis1": [{"at_s": 0.2, "kind": "file", "path": str(torques)}]},
        verdict={},
    )


def test_set_points_are_told_in_their_order_with_the_ends_of_files(tmp_path: Path) -> None:
    assert plan_of(with_files(tmp_path)).set_points == (
        PlannedSetPoint(Duration(100 * NS_PER_MS), 0, "axis1: reference step to 50 r/min"),
        PlannedSetPoint(Duration(200 * NS_PER_MS), 0, "axis1: load torque of torques.csv, 2 points"),
        PlannedSetPoint(Duration(400 * NS_PER_MS), 0, "axis1: reference speed of speeds.csv, 2 points"),
        PlannedSetPoint(Duration(450 * NS_PER_MS), 0, "axis1: load of torques.csv ends"),
        PlannedSetPoint(Duration(900 * NS_PER_MS), 0, "axis1: reference of speeds.csv ends"),
    )


def test_files_of_references_and_loads_are_kept_under_names_of_the_recording(tmp_path: Path) -> None:
    config = with_files(tmp_path)
    folder = tmp_path / "run"
    folder.mkdir()
    code = axis_code(config, {}, real_time=False)
    keep_files(config, code, folder)
    kept = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert kept == {
        "axis1-reference-1.csv": (tmp_path / "speeds.csv").read_bytes(),
        "axis1-load-0.csv": (tmp_path / "torques.csv").read_bytes(),
    }
    recorded = tomllib.loads(plan_of(config, folder).bench_toml)
    assert [entry.get("path") for entry in recorded["reference"]["axis1"]] == [None, "axis1-reference-1.csv"]
    assert [entry.get("path") for entry in recorded["load"]["axis1"]] == ["axis1-load-0.csv"]


def test_a_file_that_cannot_be_kept_fails_the_recording(tmp_path: Path) -> None:
    config = with_files(tmp_path)
    code = axis_code(config, {}, real_time=False)
    with pytest.raises(RecordingFailed) as caught:
        keep_files(config, code, tmp_path / "nowhere")
    gone = tmp_path / "nowhere" / "axis1-reference-1.csv"
    assert str(caught.value) == f"not recorded: {gone}: No such file or directory"

"""Loads from files and functions: on the shaft without a frame, from the run's first SYNC on."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from servobench import Bench, Run, run
from servobench.drivers.errors import BadInput
from tests.recorded_frames import candump_text
from tests.scenario.processes import EXAMPLES, hub_name, run_command, simulated_drive
from tests.warm.start import hil

LING = EXAMPLES / "ling2012.toml"
TIMES_S = np.arange(0.0, 0.8, 0.0005)


def torque_nm(time_s: float) -> float:
    """A load that no step comes near."""
    return float(0.4 * np.sin(2.0 * np.pi * 3.0 * time_s) * min(time_s / 0.3, 1.0))


def written(path: Path, torques: Sequence[float], times_s: Sequence[float] = tuple(TIMES_S)) -> Path:
    parquet.write_table(pa.table({"time_s": list(times_s), "torque_nm": list(torques)}), path)
    return path


def bench(load: list[dict[str, object]], **changes: object) -> Bench:
    base = {"bench.duration_s": 0.8, "faults": None, "load.axis1": load, "verdict": None}
    return Bench.load(LING).changed(base | changes)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("loads")
    path = written(folder / "load.parquet", [torque_nm(time) for time in TIMES_S])
    found = run(bench([{"kind": "file", "path": str(path)}]), record=folder / "run")
    path.unlink()
    return found


def test_no_frame_carries_it(recorded: Run) -> None:
    """SDO requests to node 1 from the first cycle to the last, by the recorded frames alone."""
    lines = re.findall(r"\(([\d.]+)\) \S+ 601#(\w+)", candump_text(recorded.folder))
    asked = [data for at, data in lines if 0.0 < float(at) - 1e9 < 0.8]
    assert not [data for data in asked if data[2:6] == "0021"]
    before = [data for at, data in lines if float(at) - 1e9 <= 0.0 and data[2:8] == "002103"]
    assert [data[8:10] for data in before] == ["00", "01"], "taken off, and begun once"


def test_the_shaft_bears_it(recorded: Run) -> None:
    """J domega/dt = T - load - B omega - friction: what is left of the load after the other terms."""
    axis = recorded.axis()
    motor = recorded.config.drive["axis1"].motor.parameters
    time, speed = axis.time_s, recorded.column("velocity_rad_s")
    inside = (time > 0.3) & (time < 0.75)
    wanted = np.array([torque_nm(at) for at in time])
    torque = recorded.column("torque_nm")
    rest = torque - motor.viscous_friction_nm_s * speed - motor.coulomb_friction_nm * np.sign(speed)
    inertial = motor.inertia_kg_m2 * np.gradient(speed, time)
    smooth = np.convolve(rest - inertial, np.ones(21) / 21, "same")
    error = (smooth - wanted)[inside]
    assert float(np.sqrt(np.mean(error**2))) < 0.03
    assert float(np.corrcoef(smooth[inside], wanted[inside])[0, 1]) > 0.99
    np.testing.assert_allclose(axis.load_nm, wanted, atol=1e-4)


def test_the_recording_repeats_its_run_without_the_file(recorded: Run, tmp_path: Path) -> None:
    again = run(recorded.folder / "bench.toml", record=tmp_path / "again")
    assert again.digest == recorded.digest
    assert (recorded.folder / "axis1-load-0.parquet").exists()


def test_a_held_step_from_a_file_is_the_step_of_the_bench(tmp_path: Path) -> None:
    """But for the SDO on its way: the speed errors differ by less than a period makes."""
    path = written(tmp_path / "step.parquet", [0.0, 0.5], [0.0, 0.3])
    by_file = run(bench([{"kind": "file", "path": str(path), "between": "held", "at_s": 0.2}]))
    by_step = run(bench([{"at_s": 0.5, "torque_nm": 0.5}]))
    peaks = [found.axis() for found in (by_file, by_step)]
    errors = [np.abs(axis.reference_rad_s - found.column("velocity_rad_s"))[axis.time_s > 0.5]
              for axis, found in zip(peaks, (by_file, by_step), strict=True)]  # fmt: skip
    assert float(np.nanmax(errors[0])) == pytest.approx(float(np.nanmax(errors[1])), rel=0.1)
    assert by_file.axis().load_nm[499] == 0.0
    assert by_file.axis().load_nm[501] == 0.5


def test_functions_are_files_that_were_asked_before(recorded: Run) -> None:
    asked: list[float] = []

    def load(time_s: float) -> float:
        asked.append(time_s)
        return torque_nm(time_s)

    signals = {"load.axis1.torque_nm": load, "reference.axis1.speed_rpm": lambda time_s: 500.0 * time_s}
    found = run(bench([]), signals=signals)
    assert asked == pytest.approx([cycle * 1e-3 for cycle in range(801)])
    np.testing.assert_allclose(found.axis().load_nm, recorded.axis().load_nm, atol=1e-3)
    np.testing.assert_allclose(found.axis().reference_rad_s, 500.0 / 9.5493 * found.axis().time_s, atol=1e-3)


@pytest.mark.parametrize(
    "key", ["load.axis1", "torque.axis1.torque_nm", "load.axis1.torque", "a.b.c.torque_nm"]
)
def test_a_function_of_nothing_is_refused(key: str) -> None:
    with pytest.raises(BadInput, match=re.escape(key)):
        run(bench([]), signals={key: torque_nm})


@pytest.mark.parametrize(
    ("columns", "more", "changes", "key"),
    [
        ({"speed_rpm": [0.0, 1.0]}, [], {}, "load.axis1[0].path"),
        ({"torque_nm": [0.0, 99.0]}, [], {}, "load.axis1[0].path"),
        ({"torque_nm": [0.0, 0.1]}, [{"at_s": 0.5, "torque_nm": 0.1}], {}, "load.axis1[0]"),
        ({"torque_nm": [0.0, 0.1]}, [], {"loop.sync": "foreign"}, "loop.sync"),
    ],
)
def test_what_no_shaft_can_bear_is_refused(
    tmp_path: Path, columns: dict[str, list[float]], more: list[dict[str, object]],
    changes: dict[str, object], key: str,
) -> None:  # fmt: skip
    path = tmp_path / "load.parquet"
    parquet.write_table(pa.table({"time_s": [0.0, 0.1], **columns}), path)
    with pytest.raises(BadInput, match=re.escape(key)):
        _ = bench([{"kind": "file", "path": str(path)}, *more], **changes).config


@pytest.mark.xdist_group("real time")
class TestInAnotherProcess:
    def run_on(self, bus: str, folder: Path) -> tuple[int, str, str]:
        resolved = bench([{"kind": "file", "path": str(folder / "load.parquet")}]).config.resolved_text()
        (folder / "bench.toml").write_text(resolved)
        command = [
            *hil(),
            "run",
            str(folder / "bench.toml"),
            "--bus",
            bus,
            "--record",
            str(folder / "run"),
            "--json",
        ]
        done = run_command(command)
        return done.returncode, done.stdout, done.stderr

    def test_the_drive_has_the_file_and_begins_with_the_first_sync(self, tmp_path: Path) -> None:
        path, bus = (
            written(tmp_path / "load.parquet", [torque_nm(time) for time in TIMES_S]),
            hub_name("loads"),
        )
        with simulated_drive(bus, "--load", f"1={path}"):
            code, _, said = self.run_on(bus, tmp_path)
        assert code in (0, 6), said  # a machine that is late is judged elsewhere
        lines = candump_text(tmp_path / "run")
        assert re.findall(r" 601#2F002103(..)", lines) == ["00", "01", "00"], "taken off, begun, taken off"
        told = Run(bench([]).config, tmp_path / "run")
        error = told.axis().reference_rad_s - told.column("velocity_rad_s")
        assert float(np.nanstd(error[told.axis().time_s > 0.4])) > 0.8, "1.8 rad/s under it, 0.17 without"

    def test_a_drive_with_another_file_is_refused_before_anything_moves(self, tmp_path: Path) -> None:
        written(tmp_path / "load.parquet", [torque_nm(time) for time in TIMES_S])
        bus = hub_name("no-load")
        with simulated_drive(bus):
            code, _, said = self.run_on(bus, tmp_path)
        assert code == 2
        assert "hil simulate --load 1=" in said


def test_a_file_for_no_node_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "load.parquet", [0.0, 0.1], [0.0, 0.1])
    for text in (f"2={path}", str(path), "1="):
        done = run_command([*hil(), "simulate", "--bus", hub_name("none"), "--node", "1", "--load", text])
        assert done.returncode == 2
        assert "--load" in done.stderr

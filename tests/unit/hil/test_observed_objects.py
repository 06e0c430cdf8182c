"""What a drive tells for the recording alone: the frames by python-can's reader, the motor's laws."""

import tomllib
from pathlib import Path
from struct import unpack
from typing import Any

import can
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from servobench import Run, run
from servobench.hil.cli import app
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.motor_file import LING2012
from tests.recorded_frames import candump
from tests.rrd_columns import numbers

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("forked_children")]

EXAMPLES = Path(__file__).parents[3] / "examples"
MOTOR = LING2012.parameters
AMPERE_PER_THOUSANDTH = MOTOR.rated_current_a / 1000.0
CURRENTS = [
    {"object": "2101:1", "type": "int16", "name": "i_d", "scale": AMPERE_PER_THOUSANDTH, "unit": "A"},
    {"object": "2101:2", "type": "int16", "name": "i_q", "scale": AMPERE_PER_THOUSANDTH, "unit": "A"},
    {"object": "2101:3", "type": "int16", "name": "i_q demand", "scale": AMPERE_PER_THOUSANDTH, "unit": "A"},
    {"object": "2101:5", "type": "int16", "name": "v_q", "scale": 0.3, "unit": "V"},
]


def bench(observe: list[Any], **tables: Any) -> dict[str, Any]:
    drive = {
        "node": 1,
        "motor": str(EXAMPLES / "motors" / "ling2012.toml"),
        "observe": observe,
        "limits": {"speed_max_rpm": 3000.0, "torque_max_nm": 4.0},
        "controller": {"kind": "pid", "proportional_nm_s_rad": 0.12, "integral_nm_rad": 2.0}
        | {"derivative_nm_s2_rad": 0.0, "derivative_filter_s": 0.002, "feedforward_nm_s_rad": 0.00185},
    }
    return {
        "bench": {"name": "observed", "duration_s": 0.6, "seed": 1},
        "loop": {"period_us": 1000},
        "drive": {"axis1": drive | tables.pop("drive", {})},
        "reference": {"axis1": [{"at_s": 0.0, "kind": "ramp", "speed_rpm": 500.0, "over_s": 0.1}]},
        "load": {"axis1": [{"at_s": 0.3, "torque_nm": 1.0}]},
        **tables,
    }


def invoke(folder: Path, tables: dict[str, Any]) -> Result:
    path = folder / "bench.toml"
    path.write_text(toml_text(tables))
    return CliRunner().invoke(app, ["run", str(path), "--record", str(folder / "run")])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(bench(CURRENTS), record=tmp_path_factory.mktemp("observed") / "run")


def told(folder: Path, identifier: int, code: str) -> tuple[np.ndarray, np.ndarray]:
    """Instants (s, of the log) and contents of a node's frames, by python-can and struct."""
    with can.CanutilsLogReader(candump(folder)) as log:
        frames = [frame for frame in log if frame.arbitration_id == identifier]
    values = [unpack(code, frame.data) for frame in frames]
    return np.array([frame.timestamp for frame in frames]), np.array(values, float)


def test_the_page_has_what_the_frames_told(recorded: Run) -> None:
    folder = recorded.folder
    assert folder is not None
    stamps, values = told(folder, 0x481, "<hhhh")
    assert len(stamps) > 590
    for place, sub in enumerate((1, 2, 3, 5)):
        times, drawn = numbers(folder / "run.rrd", f"/axis1/observed/2101h_{sub}")
        np.testing.assert_allclose(times / 1e9, stamps - 1e9, atol=2e-6)
        np.testing.assert_allclose(drawn, values[:, place] * CURRENTS[place]["scale"], atol=1e-9)


def test_currents_and_voltage_are_those_of_the_motor(recorded: Run) -> None:
    """T = Kt i_q at each SYNC, and v_q = R i_q + n_p omega psi where nothing changes."""
    folder = recorded.folder
    assert folder is not None
    _, values = told(folder, 0x481, "<hhhh")
    _, torques = told(folder, 0x281, "<hih")
    count = min(len(values), len(torques))
    torque_nm = torques[-count:, 0] * MOTOR.rated_torque_nm / 1000.0
    i_d, i_q, wanted = values[-count:, :3].T * AMPERE_PER_THOUSANDTH
    resolution_nm = 0.5 * (
        MOTOR.rated_torque_nm / 1000.0 + AMPERE_PER_THOUSANDTH * MOTOR.torque_constant_nm_a
    )
    assert np.max(np.abs(torque_nm - MOTOR.torque_constant_nm_a * i_q)) <= 1.01 * resolution_nm
    assert np.ptp(i_q) > 2.0
    assert np.max(np.abs(i_d)) < 0.05 * np.max(np.abs(i_q))
    settled = slice(-120, -70)
    assert np.mean(i_q[settled]) == pytest.approx(np.mean(wanted[settled]), abs=0.02)
    rows = recorded.axis("axis1")
    speed = np.mean(rows.velocity_rad_s[-100:])
    expected = MOTOR.resistance_ohm * np.mean(i_q[settled]) + MOTOR.pole_pairs * speed * MOTOR.flux_linkage_wb
    assert np.mean(values[-count:, 3][settled]) * 0.3 == pytest.approx(expected, rel=0.01)


def test_standard_objects_need_neither_type_nor_unit(tmp_path: Path) -> None:
    tables = bench(["6079", "6078"], drive={"observe_every_cycles": 10})
    assert invoke(tmp_path, tables).exit_code == 0
    stamps, values = told(tmp_path / "run", 0x481, "<Ih")
    assert np.median(np.diff(stamps)) == pytest.approx(0.01, abs=1e-3)
    page = tmp_path / "run" / "run.rrd"
    _, volts = numbers(page, "/axis1/observed/6079h_0")
    np.testing.assert_allclose(volts, 300.0)
    _, percents = numbers(page, "/axis1/observed/6078h_0")
    np.testing.assert_allclose(percents, 0.1 * values[:, 1])
    kept = tomllib.loads((tmp_path / "run" / "bench.toml").read_text())["drive"]["axis1"]["observe"]
    assert [each["object"] for each in kept] == ["6079", "6078"]


@pytest.mark.parametrize(
    ("observe", "said"),
    [
        (["2101:1"], "drive.axis1.observe[0].type"),
        (["606C"], "an object that the loop does not read anyway"),
        (["6079", "6079"], "each object once"),
        (["60791"], "drive.axis1.observe"),
        (["6079", "6075", "6080"], "3 objects of 12 bytes"),
        ([{"object": "2101:1", "type": "text"}], "drive.axis1.observe"),
    ],
)
def test_what_cannot_be_is_refused_by_its_key(observe: list[Any], said: str, tmp_path: Path) -> None:
    done = invoke(tmp_path, bench(observe))
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"object": "3FFF", "type": "int16"}, "node 1: 3FFFh"),
        ({"object": "2101:1", "type": "int32"}, "2101h:01 has 2 bytes"),
        ({"object": "6075"}, "node 1 does not map 6075h"),
    ],
)
def test_what_the_drive_refuses_ends_the_run_before_it_is_enabled(
    entry: dict[str, Any], said: str, tmp_path: Path
) -> None:
    done = invoke(tmp_path, bench([entry]))
    assert done.exit_code == 3
    assert said in " ".join(done.output.split())
    _, words = told(tmp_path / "run", 0x201, "<Hh")
    assert not len(words), "no set-point was sent"


def test_without_a_tpdo_that_is_left_it_says_so(tmp_path: Path) -> None:
    tables = bench(["6079"], loop={"period_us": 1000, "command_readback": "event"})
    done = invoke(tmp_path, tables)
    assert done.exit_code == 2
    assert 'loop.command_readback = "sync"' in " ".join(done.output.split())


def test_a_recording_that_is_recovered_has_them_again(recorded: Run, tmp_path: Path) -> None:
    folder = recorded.folder
    assert folder is not None
    before = numbers(folder / "run.rrd", "/axis1/observed/2101h_2")
    for name in ("summary.json", "run.rrd"):
        (folder / name).rename(tmp_path / name)
    assert CliRunner().invoke(app, ["recover", str(folder)]).exit_code == 0
    times, values = numbers(folder / "run.rrd", "/axis1/observed/2101h_2")
    np.testing.assert_allclose(times, before[0], atol=1_000)
    np.testing.assert_array_equal(values, before[1])

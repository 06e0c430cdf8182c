"""Commissioning rehearsed by data sheets: some of the made-up ones; ``make rehearsals`` has them all."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.drivers.cia402.objects402 import Object, Unit, unit_word
from servobench.hil.cli import app
from servobench.hil.configuration.drive_file import load_drive_file
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.draws import few_of
from tests.motors import LING
from tests.rehearsals.__main__ import complaints
from tests.rehearsals.made_sheet import MadeSheet
from tests.rehearsals.rehearsal import contradictions, made_sheet, ran, rehearsed
from tests.rehearsals.traits import TRAITS

REFUSED = [
    "no 1016h",
    "6502h with homing only",
    "6502h with positions only, no 607Ah",
    "mappings fixed, no values",
    "no 606Ch",
    "6083h is 1 at most",
    "6081h is 2000 at most",
    "6048h is 5 at most",
    "no 606Ch+mappings fixed for speed",
    "no 1018h+one TPDO",
]
READY = [
    "no 1018h",
    "identity in [DeviceInfo]",
    "of node 32",
    "no 6502h",
    "6502h without torque",
    "6060h refuses a mode of 6502h",
    "6060h holds 9 for good",
    "no 6071h",
    "mappings fixed for speed",
    "no position unit",
    "608Fh is 1/1",
    "no 6061h+types fixed",
]


@pytest.mark.parametrize("case", few_of(REFUSED, 6))
def test_a_drive_that_cannot_be_served_is_refused_before_it_moves(case: str, tmp_path: Path) -> None:
    names = tuple(case.split("+"))
    sheet = made_sheet(names, tmp_path)
    result = rehearsed(sheet, tmp_path, last_step="enable")
    assert complaints(names, result) == []
    assert contradictions(sheet, result) == []


@pytest.mark.parametrize("case", few_of(READY, 6))
def test_an_odd_drive_is_set_up_and_enabled(case: str, tmp_path: Path) -> None:
    names = tuple(case.split("+"))
    assert all(not TRAITS[name].ends or TRAITS[name].mendable for name in names)
    sheet = made_sheet(names, tmp_path)
    result = rehearsed(sheet, tmp_path, last_step="enable")
    assert (result.reason, result.not_done, result.is_safe()) == ("", {}, True)
    assert contradictions(sheet, result) == []


def test_an_encoder_that_nobody_set_is_disbelieved_in_every_unit(tmp_path: Path) -> None:
    names = ("608Fh is 1/1, 6094h, 6097h", "6502h without torque")
    result = rehearsed(made_sheet(names, tmp_path), tmp_path, last_step="stop_proof")
    assert complaints(names, result) == [], "no unit of the velocity or the acceleration is found wrong"
    assert result.moved


@pytest.mark.parametrize("name", ["6087h is 1000 at most", "6083h is limited"])
def test_a_ramp_that_is_too_slow_is_set_before_the_first_motion(name: str, tmp_path: Path) -> None:
    result = rehearsed(made_sheet([name], tmp_path), tmp_path, last_step="stop_proof")
    assert complaints((name,), result) == []
    assert (result.reason, result.moved) == ("", True)


def test_the_greatest_quick_stop_that_a_drive_takes_is_in_what_it_leaves(tmp_path: Path) -> None:
    """And neither the value that it refused nor those by which the greatest was found."""
    result = rehearsed(made_sheet(["6085h is 1000 at most"], tmp_path), tmp_path, last_step="stop_proof")
    assert complaints(("6085h is 1000 at most",), result) == []
    [left] = [
        each for each in load_drive_file(tmp_path / "out" / "drive.toml").object if each.index == 0x6085
    ]
    assert left.bytes == "e8030000"


@pytest.mark.parametrize("names", few_of([("6085h is steep",), ("604Ah is steep",)], 1))
def test_a_quick_stop_steeper_than_the_motor_is_no_wrong_unit(names: tuple[str, ...], tmp_path: Path) -> None:
    """A stop by it lasts as long as torque and controller take: its unit shows by a gentler one."""
    sheet = made_sheet(names, tmp_path)
    result = rehearsed(sheet, tmp_path, last_step="stop_proof")
    assert complaints(names, result) == []
    assert result.moved


def test_a_drive_that_cuts_its_speeds_tells_no_inertia(tmp_path: Path) -> None:
    result = rehearsed(made_sheet(["607Fh is 70 r/min"], tmp_path), tmp_path, last_step="mechanics")
    assert result.reason == ""
    reason = result.not_done["mechanics"]
    assert reason.startswith("the shaft does not reach the speeds that the drive is given; 7.3")
    assert "607Fh = 70000" in reason


def test_a_ramp_is_made_steeper_where_the_shaft_does_not_move_by_its_unit(tmp_path: Path) -> None:
    """60AAh tells a unit a thousand times too great: 6083h = 7 is 0.7 rad/s^2, not 730."""

    def coarse(servo: SimulatedServo) -> None:
        word = servo.dictionary.variable(Object.SI_UNIT_ACCELERATION)
        word.show_instead(unit_word(3, Unit.REVOLUTION_PER_MINUTE, Unit.SECOND))

    result = rehearsed(made_sheet(["6083h is 0"], tmp_path), tmp_path, last_step="stop_proof", change=coarse)
    assert complaints(("6083h is 0",), result) == []
    assert result.moved


@pytest.mark.parametrize("period_us", few_of(["4000", "2000"], 1))
def test_the_own_loops_of_a_drive_are_no_load_that_drives_the_shaft(period_us: str, tmp_path: Path) -> None:
    """They turn it by pulses of torque that a reading of each cycle misses."""
    sheet = made_sheet(["6502h with interpolated position only"], tmp_path)
    result = rehearsed(sheet, tmp_path, ["--period-us", period_us], last_step="stop_proof")
    assert (result.reason, result.not_done, result.moved) == ("", {}, True)


MODES = {
    "6502h is 43h, 6060h 7": "velocity",
    "6502h with interpolated position only": "interpolated_position",
    "6502h with positions only": "profile_position",
}


@pytest.mark.parametrize("case", few_of([*MODES], 2))
def test_the_inertia_is_found_in_a_mode_of_speeds_or_positions(case: str, tmp_path: Path) -> None:
    """Against that of the simulated motor."""
    result = rehearsed(made_sheet([case], tmp_path), tmp_path, last_step="mechanics")
    assert complaints((case,), result) == []
    steps = json.loads((tmp_path / "out" / "figures.json").read_text())["steps"]
    figures = {step["name"]: step["figures"] for step in steps}
    assert figures["setup"]["mode"] == MODES[case]
    assert figures["mechanics"]["inertia_kg_m2"] == pytest.approx(LING.inertia_kg_m2, rel=0.01)


def test_a_unit_of_velocity_mode_that_is_another_is_found_before_anything_turns_fast(tmp_path: Path) -> None:
    """As of drives whose 604Ch means turns per second, and says 1/1."""

    def coarse(servo: SimulatedServo) -> None:
        servo.dictionary.variable(0x604C, 2).value = servo.dictionary.variable(0x604C, 2).default = 3
        servo.dictionary.variable(0x604C, 2).show_instead(1)

    case = "6502h with velocity mode only"
    result = rehearsed(made_sheet([case], tmp_path), tmp_path, last_step="mechanics", change=coarse)
    assert result.ended_in == "stop_proof"
    assert "604Ch says what a unit of 6042h is" in result.reason
    assert result.is_safe()


def test_a_drive_without_6084h_slows_down_by_6083h(tmp_path: Path) -> None:
    """CiA 402-2; a ramp of its own that nobody can see kept the shaft turning one way for both signs."""
    names = ("no 6084h",)
    result = rehearsed(made_sheet(names, tmp_path), tmp_path, last_step="polarity")
    assert complaints(names, result) == []


def test_a_whole_commissioning_by_a_data_sheet(tmp_path: Path) -> None:
    result = rehearsed(made_sheet(["608Fh is 2000"], tmp_path), tmp_path)
    assert complaints(("608Fh is 2000",), result) == []
    assert result.moved
    assert result.exit_code == 0
    bench = tmp_path / "out" / "bench.toml"
    (tmp_path / "made.eds").unlink()
    first = CliRunner().invoke(app, ["run", str(bench), "--record", str(tmp_path / "run"), "--json"])
    assert first.exit_code == 0, first.stderr
    again = CliRunner().invoke(app, ["run", str(tmp_path / "run" / "bench.toml"), "--no-record", "--json"])
    assert again.exit_code == 0, again.stderr
    assert json.loads(again.stdout)["digest"] == json.loads(first.stdout)["digest"]


@pytest.mark.parametrize(
    "case", few_of(["60C5h is tiny", "6502h is 43h, 6060h 7", "60C5h is 300 at most"], 2)
)
def test_a_drive_without_torque_mode_leaves_a_bench_that_runs(case: str, tmp_path: Path) -> None:
    """hil eds gives vl to commission the second and ip to run it, as of an iPOS; the first is run in csv,
    with a bound of acceleration that a run raises as its commissioning did; the third in csp, within its."""
    sheet = made_sheet([case], tmp_path)
    result = rehearsed(sheet, tmp_path)
    assert complaints((case,), result) == []
    assert contradictions(sheet, result) == []
    assert (tmp_path / "out" / "bench.toml").exists()
    assert ran(tmp_path) == ""


def test_all_that_neither_drive_nor_nameplate_tells_is_asked_for_at_once(tmp_path: Path) -> None:
    plate = tmp_path / "plate.toml"
    plate.write_text("[rating]\nspeed_rpm = 1500.0\n")
    sheet = made_sheet(["no position unit", "no 6076h"], tmp_path)
    result = rehearsed(sheet, tmp_path, ["--motor", str(plate)], last_step="enable")
    assert result.ended_in == "units"
    assert "does not tell its torque unit; the drive does not tell its position unit" in result.reason
    assert "rating.torque_nm" in result.reason
    assert "encoder.counts_per_revolution" in result.reason


def test_a_drive_with_units_of_its_maker_is_found_sound(tmp_path: Path) -> None:
    sheet = MadeSheet()
    sheet.by(0x1A3)
    sheet.set(0x1008, default="iPOS")
    sheet.drop(0x608F, 0x6090, 0x6092, 0x6096, 0x60A8, 0x60A9, 0x60AA)
    path = tmp_path / "made.eds"
    path.write_text(sheet.text())
    result = rehearsed(path, tmp_path, last_step="motion_units")
    (counts,) = result.faults
    assert "the nameplate's 65536 counts per turn are taken" in counts
    assert result.not_done == {}


def test_the_sheet_of_another_drive_is_refused(tmp_path: Path) -> None:
    made, other = tmp_path / "made", tmp_path / "other"
    made.mkdir()
    other.mkdir()
    path = made_sheet(["identity in [DeviceInfo]"], other)
    path.write_text(path.read_text().replace("ProductNumber=0xB22", "ProductNumber=0x999"))
    result = rehearsed(made_sheet([], made), made, ["--eds", str(path)], last_step="enable")
    assert result.ended_in == "identity"
    assert "product 00000999h; the drive says 00000B22h" in result.reason


@pytest.mark.parametrize(
    "options",
    [
        ["--bus", "hub:x", "--rehearse-eds", "made.eds"],
        ["--bus", "simulated", "--rehearse-eds", "made.eds", "--rehearse", "1"],
        ["--bus", "simulated", "--rehearse-eds", "missing.eds"],
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path: Path, options: list[str]) -> None:
    asked = ["commission", "--node", "1", "--yes", "--out", str(tmp_path), *options]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 2
    assert "made.eds" in done.stderr or "missing.eds" in done.stderr or "--rehearse-eds" in done.stderr

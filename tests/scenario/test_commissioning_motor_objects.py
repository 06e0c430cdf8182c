"""Commissioning drives whose maker's objects tell of the motor; the simulated motor itself is the witness."""

import json
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import pytest

from servobench.drivers.canopen.objects301 import DataType
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.motor_file import LING2012, load_motor
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.unknown_drive import nameplate_of
from tests.rehearsals.made_sheet import MadeSheet
from tests.rehearsals.rehearsal import Rehearsal, rehearsed

U8, U16, I32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.INTEGER32
Objects = Mapping[int, Mapping[int, DataType]]
MOTOR = LING2012.parameters
PLATE = nameplate_of(MOTOR)
NOVANTA: tuple[int, Objects] = (0x29C, {0x2301: {0: U8}, 0x2701: {1: U16, 2: U16}})
SYNAPTICON: tuple[int, Objects] = (0x22D2, {0x2003: {1: U8, 2: I32, 3: I32, 4: I32}})
FESTO: tuple[int, Objects] = (0x1D, {0x604D: {0: U8}})


def tried(
    folder: Path,
    maker: tuple[int, Objects],
    plate: Mapping[str, Any] = PLATE,
    last_step: str = "units",
    change: Callable[[SimulatedServo], None] = lambda _servo: None,
    options: tuple[str, ...] = (),
) -> tuple[Rehearsal, dict[str, Any]]:
    """A commissioning up to ``last_step``, and its figures.json."""
    vendor, objects = maker
    sheet = MadeSheet()
    sheet.by(vendor)
    for index, types in objects.items():
        sheet.add(index, types)
    (folder / "made.eds").write_text(sheet.text())
    (folder / "plate.toml").write_text(toml_text(dict(plate)))
    given = ["--motor", str(folder / "plate.toml"), "--period-us", "4000", *options]
    done = rehearsed(folder / "made.eds", folder, given, last_step, change)
    return done, json.loads((folder / "out" / "figures.json").read_text())


def units(figures: Mapping[str, Any]) -> dict[str, Any]:
    """The step that reads the units and the motor."""
    return cast(dict[str, Any], next(step for step in figures["steps"] if step["name"] == "units"))


def wrong(index: int, sub: int, value: int) -> Callable[[SimulatedServo], None]:
    """The drive was told something else."""

    def change(servo: SimulatedServo) -> None:
        variable = servo.dictionary.variable(index, sub)
        variable.default = variable.value = value

    return change


def without(*names: str) -> dict[str, Any]:
    """The plate, less of its [motor]."""
    return {**PLATE, "motor": {key: value for key, value in PLATE["motor"].items() if key not in names}}


@pytest.mark.parametrize("maker", [NOVANTA, SYNAPTICON], ids=["between lines", "of a phase"])
def test_what_the_plate_lacks_is_told_by_the_drive(tmp_path: Path, maker: tuple[int, Objects]) -> None:
    lacking = without("resistance_ohm", "inductance_d_h", "inductance_q_h", "pole_pairs")
    done, figures = tried(tmp_path, maker, lacking)
    assert not done.reason
    told = units(figures)["figures"]["told_by_drive"]
    assert told["pole_pairs"]["value"] == MOTOR.pole_pairs
    assert told["resistance_ohm"]["value"] == pytest.approx(MOTOR.resistance_ohm, rel=1e-3)
    assert told["inductance_q_h"]["value"] == pytest.approx(MOTOR.inductance_q_h, rel=1e-3)
    if maker is NOVANTA:
        assert told["resistance_ohm"]["raw"] == round(2000 * MOTOR.resistance_ohm), "mOhm between two phases"
    header = figures["header"]["not measurable over CiA 402"]
    assert header["resistance"].startswith("2.875 ohm, told by the drive: object 2")
    assert not [each for each in units(figures)["quantities"] if each["name"] in header], "told, not measured"
    page = (tmp_path / "out" / "report.html").read_text()
    assert "told by the drive: object" in page
    assert "and by nobody else" in page


def test_poles_are_read_as_pairs(tmp_path: Path) -> None:
    _, figures = tried(tmp_path, FESTO)
    told = units(figures)["figures"]["told_by_drive"]["pole_pairs"]
    assert (told["raw"], told["value"]) == (2 * MOTOR.pole_pairs, MOTOR.pole_pairs)
    assert units(figures)["figures"]["pole_pairs_confirmed"] is True


def test_a_peak_current_of_6075h_is_no_fault_and_the_torque_constant_is_per_ampere_rms(
    tmp_path: Path,
) -> None:
    """Novanta's 6075h is the peak: taken as rms, it would make a fault and a constant of 0.707 times."""
    _, figures = tried(tmp_path, NOVANTA, without("pole_pairs"), last_step="voltage_constant")
    rms = MOTOR.rated_torque_nm / (MOTOR.rated_current_a / math.sqrt(3.0))
    steps = {step["name"]: step for step in figures["steps"]}
    assert units(figures)["figures"]["told_by_drive"]["rated_current_a"]["raw"] == pytest.approx(
        1000 * math.sqrt(2.0) * MOTOR.rated_current_a / math.sqrt(3.0), abs=1
    )
    assert steps["torque_constant"]["figures"]["torque_constant_nm_a"] == pytest.approx(rms, rel=0.01)
    assert not [fault for step in figures["steps"] for fault in step["faults"]]
    motor = load_motor(tmp_path / "out" / "motor.toml").parameters
    assert motor.pole_pairs == MOTOR.pole_pairs
    assert motor.torque_constant_nm_a == pytest.approx(rms / math.sqrt(2.0), rel=0.01)
    text = (tmp_path / "out" / "motor.toml").read_text()
    assert "Not measured: pole pairs, told by the drive: object 2301h:00 = 4 (novanta_emcl.toml)." in text
    assert "by the nameplate: resistance, inductance." in text


@pytest.mark.parametrize(
    ("maker", "index", "sub", "value", "said"),
    [
        (SYNAPTICON, 0x2003, 1, 2, "pole pairs: the nameplate says 4, the drive 2 (2003h:01"),
        (FESTO, 0x604D, 0, 4, "pole pairs: the nameplate says 4, the drive 2 (604Dh:00"),
        (SYNAPTICON, 0x2003, 3, 28_750_000, "resistance: the nameplate says 2.875 ohm, the drive 28.75 ohm"),
        (SYNAPTICON, 0x2003, 3, 5_750_000, "between two lines taken for a phase"),
    ],
    ids=["pole pairs", "poles", "ten times", "lines for phase"],
)
def test_a_plate_that_the_drive_contradicts_is_refused_before_anything_moves(
    tmp_path: Path, maker: tuple[int, Objects], index: int, sub: int, value: int, said: str
) -> None:
    done, figures = tried(tmp_path, maker, change=wrong(index, sub, value), last_step="mechanics")
    assert done.ended_in == "units"
    assert said in done.reason
    assert "--trust-nameplate" in done.reason
    assert not done.moved
    trusted = tmp_path / "trusted"
    trusted.mkdir()
    done, figures = tried(trusted, maker, change=wrong(index, sub, value), options=("--trust-nameplate",))
    assert not done.reason
    assert ["is not believed: the nameplate says" in fault for fault in done.faults] == [True]
    assert figures["header"]["nameplate"]["motor"]["pole_pairs"] == MOTOR.pole_pairs


def test_without_its_objects_the_words_are_those_for_any_drive(tmp_path: Path) -> None:
    done, figures = tried(tmp_path, (0x29C, {}))
    lines = units(figures)["lines"]
    assert "motor data of novanta_emcl.toml: the drive has no 2301h:00, so none of them" in lines
    assert "pole pairs: not measurable over CiA 402; 4, by the nameplate file alone" in lines
    assert figures["header"]["not measurable over CiA 402"].startswith("resistance, inductance, pole pairs:")
    assert "told_by_drive" not in units(figures)["figures"]
    assert not done.reason


def test_a_rated_torque_in_its_makers_unit_is_that_of_the_motor_which_turns(tmp_path: Path) -> None:
    """maxon's 6076h is in uN m (maxon_epos4.toml); a sheet's own value is of the motor in its maker's DCF."""
    sheet = MadeSheet()
    sheet.by(0xFB)
    sheet.set(0x1008, default="EPOS4")
    sheet.set(0x6076, default=512_871)
    (tmp_path / "made.eds").write_text(sheet.text())
    (tmp_path / "plate.toml").write_text(toml_text(PLATE))
    given = ["--motor", str(tmp_path / "plate.toml"), "--period-us", "4000"]
    done = rehearsed(tmp_path / "made.eds", tmp_path, given, last_step="motion_units")
    assert (done.reason, done.faults, done.not_done) == ("", [], {})
    figures = json.loads((tmp_path / "out" / "figures.json").read_text())
    pulses = next(step for step in figures["steps"] if step["name"] == "motion_units")
    inertia = re.search(r"inertia ([0-9.e-]+) kg m", " ".join(pulses["lines"]))
    assert inertia is not None
    assert float(inertia[1]) == pytest.approx(MOTOR.inertia_kg_m2, rel=0.1), "of a few pulses"

"""Motor files: the examples, and what is refused."""

import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.design.mechanism import Side
from servobench.design.motor import Transform, motor_figures
from servobench.drivers.errors import BadInput
from servobench.hil.cli import app
from servobench.hil.configuration.config_files import BadInputs
from servobench.hil.configuration.motor_file import LING2012, MotorFile, load_motor
from servobench.virtual_bus.drive.mechanism import NO_FIELD, speed_without_load_rad_s

EXAMPLES = Path(__file__).parents[3] / "examples" / "motors"


def changed_motor(tmp_path: Path, old: str, new: str) -> Path:
    text = (EXAMPLES / "ling2012.toml").read_text()
    assert text.count(old) == 1
    path = tmp_path / "motor.toml"
    path.write_text(text.replace(old, new))
    return path


def test_ling2012_is_the_table_of_the_paper() -> None:
    motor = load_motor(EXAMPLES / "ling2012.toml").parameters
    assert motor.flux_linkage_wb == pytest.approx(math.sqrt(1.5) * 0.0816, rel=1e-6)
    assert motor.torque_constant_nm_a == pytest.approx(4 * math.sqrt(1.5) * 0.0816, rel=1e-6)
    assert motor.rated_speed_rad_s == pytest.approx(50 * math.pi)
    assert (motor.resistance_ohm, motor.inductance_d_h, motor.inertia_kg_m2) == (2.875, 0.0085, 0.0008)


def test_the_default_motor_is_the_example() -> None:
    assert load_motor(EXAMPLES / "ling2012.toml") == LING2012


def test_azaiz2007_is_the_section_of_the_paper() -> None:
    motor = load_motor(EXAMPLES / "azaiz2007.toml").parameters
    assert motor.transform is Transform.AMPLITUDE_INVARIANT
    assert motor.torque_constant_nm_a == pytest.approx(1.5 * 4 * 0.12)
    assert motor.rated_speed_rad_s == pytest.approx(230.0, rel=1e-4)
    assert (motor.inductance_d_h, motor.inductance_q_h) == (0.0014, 0.0028)


def test_speed_max_is_where_the_back_emf_meets_the_voltage_circle() -> None:
    motor = LING2012.parameters
    speed_rad_s = speed_without_load_rad_s(motor, NO_FIELD)
    assert motor.pole_pairs * speed_rad_s * motor.flux_linkage_wb == pytest.approx(300 / math.sqrt(2))


@pytest.mark.parametrize(
    ("old", "new", "key", "expected"),
    [
        ("pole_pairs = 4", "pole_pairs = 4.0", "motor.pole_pairs", "a whole number"),
        ("pole_pairs = 4", "pole_pairs = 0", "motor.pole_pairs", "a value > 0"),
        ("inertia_kg_m2 = 0.0008", "inertia_kg_m2 = nan", "mechanics.inertia_kg_m2", "a finite number"),
        ("resistance_ohm = 2.875", 'resistance_ohm = "2.875"', "motor.resistance_ohm", "a number"),
        ('"power_invariant"', '"peak"', "motor.transform", "'power_invariant' or 'amplitude_invariant'"),
        ("speed_rpm = 1500.0", "", "rating.speed_rpm", "rated speed, r/min"),
    ],
)
def test_a_bad_value_is_named(tmp_path: Path, old: str, new: str, key: str, expected: str) -> None:
    path = changed_motor(tmp_path, old, new)
    with pytest.raises(BadInput) as caught:
        load_motor(path)
    assert (caught.value.source, caught.value.key) == (str(path), key)
    assert expected in caught.value.expected


def test_a_unit_slip_is_named_with_the_converted_value(tmp_path: Path) -> None:
    path = changed_motor(tmp_path, "inductance_d_h = 0.0085", "inductance_d_mh = 8.5")
    with pytest.raises(BadInput) as caught:
        load_motor(path)
    assert caught.value.key == "motor.inductance_d_mh"
    assert "write inductance_d_h = 0.0085" in str(caught.value)


def test_all_faults_are_reported_together(tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    path.write_text("[motor]\nname = 3\n[mechanic]\n")
    with pytest.raises(BadInputs) as caught:
        load_motor(path)
    keys = [error.key for error in caught.value.errors]
    assert "motor.name" in keys
    assert "motor.pole_pairs" in keys
    assert "mechanic" in keys
    assert "mechanics" not in keys, "the misspelt table is not reported as missing as well"
    assert caught.value.exit_status == 2


COUPLED = """
[coupling]
inertia_ratio = 4.0
antiresonance_hz = 80.0
backlash_rad = 0.002

[friction]
side = "load"
breakaway_nm = 0.1

[[cogging]]
per_turn = 24
torque_nm = 0.02
"""


def coupled(tmp_path: Path, old: str = "", new: str = "") -> Path:
    text = (EXAMPLES / "ling2012.toml").read_text()
    path = tmp_path / "motor.toml"
    path.write_text(text + (COUPLED.replace(old, new) if old else COUPLED))
    return path


def test_a_coupling_parts_the_inertia_and_has_its_resonances(tmp_path: Path) -> None:
    motor = load_motor(coupled(tmp_path)).parameters
    assert motor.mechanism is not None
    shaft = motor.mechanism.coupling
    assert shaft is not None
    assert (shaft.motor_kg_m2, shaft.load_kg_m2) == pytest.approx((0.00016, 0.00064))
    assert shaft.stiffness_nm_rad == pytest.approx(0.00064 * (math.tau * 80.0) ** 2)
    assert shaft.resonance_hz == pytest.approx(80.0 * math.sqrt(5.0))
    assert motor.mechanism.friction is not None
    assert motor.mechanism.friction.side is Side.LOAD
    figures = motor_figures(motor)
    assert figures["resonance_hz"] == pytest.approx(80.0 * math.sqrt(5.0))
    assert figures["breakaway_percent_of_rated"] == pytest.approx(5.0)
    assert figures["cogging_percent_of_rated"] == pytest.approx(1.0)


PLACED = """
[load]
hanging_nm = 0.3

[load.arm]
torque_nm = 0.5
ratio = 20.0
phase_deg = 90.0

[load.table]
position_rad = [0.0, 3.0, 6.0]
speed_rpm = [-100.0, 100.0]
torque_nm = [[0.0, 0.1], [0.1, 0.4], [0.0, 0.1]]
repeats = true

[load.end_stops]
positive_rad = 200.0
stiffness_nm_rad = 80.0

[switches]
negative_rad = -9.0
home_from_rad = 1.0
home_to_rad = 2.0
bounce_us = 1000.0
"""


def placed(tmp_path: Path, old: str = "[load]", new: str = "[load]") -> Path:
    assert PLACED.count(old) == 1
    path = tmp_path / "motor.toml"
    path.write_text((EXAMPLES / "ling2012.toml").read_text() + PLACED.replace(old, new))
    return path


def test_a_load_and_its_switches_have_their_places(tmp_path: Path) -> None:
    written = load_motor(placed(tmp_path))
    motor = written.parameters
    assert motor.mechanism is not None
    load, switches = motor.mechanism.load, motor.mechanism.switches
    assert load is not None
    assert switches is not None
    assert load.arm is not None
    assert (load.hanging_nm, load.arm.ratio) == (0.3, 20.0)
    assert load.arm.phase_rad == pytest.approx(math.pi / 2)
    assert load.table is not None
    assert load.table.turns == pytest.approx((0.0, 3.0 / math.tau, 6.0 / math.tau))
    assert load.table.speeds_rad_s == pytest.approx((-100.0 * math.tau / 60.0, 100.0 * math.tau / 60.0))
    assert load.stops is not None
    assert load.stops.negative_turns is None
    assert load.stops.positive_turns == pytest.approx(200.0 / math.tau)
    assert switches.home_turns == pytest.approx((1.0 / math.tau, 2.0 / math.tau))
    assert switches.positive_turns is None
    figures = motor_figures(motor)
    assert figures["hanging_percent_of_rated"] == pytest.approx(15.0)
    assert figures["arm_percent_of_rated"] == pytest.approx(25.0)
    assert figures["arm_swings_hz"] == pytest.approx(math.sqrt(0.5 / 20.0 / 0.0008) / math.tau)
    assert figures["table_peak_percent_of_rated"] == pytest.approx(20.0)
    assert figures["stop_hz"] == pytest.approx(math.sqrt(80.0 / 0.0008) / math.tau)
    assert MotorFile.model_validate(written.tables) == written


@pytest.mark.parametrize(
    ("old", "new", "key", "expected"),
    [
        ("ratio = 20.0", "ratio = 0.0", "load.arm.ratio", "a value >= 0.001"),
        ("3.0, 6.0", "6.0, 3.0", "load.table", "position_rad rising"),
        ("[0.1, 0.4], ", "", "load.table", "torque_nm of 3 rows of 2, a row for each position"),
        ("[[0.0, 0.1]", "[[0.2, 0.1]", "load.table", "the last row of torque_nm as the first"),
        ("positive_rad = 200.0", "", "load.end_stops", "negative_rad, positive_rad or both"),
        (
            "= 200.0",
            "= 200.0\nnegative_rad = 201.0",
            "load.end_stops",
            "negative_rad below positive_rad = 200",
        ),
        ("rad = 80.0", "rad = 1e7", "load", "a frequency on the stop of at most 5000 Hz, this is 17794 Hz"),
        ("home_to_rad = 2.0", "", "switches", "home_from_rad and home_to_rad, or neither"),
        ("home_to_rad = 2.0", "home_to_rad = 0.5", "switches", "home_from_rad up to home_to_rad = 0.5"),
        ("bounce_us", "bounce_ms", "switches.bounce_ms", "bounce_us"),
    ],
)
def test_what_no_load_can_be_is_refused(tmp_path: Path, old: str, new: str, key: str, expected: str) -> None:
    with pytest.raises((BadInput, BadInputs)) as refused:
        load_motor(placed(tmp_path, old, new))
    assert str(tmp_path / "motor.toml") in str(refused.value)
    assert f": {key}: " in str(refused.value)
    assert expected in str(refused.value)


def test_a_design_says_that_it_knows_no_place(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["design", "pid", str(placed(tmp_path)), "--current-bandwidth-hz", "800"])
    assert done.exit_code == 0
    assert "a load that no place changes is assumed, arm, table, end_stops of [load] left out" in done.stderr


def test_a_rigid_motor_has_no_mechanism_and_its_tables_no_key_of_one(tmp_path: Path) -> None:
    assert LING2012.parameters.mechanism is None
    assert set(LING2012.tables) == {"motor", "mechanics", "rating"}
    written = load_motor(coupled(tmp_path))
    assert MotorFile.model_validate(written.tables) == written


@pytest.mark.parametrize(
    ("old", "new", "key", "expected"),
    [
        ("antiresonance_hz = 80.0", "", "coupling", "either antiresonance_hz or stiffness_nm_rad"),
        (
            "= 80.0",
            "= 80.0\nstiffness_nm_rad = 9.0",
            "coupling",
            "either antiresonance_hz or stiffness_nm_rad",
        ),
        ("= 80.0", "= 4000.0", "coupling", "a resonance of at most 5000 Hz, this is 8944 Hz"),
        ("antiresonance", "resonance", "coupling.resonance_hz", "antiresonance_hz"),
        ("per_turn = 24", "per_turn = 0", "cogging[0].per_turn", "a value >= 1"),
        ("[coupling]", "[coupler]", "coupler", "coupling"),
    ],
)
def test_what_no_coupling_can_be_is_refused(
    tmp_path: Path, old: str, new: str, key: str, expected: str
) -> None:
    with pytest.raises((BadInput, BadInputs)) as refused:
        load_motor(coupled(tmp_path, old, new))
    assert key in str(refused.value)
    assert expected in str(refused.value)


RUBBING = """
[friction]
breakaway_nm = 0.1
bristle_nm_rad = 50.0
bristle_damping_ratio = 0.5

[cogging_by_angle]
torque_nm = [0.0, 0.02, 0.0, -0.03]
per_turn = 6

[temperature]
winding_c = 20.0
magnet_c = 20.0
bearing_c = -10.0
viscous_percent_k = -1.5
"""


def rubbing(tmp_path: Path, old: str = "[friction]", new: str = "[friction]") -> Path:
    assert RUBBING.count(old) == 1
    path = tmp_path / "motor.toml"
    path.write_text((EXAMPLES / "ling2012.toml").read_text() + RUBBING.replace(old, new))
    return path


def test_bristles_cogging_by_angle_and_cold_bearings(tmp_path: Path) -> None:
    written = load_motor(rubbing(tmp_path))
    motor = written.parameters
    assert motor.mechanism is not None
    assert motor.mechanism.friction is not None
    assert motor.mechanism.friction.bristle_nm_rad == 50.0
    assert motor.mechanism.friction.bristle_nm_s(0.0008) == pytest.approx(math.sqrt(50.0 * 0.0008))
    assert motor.mechanism.cogging_points_nm == 6 * (0.0, 0.02, 0.0, -0.03)
    assert motor.heat is not None
    assert motor.heat.viscous_factor == pytest.approx(1.45)
    figures = motor_figures(motor)
    assert figures["bristles_slip_after_mrad"] == pytest.approx(2.0)
    assert figures["cogging_percent_of_rated"] == pytest.approx(1.5)
    assert MotorFile.model_validate(written.tables) == written


@pytest.mark.parametrize(
    ("old", "new", "key", "expected"),
    [
        ("= 50.0", "= 1e7", "friction", "a frequency on the bristles of at most 5000 Hz, this is 17794 Hz"),
        (
            "breakaway_nm = 0.1",
            "",
            "friction",
            "bristle_nm_rad with friction either way: breakaway_nm above 0",
        ),
        ("0.02, 0.0, -0.03", "", "cogging_by_angle.torque_nm", "2"),
        (
            "[friction]",
            "[[cogging]]\nper_turn = 24\ntorque_nm = 0.02\n[friction]",
            "cogging_by_angle",
            "either [[cogging]] or [cogging_by_angle]",
        ),
        ("= -10.0", "= 120.0", "temperature", "viscous_percent_k that leaves viscous friction at bearing_c"),
    ],
)
def test_what_no_friction_can_be_is_refused(
    tmp_path: Path, old: str, new: str, key: str, expected: str
) -> None:
    with pytest.raises((BadInput, BadInputs)) as refused:
        load_motor(rubbing(tmp_path, old, new))
    assert key in str(refused.value)
    assert expected in str(refused.value)

"""Motor files: the examples, and what is refused."""

import math
from pathlib import Path

import pytest

from servobench.design.motor import Transform
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_errors import BadInputs
from servobench.hil.configuration.motor_file import LING2012, load_motor, speed_max_rpm

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
    speed_rad_s = speed_max_rpm(motor) * math.tau / 60
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

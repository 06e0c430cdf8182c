"""Makers' published data sheets, entered by ``hil motor new`` as they stand; in a wrong convention refused.

maxon: EC 45 flat, 30 W, edition of May 2012, and EC 13, 6 W: terminals, currents of a six-step drive.
Siemens: configuration manual 1FT7 (PFT7S, 01/2009), table 4-8: one phase, currents and voltages rms. The
Hurst 300 is in tests/unit/design/test_data_sheet.py. DC buses: the nominal voltage; 600 V of a converter.
"""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from design.motor import PmsmParameters
from hil.cli import app
from hil.configuration.motor_file import load_motor

Words = dict[str, float]


def flat(volt: float, ohm: float, mh: float, mnm_a: float, rpm_v: float, tau_ms: float, mnm: float, a: float,
         rpm: float) -> Words:  # fmt: skip
    """A winding of maxon's EC 45 flat; its starting current bounds the peak."""
    return {
        "--pole-pairs": 8, "--r-line-ohm": ohm, "--l-line-mh": mh, "--kt-nm-adc": mnm_a * 1e-3,
        "--kv-rpm-vdc": rpm_v, "--inertia-kg-m2": 92.5e-7, "--rated-torque-nm": mnm * 1e-3,
        "--rated-speed-rpm": rpm, "--peak-current-apk": a, "--dc-bus-v": volt, "--tau-mechanical-ms": tau_ms,
    }  # fmt: skip


def ec13(volt: float, ohm: float, mh: float, mnm_a: float, rpm_v: float, tau_ms: float, mnm: float, a: float,
         rpm: float) -> Words:  # fmt: skip
    """A winding of maxon's EC 13."""
    more = {"--pole-pairs": 1, "--inertia-kg-m2": 0.165e-7}
    return flat(volt, ohm, mh, mnm_a, rpm_v, tau_ms, mnm, a, rpm) | more


SIEMENS = {
    "--poles": 6, "--r-phase-ohm": 0.61, "--l-phase-mh": 4.2, "--kt-nm-arms": 0.88, "--ke-line-vrms-krpm": 57,
    "--inertia-kg-m2": 5.43e-4, "--rated-torque-nm": 2, "--rated-speed-rpm": 6000,
    "--rated-current-arms": 2.5, "--peak-torque-nm": 23, "--peak-current-arms": 30, "--dc-bus-v": 600,
    "--tau-electrical-ms": 7, "--tau-mechanical-ms": 1.3,
}  # fmt: skip
SHEETS = {
    "maxon EC 45 flat 200142": flat(12, 1.2, 0.56, 25.5, 374, 17.1, 55.5, 10, 2940),
    "maxon EC 45 flat 339281": flat(24, 4.83, 2.24, 51, 187, 17.2, 55.3, 4.97, 2940),
    "maxon EC 45 flat 339282": flat(36, 6.69, 4.29, 70.6, 135, 12.4, 66.6, 5.22, 3290),
    "maxon EC 13 305190": ec13(6, 1.40, 0.0206, 1.93, 4950, 6.18, 2.2, 4.30, 20500),
    "maxon EC 13 305191": ec13(9, 2.48, 0.0416, 2.74, 3480, 5.46, 2.34, 3.62, 22700),
    "maxon EC 13 305192": ec13(12, 5.74, 0.0910, 4.05, 2360, 5.77, 2.3, 2.09, 19400),
    "maxon EC 13 305193": ec13(18, 13.2, 0.198, 5.98, 1600, 6.10, 2.23, 1.36, 19600),
    "maxon EC 13 305194": ec13(24, 24.6, 0.357, 8.03, 1190, 6.29, 2.19, 0.976, 19300),
    "Siemens 1FT7044-AK7": SIEMENS,
}


def entered(sheet: Words, path: Path, name: str = "published") -> tuple[int, str]:
    words = [str(word) for pair in sheet.items() for word in pair]
    done = CliRunner().invoke(app, ["motor", "new", str(path), "--name", name, *words])
    return done.exit_code, done.output


@pytest.mark.parametrize("name", SHEETS)
def test_a_published_sheet_agrees_with_itself(name: str, tmp_path: Path) -> None:
    sheet = SHEETS[name]
    status, said = entered(sheet, tmp_path / "motor.toml", name)
    assert status == 0, said
    motor = load_motor(tmp_path / "motor.toml").parameters
    assert motor.name == name
    assert motor.torque_max_nm > motor.rated_torque_nm
    # J R / K^2, K the torque per square root of the copper loss: what the sheet says of the finished motor
    told_s, seen_s = sheet["--tau-mechanical-ms"] * 1e-3, mechanical_time_s(motor)
    assert seen_s == pytest.approx(told_s, rel=0.12)


def mechanical_time_s(motor: PmsmParameters) -> float:
    per_phase_peak = motor.pole_pairs * motor.flux_linkage_wb
    if motor.torque_constant_nm_a < 1.4 * per_phase_peak:  # power invariant: fluxes are sqrt(3/2) larger
        per_phase_peak /= 1.5**0.5
    return motor.inertia_kg_m2 * motor.resistance_ohm / (1.5 * per_phase_peak**2)


def renamed(sheet: Words, old: str, new: str) -> Words:
    return {new if key == old else key: value for key, value in sheet.items()}


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        *((name, "--kt-nm-adc", "--kt-nm-arms", "kt_nm_arms") for name in SHEETS if "maxon" in name),
        ("maxon EC 45 flat 200142", "--r-line-ohm", "--r-phase-ohm", "of a phase and is between terminals"),
        ("maxon EC 13 305190", "--r-line-ohm", "--r-phase-ohm", "of a phase and is between terminals"),
        ("Siemens 1FT7044-AK7", "--kt-nm-arms", "--kt-nm-apk", "kt_nm_arms = 0.88"),
        ("Siemens 1FT7044-AK7", "--kt-nm-arms", "--kt-nm-adc", "kt_nm_adc = 0.88 and ke_"),
        ("Siemens 1FT7044-AK7", "--ke-line-vrms-krpm", "--ke-line-vpk-krpm", "ke_line_vrms_krpm = 57"),
        ("Siemens 1FT7044-AK7", "--ke-line-vrms-krpm", "--ke-phase-vrms-krpm", "ke_line_vrms_krpm = 57"),
        ("Siemens 1FT7044-AK7", "--r-phase-ohm", "--r-line-ohm", "between terminals and is of a phase"),
        ("Siemens 1FT7044-AK7", "--l-phase-mh", "--l-line-mh", "the other between terminals"),
        ("Siemens 1FT7044-AK7", "--rated-current-arms", "--rated-current-apk", "is an rms value"),
    ],
)
def test_a_figure_in_a_wrong_convention_is_refused_and_the_right_one_told(
    name: str, old: str, new: str, told: str, tmp_path: Path
) -> None:
    status, said = entered(renamed(SHEETS[name], old, new), tmp_path / "motor.toml")
    assert status == 2, said
    assert told in said
    assert not (tmp_path / "motor.toml").exists()

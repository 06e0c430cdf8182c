"""Makers' published data sheets, entered by ``hil motor new`` as they stand; in a wrong convention refused.

maxon: EC 45 flat, 30 W, edition of May 2012, and EC 13, 6 W: terminals, currents of a six-step drive.
Siemens: configuration manual 1FT7 (PFT7S, 01/2009), table 4-8: one phase, currents and voltages rms.
WITTENSTEIN: premo 320 V, manual 4022-D045530 rev. 02, table 16 (manualshive.com, premo-sp-series, page 30).
Beckhoff: the AM8122-0FH1's electronic nameplate, object 9009h (github.com/paulscherrerinstitute/ecmccfg,
hardware/Motors/ecmcEP7211-0034-Motor-Beckhoff-AM8122-0FH1-0000.cmd); R and L between terminals: 32C0:07.
HEIDENHAIN: SRP 5000, operating instructions 5/2017, 11.2 (manualslib.fr, Heidenhain-Srp-5000, page 37).
Teknic: Hudson manual rev. 1.21, appendix B (manualshive.com, teknic hudson-2311, page 23).
Kollmorgen: KBM(S)-88X00, as github.com/hakanpolat/IMMD has it (IMMD BAP/design/motor_sample.m).
The Hurst 300 is in tests/unit/design/test_data_sheet.py. DC buses: the nominal voltage; 600 V of a converter.
``not_told`` marks what is not on the page: made up, so that a motor file can be written.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.design.motor import PmsmParameters
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.hil.cli import app
from servobench.hil.configuration.motor_file import load_motor
from tests.draws import few_of

Words = dict[str, float | str]


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


SIEMENS: Words = {
    "--poles": 6, "--r-phase-ohm": 0.61, "--l-phase-mh": 4.2, "--kt-nm-arms": 0.88, "--ke-line-vrms-krpm": 57,
    "--inertia-kg-m2": 5.43e-4, "--rated-torque-nm": 2, "--rated-speed-rpm": 6000,
    "--rated-current-arms": 2.5, "--peak-torque-nm": 23, "--peak-current-arms": 30, "--dc-bus-v": 600,
    "--tau-electrical-ms": 7, "--tau-mechanical-ms": 1.3,
}  # fmt: skip


def premo(kt: float, ke: float, peak_nm: float, peak_a: float, nm: float, a: float, rpm: float, ohm: float,
          mh: float, tau_ms: float, inertia: float) -> Words:  # fmt: skip
    """A stator of WITTENSTEIN's premo; its rated point is the stall torque up to the no-load speed."""
    return {
        "--pole-pairs": 4, "--r-line-ohm": ohm, "--l-line-mh": mh, "--tau-electrical-ms": tau_ms,
        "--kt-nm-arms": kt, "--ke-line-vrms-krpm": ke, "--inertia-kg-m2": f"{inertia} kg cm2",
        "--rated-torque-nm": nm, "--rated-current-arms": a, "--rated-speed-rpm": rpm,
        "--peak-torque-nm": peak_nm, "--peak-current-arms": peak_a, "--dc-bus-v": 320,
    }  # fmt: skip


def not_told(sheet: Words, **figures: float) -> Words:
    return sheet | {"--" + key.replace("_", "-"): value for key, value in figures.items()}


def hudson(ohm: float, mh: float, tau_ms: float, ke: float, kt: float, torque: float) -> Words:
    """A winding of Teknic's Hudson: peak volts between terminals, oz in per ampere "p-p"."""
    return not_told({
        "--poles": 8, "--r-line-ohm": ohm, "--l-line-mh": mh, "--tau-electrical-ms": tau_ms,
        "--ke-line-vpk-krpm": ke, "--kt-nm-adc": f"{kt} oz-in", "--rated-torque-nm": f"{torque} oz-in",
    }, inertia_kg_m2=2e-5, rated_speed_rpm=1500, peak_torque_nm=4, dc_bus_v=75)  # fmt: skip


BECKHOFF = not_told({
    "--pole-pairs": 3, "--r-line-ohm": "1500 mohm", "--l-line-mh": 3.3, "--kt-nm-arms": "200 mNm",
    "--ke-line-vrms-krpm": "13 mV/rpm", "--inertia-kg-m2": "330 g cm2", "--peak-current-arms": 22.4,
    "--peak-torque-nm": "4060 mNm", "--dc-bus-v": 48,
}, rated_torque_nm=0.9, rated_speed_rpm=2000)  # fmt: skip
KOLLMORGEN: Words = {
    "--poles": 46, "--r-line-ohm": 0.46, "--l-line-mh": 4.5, "--kt-nm-arms": 5.06, "--ke-line-vrms-krpm": 306,
    "--inertia-kg-m2": 0.0526, "--rated-torque-nm": 102, "--rated-current-arms": 20.5,
    "--rated-speed-rpm": 1000, "--peak-torque-nm": 145, "--peak-current-arms": 48.3, "--friction-nm": 1.08,
    "--viscous-nm-krpm": 0.385, "--dc-bus-v": 600,
}  # fmt: skip
HEIDENHAIN = not_told({
    "--poles": 20, "--r-line-ohm": 9.06, "--l-line-mh": 2.42, "--kt-nm-arms": 0.668,
    "--ke-line-vrms-krpm": "0.397 V/(rad/s)", "--rated-torque-nm": 0.385, "--rated-current-arms": 0.688,
    "--rated-speed-rpm": 300, "--peak-torque-nm": 2.70, "--peak-current-arms": 4.24, "--dc-bus-v": 48,
}, inertia_kg_m2=1e-4)  # fmt: skip
SHEETS: dict[str, Words] = {
    "maxon EC 45 flat 200142": flat(12, 1.2, 0.56, 25.5, 374, 17.1, 55.5, 10, 2940),
    "maxon EC 45 flat 339281": flat(24, 4.83, 2.24, 51, 187, 17.2, 55.3, 4.97, 2940),
    "maxon EC 45 flat 339282": flat(36, 6.69, 4.29, 70.6, 135, 12.4, 66.6, 5.22, 3290),
    "maxon EC 13 305190": ec13(6, 1.40, 0.0206, 1.93, 4950, 6.18, 2.2, 4.30, 20500),
    "maxon EC 13 305191": ec13(9, 2.48, 0.0416, 2.74, 3480, 5.46, 2.34, 3.62, 22700),
    "maxon EC 13 305192": ec13(12, 5.74, 0.0910, 4.05, 2360, 5.77, 2.3, 2.09, 19400),
    "maxon EC 13 305193": ec13(18, 13.2, 0.198, 5.98, 1600, 6.10, 2.23, 1.36, 19600),
    "maxon EC 13 305194": ec13(24, 24.6, 0.357, 8.03, 1190, 6.29, 2.19, 0.976, 19300),
    "Siemens 1FT7044-AK7": SIEMENS,
    "WITTENSTEIN premo 1C": premo(0.35, 21.0, 1.40, 4.36, 0.60, 1.73, 10530, 15.1, 10.4, 0.69, 0.22),
    "WITTENSTEIN premo 2C": premo(0.39, 23.7, 2.84, 7.74, 1.17, 2.96, 9330, 5.70, 6.12, 1.08, 0.35),
    "WITTENSTEIN premo 1D": premo(0.41, 25.0, 2.76, 7.71, 1.09, 2.74, 8855, 7.48, 10.2, 1.36, 0.46),
    "WITTENSTEIN premo 2D": premo(0.52, 31.6, 5.53, 12.0, 2.11, 4.04, 7023, 3.72, 7.43, 2.00, 0.83),
    "WITTENSTEIN premo 1F": premo(0.51, 31.1, 6.09, 13.3, 2.46, 4.80, 7166, 3.23, 6.97, 2.16, 1.57),
    "WITTENSTEIN premo 3F": premo(0.54, 32.5, 16.7, 34.4, 6.38, 12.2, 6908, 0.53, 2.25, 4.25, 4.13),
    "Beckhoff AM8122-0FH1": BECKHOFF,
    "HEIDENHAIN SRP 5000": HEIDENHAIN,
    "Teknic Hudson 2311S": hudson(2.76, 2.93, 1.06, 13.27, 16.74, 60),
    "Teknic Hudson 2311P": hudson(0.69, 0.733, 1.06, 6.64, 8.37, 60),
    "Teknic Hudson 2321S": hudson(2.46, 3.66, 1.49, 23.29, 28.4, 116),
    "Teknic Hudson 2331S": hudson(2.42, 3.55, 1.47, 27.31, 35.82, 145),
    "Teknic Hudson 2341S": hudson(2.98, 4.59, 1.54, 36.4, 47.8, 186),
    "Kollmorgen KBM(S)-88X00": KOLLMORGEN,
}


MOTOR_CONSTANTS = {"HEIDENHAIN SRP 5000": 0.181, "Kollmorgen KBM(S)-88X00": 6.10}
"""N m per square root of a watt of copper loss, which finds a phase's resistance taken for the terminals'."""


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
    # a figure of the whole motor, as the sheet has it and as it follows from the file
    for told, seen in outcomes(name, sheet, motor):
        assert seen == pytest.approx(told, rel=0.12)


def outcomes(name: str, sheet: Words, motor: PmsmParameters) -> Iterator[tuple[float, float]]:
    emf = motor.pole_pairs * motor.flux_linkage_wb  # V s, the file is amplitude invariant
    if "--tau-mechanical-ms" in sheet:
        yield (
            float(sheet["--tau-mechanical-ms"]),
            1e3 * motor.inertia_kg_m2 * motor.resistance_ohm / (1.5 * emf**2),
        )
    if "premo" in name:  # the no-load speed, r/min
        yield float(sheet["--rated-speed-rpm"]), RPM_PER_RAD_S * motor.dc_bus_voltage_v / 3**0.5 / emf
    if name in MOTOR_CONSTANTS:
        yield MOTOR_CONSTANTS[name], (1.5 * emf**2 / motor.resistance_ohm) ** 0.5


def renamed(sheet: Words, old: str, new: str) -> Words:
    return {new if key == old else key: value for key, value in sheet.items()}


def of_all(makers: str, old: str, new: str, told: str) -> list[tuple[str, str, str, str]]:
    """A case for each sheet; of each maker few are taken, as their sheets have the same columns."""
    return [
        (name, old, new, told)
        for maker in makers.split()
        for name in few_of([each for each in SHEETS if each.split()[0] == maker], 1)
    ]


ALIKE = "Siemens WITTENSTEIN Beckhoff HEIDENHAIN Kollmorgen"
"""Makers of servo motors: amperes and volts between terminals, rms."""


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        *of_all("maxon Teknic", "--kt-nm-adc", "--kt-nm-arms", "kt_nm_adc ="),
        *of_all(ALIKE, "--kt-nm-arms", "--kt-nm-apk", "kt_nm_arms ="),
        *of_all(ALIKE, "--kt-nm-arms", "--kt-nm-adc", "kt_nm_arms ="),
        *of_all(ALIKE, "--ke-line-vrms-krpm", "--ke-line-vpk-krpm", "ke_line_vrms_krpm ="),
        *of_all(ALIKE, "--ke-line-vrms-krpm", "--ke-phase-vrms-krpm", "ke_line_vrms_krpm ="),
        *of_all("Teknic", "--ke-line-vpk-krpm", "--ke-line-vrms-krpm", "ke_line_vpk_krpm ="),
        *of_all("Teknic", "--ke-line-vpk-krpm", "--ke-phase-vpk-krpm", "ke_line_vpk_krpm ="),
        *of_all("maxon", "--r-line-ohm", "--r-phase-ohm", "of a phase and is between terminals"),
        *of_all("Siemens", "--r-phase-ohm", "--r-line-ohm", "between terminals and is of a phase"),
        *of_all("Siemens", "--l-phase-mh", "--l-line-mh", "the other between terminals"),
        *of_all("WITTENSTEIN Teknic", "--r-line-ohm", "--r-phase-ohm", "the other between terminals"),
        *of_all("WITTENSTEIN Teknic", "--l-line-mh", "--l-phase-mh", "the other between terminals"),
        *of_all("Siemens WITTENSTEIN HEIDENHAIN Kollmorgen", "--rated-current-arms", "--rated-current-apk",
                "is an rms value"),
        *of_all("Siemens WITTENSTEIN HEIDENHAIN Beckhoff", "--peak-current-arms", "--peak-current-apk",
                "is an rms value"),
    ],
)  # fmt: skip
def test_a_figure_in_a_wrong_convention_is_refused_and_the_right_one_told(
    name: str, old: str, new: str, told: str, tmp_path: Path
) -> None:
    status, said = entered(renamed(SHEETS[name], old, new), tmp_path / "motor.toml")
    assert status == 2, said
    assert told in said
    assert not (tmp_path / "motor.toml").exists()


@pytest.mark.parametrize("name", ["Teknic Hudson 2311S", "HEIDENHAIN SRP 5000"])
def test_poles_entered_as_pairs_beside_the_sheets_own_are_refused(name: str, tmp_path: Path) -> None:
    status, said = entered(SHEETS[name] | {"--pole-pairs": SHEETS[name]["--poles"]}, tmp_path / "motor.toml")
    assert status == 2, said
    assert "--poles" in said
    assert "--pole-pairs" in said

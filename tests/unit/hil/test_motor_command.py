"""``hil motor new`` and ``hil motor show`` as they are typed."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.configuration.motor_file import load_motor
from servobench.hil.studies.motor.figures import FIGURES, GROUPS, option

SHEET = {
    "--poles": 10, "--r-line-ohm": 1.8, "--l-line-mh": 5.4, "--kt-nm-arms": 0.8, "--ke-line-vrms-krpm": 48.4,
    "--inertia-kg-cm2": 1.2, "--rated-torque-nm": 2.4, "--rated-speed-rpm": 3000, "--rated-current-arms": 3.1,
    "--peak-current-arms": 12.7, "--dc-bus-v": 325,
}  # fmt: skip


def _new(
    path: Path, changes: Mapping[str, float | str | None] | None = None, *more: str, text: str = ""
) -> tuple[int, str]:
    values = {**SHEET, **(changes or {})}
    words = [str(word) for pair in values.items() if pair[1] is not None for word in pair]
    result = CliRunner().invoke(app, ["motor", "new", str(path), *words, *more], input=text)
    return result.exit_code, result.output


def test_a_sheet_becomes_a_motor_file(tmp_path: Path) -> None:
    status, text = _new(tmp_path / "a.toml", None, "--name", "A 1")
    assert status == 0, text
    motor = load_motor(tmp_path / "a.toml").parameters
    assert motor.name == "A 1"
    assert (motor.resistance_ohm, motor.inductance_q_h, motor.pole_pairs) == (0.9, 0.0027, 5)
    assert motor.torque_constant_nm_a == pytest.approx(0.8 / 2**0.5, rel=1e-5)
    assert motor.current_max_a == pytest.approx(12.7 * 2**0.5, rel=1e-5)
    assert "kt_nm_arms = 0.8" in (tmp_path / "a.toml").read_text()


def test_a_file_that_cannot_be_written_is_bad_input(tmp_path: Path) -> None:
    status, text = _new(tmp_path / "none" / "a.toml")
    assert status == 2, text
    assert "MOTOR.toml: found" in text
    assert "No such file or directory" in text


def test_what_the_sheet_gives_otherwise_is_the_same_motor(tmp_path: Path) -> None:
    assert _new(tmp_path / "a.toml")[0] == 0
    other = {"--poles": None, "--pole-pairs": 5, "--r-line-ohm": None, "--r-phase-ohm": 2.7,
             "--l-line-mh": None, "--l-phase-mh": 8.1, "--inertia-kg-cm2": None,
             "--inertia-kg-m2": 1.2e-4}  # fmt: skip
    status, text = _new(tmp_path / "b.toml", other, "--delta")
    assert status == 0, text
    one, two = (load_motor(tmp_path / name).parameters for name in ("a.toml", "b.toml"))
    assert (one.resistance_ohm, one.inductance_d_h, one.inertia_kg_m2) == (
        two.resistance_ohm, two.inductance_d_h, two.inertia_kg_m2)  # fmt: skip


def test_a_figure_comes_in_the_unit_of_the_sheet(tmp_path: Path) -> None:
    assert _new(tmp_path / "a.toml", {"--inertia-kg-cm2": None, "--inertia-kg-m2": 1.2e-4})[0] == 0
    others = {
        "--r-line-ohm": "1800 mOhm", "--l-line-mh": "5400 uH", "--kt-nm-arms": "113.2896 oz-in/A",
        "--ke-line-vrms-krpm": "0.0484 V/rpm", "--inertia-kg-cm2": None, "--inertia-kg-m2": "1200 g·cm^2",
        "--rated-torque-nm": "21.2418 lb in",
    }  # fmt: skip
    status, text = _new(tmp_path / "b.toml", others)
    assert status == 0, text
    one, two = (load_motor(tmp_path / name).parameters for name in ("a.toml", "b.toml"))
    for figure in ("resistance_ohm", "inductance_d_h", "flux_linkage_wb", "inertia_kg_m2", "rated_torque_nm"):
        assert getattr(two, figure) == pytest.approx(getattr(one, figure), rel=1e-5)


def test_a_hot_winding_and_time_constants_of_the_cold_one(tmp_path: Path) -> None:
    status, text = _new(tmp_path / "a.toml", {"--tau-electrical-ms": 3.0}, "--winding-c", "120")
    assert status == 0, text
    assert load_motor(tmp_path / "a.toml").parameters.resistance_ohm == pytest.approx(
        0.9 * 355 / 255, rel=1e-5
    )


def test_a_contradiction_is_refused_and_nothing_written(tmp_path: Path) -> None:
    status, text = _new(tmp_path / "a.toml", {"--ke-line-vrms-krpm": 68.4})
    assert status == 2
    assert "kt_nm_apk = 0.8 or ke_line_vpk_krpm = 68.4 or kt_nm_adc = 0.8 is meant" in text
    assert not (tmp_path / "a.toml").exists()


@pytest.mark.parametrize("group", [name for name, group in GROUPS.items() if group.needed])
def test_what_is_missing_is_named_with_its_options(tmp_path: Path, group: str) -> None:
    keys = {option(figure.key): None for figure in FIGURES if figure.group == group}
    status, text = _new(tmp_path / "a.toml", {key: None for key in keys})
    assert status == 2
    assert all(key in text.replace("\n", "") for key in keys)


@pytest.mark.parametrize(("changes", "told"), [
    ({"--pole-pairs": 4}, "one of them"),
    ({"--poles": 9}, "even number"),
    ({"--r-line-ohm": -1.0}, "above zero"),
    ({"--r-phase-ohm": 0.9}, "one of them"),
    ({"--kt-nm-arms": "0.8 kg"}, "ozin"),
    ({"--poles": "ten"}, "is not a number"),
])  # fmt: skip
def test_what_cannot_be_is_refused(tmp_path: Path, changes: dict[str, float | str | None], told: str) -> None:
    status, text = _new(tmp_path / "a.toml", changes)
    assert status == 2
    assert told in text


def test_a_file_that_is_there_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("mine")
    assert _new(path)[0] == 2
    assert path.read_text() == "mine"
    assert _new(path, None, "--force")[0] == 0


def test_somebody_at_a_terminal_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servobench.hil.terminal.motor.at_terminal", lambda: True)
    gone = {"--poles": None, "--r-line-ohm": None, "--dc-bus-v": None}
    status, text = _new(tmp_path / "a.toml", dict.fromkeys(gone), text="2\n5\n1\n1.8\n325\n")
    assert status == 0, text
    motor = load_motor(tmp_path / "a.toml").parameters
    assert (motor.pole_pairs, motor.resistance_ohm, motor.dc_bus_voltage_v) == (5, 0.9, 325.0)


def test_show_has_the_sheet_again(tmp_path: Path) -> None:
    assert _new(tmp_path / "a.toml")[0] == 0
    picture = tmp_path / "a.svg"
    result = CliRunner().invoke(
        app, ["motor", "show", str(tmp_path / "a.toml"), "--json", "--picture", str(picture)]
    )
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["kt_nm_arms"] == pytest.approx(0.8, rel=1e-4)
    assert figures["peak_current_arms"] == pytest.approx(12.7, rel=1e-4)
    assert "<svg" in picture.read_text()
    plain = CliRunner().invoke(app, ["motor", "show", str(tmp_path / "a.toml")])
    assert "kt_nm_arms" in plain.stdout


def test_every_option_stands_whole_on_a_narrow_page() -> None:
    result = CliRunner().invoke(app, ["motor", "new", "--help"], env={"COLUMNS": "80"})
    for figure in FIGURES:
        assert option(figure.key) in result.stdout

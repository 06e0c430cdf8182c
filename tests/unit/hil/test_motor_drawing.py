"""The picture of ``hil motor show``, read back: what it draws is what the file says."""

import math
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.design.motor import speed_limit
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.hil.cli import app
from servobench.hil.configuration.motor_file import load_motor
from tests.scenario.processes import EXAMPLES

CABINET = EXAMPLES / "motors" / "cabinet.toml"


@pytest.fixture
def panels(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Figures that stay open."""
    kept: list[Any] = []
    monkeypatch.setattr(plt, "close", kept.append)
    return kept


def shown(tmp_path: Path, *words: str) -> None:
    done = CliRunner().invoke(app, ["motor", "show", *words, "--picture", str(tmp_path / "a.svg")])
    assert done.exit_code == 0, done.output


def line(axes: Any, label: str) -> tuple[Any, Any]:
    (found,) = (each for each in axes.lines if each.get_label() == label)
    return np.asarray(found.get_xdata()), np.asarray(found.get_ydata())


def test_a_cabinets_machine_has_four_panels(tmp_path: Path, panels: list[Any]) -> None:
    motor = load_motor(CABINET).parameters
    assert motor.mechanism is not None
    coupling, friction = motor.mechanism.coupling, motor.mechanism.friction
    assert coupling is not None
    assert friction is not None
    shown(tmp_path, str(CABINET))
    _, rubs, swings, cogs = panels[0].axes
    rpm, torque = line(rubs, "forward")
    half = motor.coulomb_friction_nm + 0.5 * (friction.breakaway_nm - motor.coulomb_friction_nm)
    half += motor.viscous_friction_nm_s * friction.stribeck_rad_s
    assert np.interp(10.0, rpm, torque) == pytest.approx(half, rel=1e-4)
    assert torque[0] == pytest.approx(friction.breakaway_nm, rel=1e-3)
    hertz, gain = line(swings, "motor")
    assert hertz[np.argmax(gain / line(swings, "rigid shaft")[1])] == pytest.approx(
        coupling.resonance_hz, 0.01
    )
    assert hertz[np.argmin(gain / line(swings, "rigid shaft")[1])] == pytest.approx(60.0, rel=0.01)
    assert gain[0] == pytest.approx(line(swings, "rigid shaft")[1][0], rel=0.02), "one mass, slowly"
    assert float(np.max(np.abs(cogs.lines[0].get_ydata()))) == pytest.approx(0.02, rel=1e-3)
    assert float(cogs.lines[0].get_xdata()[-1]) == pytest.approx(360.0 / 24)


def test_torque_over_speed_is_at_the_link_of_the_drive(tmp_path: Path, panels: list[Any]) -> None:
    motor = load_motor(Path("wittenstein-premo-2d")).parameters
    shown(tmp_path, "wittenstein-premo-2d", "--like", "epos4-50-5")
    (axes,) = panels[0].axes
    rpm, torque = line(axes, "peak, i_d = 0")
    ends = speed_limit(motor, 0.0) * 0.9 * 50.0 / 320.0
    assert rpm[np.flatnonzero(torque)[-1]] == pytest.approx(ends * RPM_PER_RAD_S, rel=5e-3)
    assert "45 V" in axes.get_xlabel()
    shown(tmp_path, "maxon-ec-40-48v", "--like", "elmo-gold-twitter-25-100")
    ec40 = load_motor(Path("maxon-ec-40-48v")).parameters
    assert line(panels[1].axes[0], "peak, i_d = 0")[1][0] == pytest.approx(ec40.torque_max_nm)
    shown(tmp_path, "beckhoff-am8112", "--like", "el7211")
    peak_nm = 0.08 * 9.0
    assert line(panels[2].axes[0], "peak, i_d = 0")[1][0] == pytest.approx(peak_nm, rel=1e-4)


def test_iron_and_a_weakened_field_are_drawn(tmp_path: Path, panels: list[Any]) -> None:
    text = (EXAMPLES / "motors" / "ling2012.toml").read_text()
    (tmp_path / "iron.toml").write_text(text + "\n[saturation]\ntorque_percent = 90.0\n")
    (tmp_path / "drive.toml").write_text("[field]\nweakening = true\nvoltage_percent = 100.0\n")
    shown(tmp_path, str(tmp_path / "iron.toml"), "--like", str(tmp_path / "drive.toml"))
    over_speed, over_current = panels[0].axes
    motor = load_motor(tmp_path / "iron.toml").parameters
    rpm, weakened = line(over_speed, "peak, weakened field")
    assert rpm[np.flatnonzero(weakened > 0.01)[-1]] > 1.5 * speed_limit(motor, 0.0) * RPM_PER_RAD_S
    assert float(np.max(weakened)) == pytest.approx(motor.torque_max_nm)
    amperes, made = line(over_current, "made")
    believed = line(over_current, "as the drive believes")[1]
    assert made[-1] == pytest.approx(0.9 * believed[-1])
    linear = amperes < 2.0 * motor.rated_current_a
    assert made[linear] == pytest.approx(believed[linear])


def test_a_motor_alone_has_one_panel_at_its_own_link(tmp_path: Path, panels: list[Any]) -> None:
    shown(tmp_path, str(EXAMPLES / "motors" / "ling2012.toml"))
    (axes,) = panels[0].axes
    assert "300 V" in axes.get_xlabel()
    assert math.isfinite(axes.get_ylim()[1])

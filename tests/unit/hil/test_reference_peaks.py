"""What a reference asks for at most: its largest level and rate, counted by hand, and as the file is told."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.configuration.references import (
    LoadStep,
    RampReference,
    Reference,
    SignalFile,
    SineReference,
    StepReference,
    peak_level,
    peak_rate,
)
from servobench.hil.loop.scenario import LevelStep, Quantity, Ramp, Sine, Table


def step(speed_rpm: float, at_s: float = 0.0) -> StepReference:
    return StepReference(kind="step", at_s=at_s, speed_rpm=speed_rpm)


def ramp(speed_rpm: float, over_s: float, at_s: float = 0.0) -> RampReference:
    return RampReference(kind="ramp", at_s=at_s, speed_rpm=speed_rpm, over_s=over_s)


def sine(amplitude_rpm: float, frequency_hz: float) -> SineReference:
    return SineReference(kind="sine", at_s=0.0, amplitude_rpm=amplitude_rpm, frequency_hz=frequency_hz)


def table(path: Path, **more: Any) -> SignalFile:
    """60 r/min down to -180 within 2 s, and up by 30 in a tenth of a second."""
    path.write_text("time_s,speed_rpm\n0.5,60\n2.5,-180\n2.6,-150\n")
    return SignalFile(kind="file", path=str(path), **more)


@pytest.mark.parametrize(
    ("profile", "level", "rate"),
    [
        ((), 0.0, 0.0),
        ((step(-700.0),), 700.0, 0.0),
        ((step(300.0), step(-200.0)), 300.0, 0.0),
        ((step(-200.0), step(300.0)), 300.0, 0.0),
        ((ramp(500.0, 0.25),), 500.0, 2000.0),
        ((step(-200.0), ramp(500.0, 0.25)), 500.0, 2800.0),
        ((ramp(500.0, 0.25), ramp(-300.0, 0.5)), 500.0, 2000.0),
        ((ramp(500.0, 0.5), ramp(-300.0, 0.25)), 500.0, 3200.0),
        ((sine(10.0, 2.0),), 10.0, math.tau * 20.0),
        ((sine(10.0, 2.0), sine(3.0, 9.0)), 13.0, math.tau * 27.0),
        ((sine(10.0, 2.0), sine(3.0, 1.0)), 13.0, math.tau * 20.0),
        ((step(-200.0), sine(10.0, 2.0)), 210.0, math.tau * 20.0),
        ((sine(10.0, 2.0), step(200.0)), 200.0, math.tau * 20.0),
        ((sine(10.0, 1.0), step(4.0)), 10.0, math.tau * 10.0),
        ((step(50.0), sine(30.0, 1.0), ramp(150.0, 0.25)), 150.0, 520.0),
        ((step(50.0), sine(30.0, 1.0), step(50.0), ramp(150.0, 0.5)), 150.0, 200.0),
        ((step(100.0), sine(30.0, 1.0), step(-20.0), sine(5.0, 1.0)), 130.0, math.tau * 30.0),
    ],
)
def test_the_largest_level_and_rate(profile: tuple[Reference, ...], level: float, rate: float) -> None:
    """After a sine a ramp begins anywhere within its swing; two sines swing together."""
    assert peak_level(profile) == level
    assert peak_rate(profile) == pytest.approx(rate, rel=1e-12)


@pytest.mark.parametrize(("between", "rate"), [("interpolated", 300.0), ("held", 0.0)])
def test_a_file_has_its_own_level_and_rate(tmp_path: Path, between: str, rate: float) -> None:
    entry = table(tmp_path / "a.csv", at_s=1.5, between=between)
    assert entry.level == pytest.approx(180.0)
    assert entry.rate == pytest.approx(rate)
    assert entry.ends_s == pytest.approx(4.1)
    assert [peak_level((entry,)), peak_rate((entry,))] == pytest.approx([180.0, rate])
    assert entry.told == [(Quantity.SPEED, "path")]
    assert entry.level_si == pytest.approx(180.0 * RAD_S_PER_RPM)
    assert entry.level_text == "180 r/min"
    assert entry.describe() == "speed of a.csv, 3 points"
    segment = entry.segment()
    assert isinstance(segment, Table)
    assert segment.at_s == 1.5
    halfway = -60.0 if between == "interpolated" else 60.0
    assert segment.value(1.5, 0.0) == pytest.approx(halfway * RAD_S_PER_RPM)


def test_a_file_of_positions_is_in_radians(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("time_s,position_rad\n0,0\n1,-2.5\n")
    entry = SignalFile(kind="file", path=str(path))
    assert (entry.at_s, SignalFile(kind="file", path=str(path), at_s=0.5).at_s) == (0.0, 0.5)
    assert (entry.level, entry.rate, entry.level_si) == (2.5, 2.5, 2.5)
    assert entry.level_text == "2.5 rad"


@pytest.mark.parametrize(
    ("raw", "quantity", "level_si", "text", "segment"),
    [
        (
            {"kind": "step", "at_s": 0.5, "speed_rpm": -60.0},
            Quantity.SPEED,
            -math.tau,
            "step to -60 r/min",
            LevelStep(0.5, -60.0 * RAD_S_PER_RPM),
        ),
        (
            {"kind": "step", "at_s": 0.5, "position_rad": 2.0},
            Quantity.POSITION,
            2.0,
            "step to 2 rad",
            LevelStep(0.5, 2.0),
        ),
        (
            {"kind": "ramp", "at_s": 1.0, "torque_nm": 0.25, "over_s": 0.5},
            Quantity.TORQUE,
            0.25,
            "ramp to 0.25 N m over 0.5 s",
            Ramp(1.0, 0.25, 0.5),
        ),
        (
            {"kind": "sine", "at_s": 2.0, "amplitude_rad": 0.5, "frequency_hz": 3.0},
            Quantity.POSITION,
            0.5,
            "sine of 0.5 rad at 3 Hz",
            Sine(2.0, 0.5, 3.0),
        ),
        (
            {"kind": "sine", "at_s": 2.0, "amplitude_nm": 0.5, "frequency_hz": 2.5},
            Quantity.TORQUE,
            0.5,
            "sine of 0.5 N m at 2.5 Hz",
            Sine(2.0, 0.5, 2.5),
        ),
    ],
)
def test_an_entry_of_each_quantity(
    raw: dict[str, Any], quantity: Quantity, level_si: float, text: str, segment: object
) -> None:
    entry = TypeAdapter[Any](Reference).validate_python(raw)
    assert entry.quantity is quantity
    assert entry.level_si == pytest.approx(level_si)
    assert entry.describe() == text
    assert entry.segment() == segment


@pytest.mark.parametrize(
    ("entry", "keys"),
    [
        (step(1.0), ["speed_rpm", "position_rad", "torque_nm"]),
        (ramp(1.0, 1.0), ["speed_rpm", "position_rad", "torque_nm"]),
        (sine(1.0, 1.0), ["amplitude_rpm", "amplitude_rad", "amplitude_nm"]),
    ],
)
def test_the_keys_of_which_an_entry_must_have_one(entry: Any, keys: list[str]) -> None:
    assert entry.keys == keys
    assert len(entry.told) == 1


def test_an_entry_of_two_quantities_tells_both() -> None:
    entry = StepReference(kind="step", at_s=0.0, torque_nm=1.0, speed_rpm=2.0)
    assert entry.told == [(Quantity.SPEED, "speed_rpm"), (Quantity.TORQUE, "torque_nm")]


def test_a_load_step_is_a_torque() -> None:
    load = LoadStep(at_s=0.25, torque_nm=-0.5)
    assert (load.kind, load.level, load.describe()) == ("step", -0.5, "torque -0.5 N m")
    assert load.segment() == LevelStep(0.25, -0.5)


def test_peaks_are_those_of_a_profile_that_is_sampled_finely() -> None:
    """Ramps and steps alone: no swing is assumed that the file does not ask for."""
    entries = (step(200.0, 0.1), ramp(-300.0, 0.25, 0.2), ramp(100.0, 0.4, 0.5))
    time: np.ndarray[Any, Any] = np.linspace(0.2, 0.9, 7001)[1:-1]
    speed = np.interp(time, [0.2, 0.45, 0.5, 0.9], [200.0, -300.0, -300.0, 100.0])
    assert peak_level(entries) == pytest.approx(np.abs(speed).max(), rel=1e-3)
    assert peak_rate(entries) == pytest.approx(np.abs(np.diff(speed) / np.diff(time)).max(), rel=1e-3)

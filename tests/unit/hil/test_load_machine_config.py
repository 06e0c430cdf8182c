"""``[load_machine]`` of a bench file, and its readings on their way into a recording."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import BenchError
from servobench.drivers.instruments.dynamometer import LineCounts, LoadReading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.load.load_machines import InstrumentLoadMachine
from servobench.hil.recording.verdict_text import verdict_markdown
from servobench.hil.rows.side_rows import EVENT_DTYPE, LoadEvent, event_row, events_of
from tests.scenario.processes import EXAMPLES
from tests.unit.hil.recording_tools import plan_for
from tests.unit.hil.test_summary import summary_with


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    text = (EXAMPLES / "load_machine.toml").read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def test_the_example_is_read_with_its_defaults(tmp_path: Path) -> None:
    config = load_bench(written(tmp_path))
    machine = config.load_machine
    assert machine is not None
    assert config.load_machine_axis == "axis1"
    assert machine.dialect.ask == b"OD1\r\n"
    assert machine.settings.answer_timeout == NS_PER_S
    assert machine.settings.reading_every == 20 * NS_PER_MS
    resolved = tmp_path / "resolved.toml"
    resolved.write_text(config.resolved_text())
    assert load_bench(resolved).load_machine == machine


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"magtrol_dsp7000" ', '"magtrol_dsp9000" ', "magtrol_dsp7000"),
        ('port = "simulated"', "", "load_machine.port"),
        (
            "torque_max_nm = 5.0                  #",
            "torque_max_nm = 0.5 #",
            r"load\.axis1\[0\]\.torque_nm.*0\.5",
        ),
        ("torque_nm = 0.6 ", "torque_nm = -0.6 ", "a brake takes power"),
        ("baud = 9600", "baud = 9600\naxis = 'axis2'", r"load_machine\.axis.*axis1"),
        ("baud = 9600", "baud_rate = 9600", "load_machine.baud_rate"),
        ("baud = 9600", "baud = 9600\ntorque_unit = 'Nm'", "load_machine.torque_unit"),
        ('"magtrol_dsp7000" ', '"magtrol_dsp6001"\nchannel = 2 #', r"load_machine\.channel.*only channel"),
    ],
)
def test_what_cannot_be_is_told(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(BenchError, match=message):
        load_bench(written(tmp_path, (old, new)))


def test_a_reading_survives_the_ring() -> None:
    event = LoadEvent(Instant(123456789), "axis1", 0.6123456789, -157.0796)
    row = event_row(event)
    assert events_of(np.frombuffer(row, EVENT_DTYPE)) == [event]


class FakeDynamometer:
    """Hands out what the test put in."""

    identity = "FAKE"

    def __init__(self) -> None:
        self.tally = LineCounts()
        self.readings: list[LoadReading] = []
        self.asked: list[float] = []

    def set_torque(self, torque_nm: float) -> None:
        self.asked.append(torque_nm)

    def pump(self, now: Instant) -> None:
        """Nothing to do."""

    def take_readings(self) -> list[LoadReading]:
        readings, self.readings = self.readings, []
        return readings


class StillClock:
    """Stands where the test put it."""

    def __init__(self) -> None:
        self.instant = Instant(0)

    def now(self) -> Instant:
        return self.instant

    def sleep_until(self, when: Instant) -> None:
        self.instant = when


def test_the_verdict_page_shows_what_was_asked_and_measured() -> None:
    found = {
        "identity": "MAGTROL DSP7001",
        "readings": 85,
        "late": 0,
        "spoilt": 1,
        "steps": [{"asked_nm": 0.6, "measured_nm": 0.5987}, {"asked_nm": 1.0, "measured_nm": None}],
    }
    page = verdict_markdown(plan_for(Path("run")), replace(summary_with(), load_machine=found))
    table = " ".join(page.split("| Load machine | ")[1].split("| Bus load")[0].replace("|", "").split())
    steps = "0.6 N m asked, 0.5987 measured; 1 N m asked, - measured"
    assert table == f"MAGTROL DSP7001: {steps}; 85 readings, 0 late, 1 spoilt"


def test_figures_tell_what_was_asked_reached_and_measured() -> None:
    dynamometer, clock = FakeDynamometer(), StillClock()
    kept: list[tuple[str, float]] = []
    machine = InstrumentLoadMachine(
        dynamometer,  # type: ignore[arg-type]
        "axis1",
        cast(CanopenNetwork, SimpleNamespace(pump=clock.sleep_until, clock=clock)),
        lambda axis, reading: kept.append((axis, reading.torque_nm)),
    )

    def measure(at_ms: int, torque_nm: float) -> None:
        dynamometer.readings.append(
            LoadReading(Instant(at_ms * NS_PER_MS), Duration(0), torque_nm, 100.0, False)
        )
        machine.attend(Instant(at_ms * NS_PER_MS))

    measure(-5, 9.0)
    machine.begin(Instant(0))
    measure(-1, 9.0)
    measure(10, 0.0)
    clock.instant = Instant(20 * NS_PER_MS)
    machine.set_torque(0.6)
    for at_ms, torque_nm in ((30, 0.2), (40, 0.5), (50, 0.58), (60, 0.61), (70, 0.59), (80, 0.60)):
        measure(at_ms, torque_nm)
    (step,) = machine.figures()["steps"]
    assert step == {
        "at_s": 0.02,
        "asked_nm": 0.6,
        "measured_nm": pytest.approx(0.6),
        "reached_ms": 30.0,
        "readings": 6,
    }
    assert len(kept) == 7, "a reading from before the run was kept"
    assert dynamometer.asked == [0.6]

"""A load step made and measured by an instrument: in simulated time, over a serial port, on every way out."""

import csv
import json
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from servobench.drivers.timebase import MonotonicClock
from servobench.virtual_bus.instruments.dynamometer import Brake, Instrument, InstrumentAtTerminal, Shaft
from servobench.virtual_bus.instruments.serial_line import PseudoTerminal
from tests.draws import few_of
from tests.scenario.processes import (
    EXAMPLES,
    START_LIMIT_S,
    hub_name,
    observer,
    run,
    simulated_drive,
    start_run,
)
from tests.warm.start import hil

pytestmark = pytest.mark.xdist_group("real time")

LOAD_NM = 0.6
TURNING_RAD_S = 90.0


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: run.rrd is read."""


def bench(folder: Path, port: str, duration_s: float = 3.0, **machine: object) -> Path:
    """The any-bus bench with its load from the instrument at ``port``."""
    text = (EXAMPLES / "any_bus.toml").read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    text = text.replace("duration_s = 3.0", f"duration_s = {duration_s}")
    text += '\n[load_machine]\nkind = "magtrol_dsp7000"\ntorque_max_nm = 5.0\n'
    for key, value in {"port": port, "baud": 115_200, **machine}.items():
        text += f"{key} = {json.dumps(value)}\n"
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def test_the_load_step_of_the_paper_is_made_and_measured_by_the_instrument(tmp_path: Path) -> None:
    bench_file = EXAMPLES / "load_machine.toml"
    status, summary, said = run(bench_file, "simulated", tmp_path / "run")
    assert status == 0, said
    (step,) = summary["load_machine"]["steps"]
    assert step["asked_nm"] == LOAD_NM
    assert step["measured_nm"] == pytest.approx(LOAD_NM, abs=1e-3)
    assert step["at_s"] == pytest.approx(1.0, abs=2e-3)
    # three time constants of the brake to 95 %, the line, and one reading every 25 ms
    assert 85 < step["reached_ms"] < 140
    assert summary["load_machine"]["late"] == summary["load_machine"]["spoilt"] == 0
    assert 0.5 < summary["speed_error"]["after_load_percent"] < 5.0
    with (tmp_path / "run" / "load.csv").open() as file:
        rows = list(csv.DictReader(file))
    in_the_run = [row for row in rows if float(row["at_ns"]) < 2e9]
    assert len(in_the_run) == summary["load_machine"]["readings"]
    assert float(rows[-1]["torque_nm"]) < 0.05, "the brake was seen open"
    torques = [float(row["torque_nm"]) for row in rows]
    assert torques[0] == 0.0
    assert max(torques) == pytest.approx(LOAD_NM, abs=1e-3)
    _, again, _ = run(bench_file, "simulated", tmp_path / "again")
    assert again["digest"] == summary["digest"]
    assert again["load_machine"] == summary["load_machine"]
    assert (tmp_path / "again" / "load.csv").read_text() == (tmp_path / "run" / "load.csv").read_text()


def test_the_recording_shows_what_the_instrument_measured(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    run(EXAMPLES / "load_machine.toml", "simulated", tmp_path / "run")
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "run" / "run.rrd").stream()}
    assert "/axis1/torque/brake" in paths


def test_over_a_serial_port_beside_a_drive_on_the_hub(tmp_path: Path) -> None:
    bus, port = hub_name("dyno"), tmp_path / "dyno"
    faults = ("--load-machine-fault", "truncate=0.03", "--load-machine-fault", "terminator=0.1")
    with simulated_drive(bus, "--load-machine", str(port), *faults):
        status, summary, said = run(bench(tmp_path, str(port), answer_timeout_ms=200), bus, tmp_path / "run")
    assert status == 0, said
    found = summary["load_machine"]
    assert found["identity"].startswith("MAGTROL DSP7001")
    assert found["readings"] > 50
    assert found["spoilt"] + found["late"] > 0
    (step,) = found["steps"]
    assert step["asked_nm"] == 0.2
    assert step["measured_nm"] == pytest.approx(0.2, abs=2e-3)
    assert not port.is_symlink()


def test_nobody_at_the_port_is_told_before_anything_turns(tmp_path: Path) -> None:
    bus = hub_name("nobody")
    terminal = PseudoTerminal()
    with simulated_drive(bus):
        path = bench(tmp_path, terminal.path, answer_timeout_ms=100)
        status, _, said = run(path, bus, tmp_path / "run")
        assert status == 3
        assert "no load machine answers" in said
        terminal.unplug()
        status, _, said = run(path, bus, tmp_path / "again")
        assert status == 3
        assert "the port of the load machine" in said
        status, _, said = run(bench(tmp_path, "simulated"), bus, tmp_path / "third")
        assert status == 2
        assert "load_machine.port" in said
        assert "Traceback" not in said


class FlyWheel(Shaft):
    """A shaft that turns whatever happens, so that the brake's torque can be seen."""

    def __init__(self) -> None:
        """Without a drive."""

    def speed_rad_s(self, _now: int) -> float:
        return 100.0

    def brake(self, torque_nm: float, _now: int) -> None:
        """Nothing slows it down."""


class WatchedInstrument:
    """An instrument at a serial port that outlives whoever uses it."""

    def __init__(self) -> None:
        self.terminal = PseudoTerminal()
        self.brake = Brake(FlyWheel(), 5.0)
        self.peak_nm = 0.0
        self._device = InstrumentAtTerminal(Instrument(self.brake), self.terminal)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        clock = MonotonicClock()
        self._device.start(clock.now())
        while not self._stop.is_set():
            assert self._device.wake_at is not None
            clock.sleep_until(self._device.wake_at)
            self._device.wake(clock.now())
            self.peak_nm = max(self.peak_nm, self.brake.torque_nm)

    def loaded(self) -> None:
        """Wait until it brakes."""
        clock = MonotonicClock()
        deadline = clock.now() + round(START_LIMIT_S * 1e9)
        while self.brake.torque_nm < 0.15:
            assert clock.now() < deadline, "the load never came"
            clock.sleep_until(clock.now() + 5_000_000)  # type: ignore[arg-type]

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self.terminal.unplug()


@pytest.fixture
def instrument() -> Iterator[WatchedInstrument]:
    watched = WatchedInstrument()
    yield watched
    watched.close()


def test_at_the_end_of_a_run_the_brake_is_open(tmp_path: Path, instrument: WatchedInstrument) -> None:
    bus = hub_name("end")
    with simulated_drive(bus):
        status, summary, said = run(bench(tmp_path, instrument.terminal.path), bus, tmp_path / "run")
    assert status == 0, said
    assert summary["load_machine"]["steps"][0]["measured_nm"] == pytest.approx(0.2, abs=2e-3)
    assert instrument.peak_nm == pytest.approx(0.2, abs=1e-3)
    assert instrument.brake.torque_nm < 0.02


@pytest.mark.parametrize("way", few_of(["drive killed", "SIGTERM", "SIGINT"], 2))
def test_on_every_way_out_the_brake_is_opened(
    tmp_path: Path, instrument: WatchedInstrument, way: str
) -> None:
    bus = hub_name("way")
    with simulated_drive(bus) as drive:
        process = start_run(bench(tmp_path, instrument.terminal.path, 60.0), bus, tmp_path / "run", by=hil())
        instrument.loaded()
        if way == "drive killed":
            drive.kill()
        else:
            process.send_signal(signal.Signals[way])
        _, said = process.communicate(timeout=20)
    assert process.returncode == 3 if way == "drive killed" else process.returncode in (1, 130), said
    assert instrument.brake.torque_nm < 0.02


def test_an_instrument_that_goes_away_ends_the_run_with_the_drive_at_rest(
    tmp_path: Path, instrument: WatchedInstrument
) -> None:
    bus = hub_name("gone")
    with simulated_drive(bus), observer(bus) as watching:
        process = start_run(bench(tmp_path, instrument.terminal.path, 60.0), bus, tmp_path / "run", by=hil())
        watching.until_turning(TURNING_RAD_S)
        instrument.loaded()
        instrument.terminal.unplug()
        _, said = process.communicate(timeout=30)
        watching.wait(0.1)
        assert abs(watching.velocity_rad_s()) < 0.5
    assert process.returncode == 3, said
    assert "the load machine's port is gone" in said
    assert "Traceback" not in said


def test_faults_of_no_load_machine_are_refused() -> None:
    command = [*hil(), "simulate", "--bus", "hub:none", "--node", "1", "--load-machine-fault", "drop=0.1"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=START_LIMIT_S, check=False)
    assert ended.returncode == 2
    assert "--load-machine PATH" in ended.stderr

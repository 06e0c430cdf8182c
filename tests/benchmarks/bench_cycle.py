"""How many times faster than real time a recorded bench with faults runs, and where a cycle's time goes.

The whole: the example benches with one and three axes, in this checkout and, where its hot modules are
compiled, interpreted beside it in the same run. The stages: layers of one axis put on each
other, beside a loop of plain Python that shows how fast this machine is now.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from servobench.drivers.compiled import PURE, look
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.loop.cycle_record import ROW
from servobench.hil.recording.ring import RingReader, RingWriter
from servobench.hil.recording.row_writer import RowWriter
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.rows.side_rows import FRAME, FRAME_DTYPE
from servobench.virtual_bus.bus.host_port import HostPort
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.bus.port import Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_plan import load_fault_plan
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import Timeline
from tests.unit.hil.row_tools import record_of

ROOT = Path(__file__).parents[2]
BENCHES = {"1 axis": "ling2012.toml", "3 axes": "three_axes.toml"}
DURATION_S = 10.0
CYCLES = 5_000
REPEATS = 3
SYNC, RPDO = Frame(0x080), Frame(0x201, b"\x06\x00\x00\x00")
RUN = "from servobench.hil.cli import main; main()"


def main() -> None:
    """Print two tables."""
    compiled = bool(look().compiled)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        builds: dict[str, dict[str, str]] = {"compiled": {}} if compiled else {}
        _print_whole({**builds, "interpreted": {PURE: "1"}}, folder)
    _print_stages()


def _print_whole(builds: dict[str, dict[str, str]], folder: Path) -> None:
    print(f"{'whole bench, recorded':28} {'x real time':>12} {'us/cycle':>10}   x interpreted")
    for title, bench in BENCHES.items():
        source = ROOT / "examples" / bench
        if not source.exists():
            continue
        factors = {
            name: _best_factor(environment, _long_bench(source, folder), folder / f"{title}-{name}")
            for name, environment in builds.items()
        }
        for name, factor in factors.items():
            ratio = factor / factors["interpreted"]
            print(f"{title + ', ' + name:28} {factor:12.1f} {1000 / factor:10.1f}   {ratio:8.1f}")


def _long_bench(source: Path, folder: Path) -> Path:
    examples = folder / "examples"
    if not examples.exists():
        shutil.copytree(source.parent, examples, ignore=shutil.ignore_patterns("drive_tests"))
    lines = (examples / source.name).read_text().splitlines()
    lines = [f"duration_s = {DURATION_S}" if line.startswith("duration_s") else line for line in lines]
    long = examples / f"long-{source.name}"
    long.write_text("\n".join(lines))
    return long


def _best_factor(environment: dict[str, str], bench: Path, record: Path) -> float:
    """The best of some runs: what disturbs a run only makes it slower."""
    factors = []
    for number in range(REPEATS):
        done = subprocess.run(
            [sys.executable, "-c", RUN, "run", str(bench), "--json", "--record", f"{record}-{number}"],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT), "CI": "1", **environment},
            capture_output=True,
            text=True,
            check=False,
        )
        if not done.stdout:
            raise SystemExit(done.stderr)
        factors.append(float(json.loads(done.stdout)["realtime_factor"]))
    return max(factors)


def _print_stages() -> None:
    plain = _cost_us(_plain_python)
    print(f"\n{'time of one 1 kHz cycle':40} {'us':>8}   x plain Python")
    stages: list[tuple[str, Callable[[int], None]]] = [
        ("plain Python: 100 additions (baseline)", _plain_python),
        ("segment: one frame sent and received", _frame_cycle()),
        ("drive alone: SYNC, 2 TPDOs, RPDO", _drive_cycle()),
        ("segment and drive", _bus_cycle(None)),
        ("segment, drive and faults of demo.toml", _bus_cycle(_demo_faults())),
        ("recording: a cycle and its 4 frames", _recording_cycle()),
    ]
    for title, stage in stages:
        cost = _cost_us(stage)
        print(f"{title:40} {cost:8.2f}   {cost / plain:8.1f}")


def _cost_us(stage: Callable[[int], None]) -> float:
    clock = MonotonicClock()
    costs = []
    for _ in range(REPEATS):
        began = clock.now()
        stage(CYCLES)
        costs.append((clock.now() - began) / CYCLES / (NS_PER_S / 1_000_000))
    return min(costs)


def _plain_python(cycles: int) -> None:
    for _ in range(cycles):
        total = 0
        for value in range(100):
            total += value


def _frame_cycle() -> Callable[[int], None]:
    timeline = Timeline()
    segment = CanSegment(timeline)
    bus = HostPort(segment, "host")
    peer = segment.attach("peer", Listener())
    frame = Frame(0x181, bytes(range(8)))

    def run(cycles: int) -> None:
        for _ in range(cycles):
            due = Instant(timeline.now + NS_PER_MS)
            peer.send(frame)
            bus.receive(due)
            timeline.run_until(due)

    return run


def _drive_cycle() -> Callable[[int], None]:
    drive = SimulatedServo(1, LING2012.parameters)
    drive.start(Instant(0))
    drive.receive(Frame(0, b"\x01\x00"), Instant(1_000))
    now = 0

    def run(cycles: int) -> None:
        nonlocal now
        for _ in range(cycles):
            now += NS_PER_MS
            drive.receive(SYNC, Instant(now))
            drive.receive(RPDO, Instant(now + NS_PER_MS // 2))

    return run


def _demo_faults() -> FaultInjector:
    path = ROOT / "examples" / "faults" / "demo.toml"
    injector = FaultInjector(load_fault_plan(tomllib.loads(path.read_text()), str(path)), seed=1)
    injector.start(Instant(0))
    return injector


def _bus_cycle(faults: FaultInjector | None) -> Callable[[int], None]:
    """Two readings are fetched as far as they come within the cycle; then the answer goes out."""
    timeline = Timeline()
    segment = CanSegment(timeline)
    bus = HostPort(segment, "host")
    if faults is not None:
        bus.put_before(faults, Direction.HOST_TO_DRIVE)
    AttachedDevice(SimulatedServo(1, LING2012.parameters), segment)
    bus.transmit(Frame(0, b"\x01\x00"))

    def run(cycles: int) -> None:
        for _ in range(cycles):
            due = Instant(timeline.now + NS_PER_MS)
            bus.transmit(SYNC)
            bus.receive(due)
            bus.receive(due)
            bus.transmit(RPDO)
            timeline.run_until(due)

    return run


def _recording_cycle() -> Callable[[int], None]:
    """Into rings whose reader keeps up."""
    rows, frames = RingWriter(ROW, 1 << 13), RingWriter(FRAME, 1 << 15)
    readers = RingReader(rows.descriptor, ROW_DTYPE), RingReader(frames.descriptor, FRAME_DTYPE)
    writer = RowWriter(rows, frames, keep_frames=True)
    record = record_of(np.zeros(1, ROW_DTYPE)[0])

    def run(cycles: int) -> None:
        for _ in range(cycles):
            writer.record(record)
            for _ in range(4):
                writer.frame("rx", 0x181, b"12345678", False, False, Instant(1))
        for reader in readers:
            reader.drain()

    return run


if __name__ == "__main__":
    main()

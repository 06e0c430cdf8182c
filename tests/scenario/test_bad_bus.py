"""A bad day on the bus, as a bench, a drive and a user of python-can live through it."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import can
import pytest
from typer.testing import CliRunner

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BusDown
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.cli import app
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.disturbance import Disturbance
from servobench.virtual_bus.bus.error_message import error_frame_of
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.motors import LING
from tests.recorded_frames import candump

EXAMPLES = Path(__file__).parents[2] / "examples"
PERIOD = Duration(NS_PER_MS)
SETTINGS = DriveSettings(
    PERIOD, torque_max_nm=4.0, speed_max_rad_s=250.0, quick_stop_deceleration_rad_s2=1500.0
)
BIT_NS = 1_000


@dataclass
class Axis:
    """A drive and its client, on a segment of their own."""

    segment: CanSegment
    bus: SimulatedBus
    servo: SimulatedServo
    attached: AttachedDevice
    network: CanopenNetwork
    drive: ServoDrive

    @property
    def speed_rad_s(self) -> float:
        """Of the shaft itself."""
        return self.servo.drive.firmware.speed_rad_s

    def enable(self, settings: DriveSettings = SETTINGS) -> None:
        self.drive.connect(self.network.deadline_after(Duration(NS_PER_S)))
        self.drive.configure(settings)
        self.drive.enable(self.network.deadline_after(Duration(5 * NS_PER_S)))

    def settle(self, milliseconds: int) -> None:
        """Let time pass without anybody at the master's side."""
        self.segment.timeline.run_until(Instant(self.segment.timeline.now + milliseconds * NS_PER_MS))


def make_axis(timeline: Timeline, name: str = "axis1") -> Axis:
    segment, clock = CanSegment(timeline), SimulatedClock(timeline)
    servo = SimulatedServo(1, LING)
    attached = AttachedDevice(servo, segment)
    bus = SimulatedBus(segment=segment)
    network = CanopenNetwork(BusLink(bus, clock, StampSource.MONOTONIC, name), clock, writes=RIG)
    return Axis(segment, bus, servo, attached, network, ServoDrive(network, 1, name))


def run(axes: list[Axis], cycles: int, torques_nm: list[float]) -> None:
    """Cycles of SYNC, readings and a command for each reading, on every segment."""
    start = axes[0].segment.timeline.now
    for cycle in range(1, cycles + 1):
        due = Instant(start + cycle * PERIOD)
        for axis in axes:
            axis.network.send_sync()
        answer_at = Instant(due - PERIOD // 2)
        for axis, torque_nm in zip(axes, torques_nm, strict=True):
            axis.network.pump(answer_at)
            for _ in axis.drive.take_readings():
                axis.drive.write(Command(cycle, torque_nm, due, due))
        for axis in axes:
            axis.network.pump(due)
            axis.drive.check()


@pytest.fixture
def axis() -> Iterator[Axis]:
    made = make_axis(Timeline())
    yield made
    made.bus.shutdown()


def test_a_drive_that_goes_bus_off_stops_and_tells_of_it_when_it_is_back(axis: Axis) -> None:
    axis.enable()
    run([axis], 100, [1.0])
    assert axis.speed_rad_s > 80.0
    heard: list[tuple[Frame, Instant]] = []
    axis.segment.add_monitor(lambda frame, at: heard.append((frame, at)))
    axis.attached.port.go_bus_off()
    axis.settle(1_000)
    assert [frame for frame, _ in heard if frame.can_id in (0x181, 0x701)] == []
    assert abs(axis.speed_rad_s) < 0.5
    began = axis.segment.timeline.now
    axis.attached.port.recover()
    axis.settle(100)
    emergencies = [(frame, at) for frame, at in heard if frame.can_id == 0x081]
    assert emergencies[0][0].data[:2] == b"\x40\x81"
    assert emergencies[0][1] >= began + 128 * 11 * BIT_NS
    assert emergencies[-1][0].data[:2] == b"\x00\x00"


def test_a_host_that_goes_bus_off_is_told_so_and_the_drive_comes_to_rest_by_itself(axis: Axis) -> None:
    axis.enable()
    run([axis], 100, [1.0])
    axis.segment.set_disturb(lambda sender, _frame, _at: Disturbance(60) if sender == "host" else None)
    with pytest.raises(BusDown, match="bus-off"):
        run([axis], 1_000, [1.0])
    assert axis.bus.state is can.BusState.ERROR
    axis.settle(1_000)
    assert abs(axis.speed_rad_s) < 0.5
    assert axis.servo.drive.power.state is not State.OPERATION_ENABLED


def test_a_drive_survives_to_be_unplugged_for_less_than_its_host_s_time_out(axis: Axis) -> None:
    axis.enable()
    run([axis], 100, [0.2])
    axis.attached.port.unplug()
    run([axis], 50, [0.2])
    axis.attached.port.plug()
    run([axis], 100, [0.2])
    assert axis.servo.drive.power.state is State.OPERATION_ENABLED
    assert axis.attached.port.error_state is ErrorState.ACTIVE


def test_error_frames_tell_of_the_senders_counters_and_no_receiver_gets_them() -> None:
    segment = CanSegment(Timeline())
    sender, plain = SimulatedBus("sender", segment=segment), SimulatedBus("plain", segment=segment)
    attempts = 0
    got: list[tuple[Instant, Frame]] = []
    segment.add_error_monitor(
        lambda error: got.append((error.at, error_frame_of(error, sender.port.controller)))
    )

    def judge(_sender: str, _frame: Frame, _at: Instant) -> Disturbance | None:
        nonlocal attempts
        attempts += 1
        return Disturbance(40) if attempts <= 16 else None

    segment.set_disturb(judge)
    sender.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes(8)))
    assert sender.recv(0.01) is None
    told = [frame.data for _, frame in got]
    assert len(got) == segment.errors == 16
    assert all(frame.can_id & ERROR_FLAG and len(frame.data) == 8 for _, frame in got)
    assert [data[6] for data in told] == [8 * n for n in range(1, 17)]
    assert [bool(data[1] & 0x08) for data in told] == [96 <= 8 * n < 128 for n in range(1, 17)]
    assert told[-1][1] & 0x20, "transmit error passive"
    assert all(earlier < later for (earlier, _), (later, _) in pairwise(got))
    heard = plain.recv(0.01)
    assert heard is not None
    assert not heard.is_error_frame
    assert plain.recv(0.01) is None
    assert sender.state is can.BusState.ACTIVE  # 128 - 1 after its success
    for bus in (sender, plain):
        bus.shutdown()


def test_two_segments_on_one_timeline_close_two_loops_side_by_side() -> None:
    """The same node id and the same identifiers on both, and twice the frames that one would carry."""
    timeline = Timeline()
    axes = [make_axis(timeline, "left"), make_axis(timeline, "right")]
    for axis in axes:  # nobody sends the left one its heartbeat while the right one is set up
        axis.enable(replace(SETTINGS, host_heartbeat_timeout_ms=500))
    since = timeline.now
    run(axes, 200, [0.5, -0.5])
    speeds = [axis.speed_rad_s for axis in axes]
    assert speeds[0] == pytest.approx(-speeds[1], rel=0.02)
    assert speeds[0] > 60.0
    loads = [axis.segment.load_percent(since, timeline.now) for axis in axes]
    assert loads[0] == pytest.approx(loads[1], rel=0.02)
    axes[0].attached.port.go_bus_off()
    axes[0].settle(1)
    assert axes[1].attached.port.error_state is ErrorState.ACTIVE
    assert axes[1].segment.errors == 0
    for axis in axes:
        axis.bus.shutdown()


def bench_file(folder: Path, faults: str, more: str = "") -> Path:
    text = (EXAMPLES / "ling2012.toml").read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    path = folder / "bench.toml"
    path.write_text(text.replace("faults/demo.toml", faults) + more)
    return path


def test_a_run_whose_host_goes_bus_off_ends_with_exit_status_3(tmp_path: Path) -> None:
    faults = tmp_path / "faults.toml"
    faults.write_text(
        '[[corruption]]\ndirection = "host_to_drive"\nframes = ["all"]\nprobability = 1.0\n'
        'effect = "error_frame"\nfrom_s = 0.5\n'
    )
    record = tmp_path / "run"
    result = CliRunner().invoke(app, ["run", str(bench_file(tmp_path, str(faults))), "--record", str(record)])
    assert result.exit_code == 3
    assert "the controller is bus-off" in result.output
    messages = [*can.CanutilsLogReader(candump(record))]
    errors = sum(message.is_error_frame for message in messages)
    assert 256 // 8 <= errors < 40  # an error in the arbitration field may count nothing (rule 3)
    events = [json.loads(line) for line in (record / "events.jsonl").read_text().splitlines()]
    assert f"{errors} error frames on the bus" in [event.get("text") for event in events]


def test_background_traffic_loads_the_bench_s_own_bus_and_repeats_with_the_seed(
    servo_bench: BenchRunner,
) -> None:
    stream = {"can_id": 0x0A1, "period_us": 1000, "jitter_us": 300}
    short = {"bench.duration_s": 0.5, "reference.axis1.0.at_s": 0.0, "load": {}}
    quiet = servo_bench(EXAMPLES / "ling2012.toml", short)
    loaded = servo_bench(EXAMPLES / "ling2012.toml", {**short, "bus.background": [stream]})
    loads = [run.summary.bus_load_percent for run in (quiet, loaded)]
    assert loads[0] is not None
    assert loads[1] is not None
    more = loads[1] - loads[0]
    assert 11.1 <= more <= 13.8  # 111 bits and at most 24 stuff bits, and 3 of intermission, in 1 ms
    again = servo_bench(loaded.folder / "bench.toml")
    assert again.digest == loaded.digest != quiet.digest
    again.assert_no_unintended_frame(allow=("0A1#*",))
    with pytest.raises(AssertionError, match=r"received 0A1#\w+ \(EMCY of node 33"):
        again.assert_no_unintended_frame()


def test_background_traffic_of_a_bench_needs_its_own_simulated_bus(tmp_path: Path) -> None:
    stream = "\n[[bus.background]]\ncan_id = 0x0A1\nperiod_us = 1000\n"
    path = bench_file(tmp_path, f"{EXAMPLES}/faults/demo.toml", stream)
    result = CliRunner().invoke(app, ["run", str(path), "--bus", "hub:unused"])
    assert result.exit_code == 2
    assert "hil simulate --background" in result.output

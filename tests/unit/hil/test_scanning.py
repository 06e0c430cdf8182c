"""What ``hil scan`` opens and tells: on simulated segments in simulated time, with made-up adapters."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import pytest
from typer.testing import CliRunner

from servobench.drivers.canopen.nmt_states import UNCONFIGURED
from servobench.drivers.errors import BadInput, BenchError, BusDown, NoAnswer
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import OpenBus, parse_bus_spec
from servobench.drivers.wire.attached import CanLink, SerialPort
from servobench.drivers.wire.link import StampSource
from servobench.hil.cli import app
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.inspecting import scanning
from servobench.hil.inspecting.scanning import Adapters, OpenedBus, ScanPlan, open_to_look, scan_bus
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.device.background import Stream, background_nodes
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.told import hold

TOLD = Path(__file__).with_name("told")
KERNEL = (
    CanLink("can0", True, "can", 500_000, "ERROR-ACTIVE"),
    CanLink("can1", False, "", None, ""),
    CanLink("vcan0", True, "vcan", None, ""),
)
SERIAL = (
    SerialPort("/dev/ttyACM0", "CANable", "ad50:60c4", "1", "slcan firmware", True),
    SerialPort("/dev/ttyUSB0", "", "0403:6001", "2", "", False),
)


class Adapter(SimulatedBus):
    """Tells whether it was closed."""

    closed = False

    def shutdown(self) -> None:
        self.closed = True
        super().shutdown()


class Segment:
    """Drives on a bus, of which each look is one more adapter on the same."""

    def __init__(self, *nodes: int, streams: tuple[Stream, ...] = ()) -> None:
        self.timeline = Timeline()
        self.segment = CanSegment(self.timeline)
        self.looks: list[Adapter] = []
        for number, node in enumerate(nodes):
            servo = SimulatedServo(node, LING2012.parameters)
            identity = servo.dictionary.variable(0x1018, 4)
            identity.value = identity.default = 0x20 + number
            AttachedDevice(servo, self.segment, f"drive {number}")
        for other in background_nodes(streams, 0):
            AttachedDevice(other, self.segment, f"stream {other.stream.can_id}")

    def open(self, plan: ScanPlan, _say: Any) -> OpenedBus:
        """As :func:`open_to_look` does."""
        self.timeline.run_until(Instant(self.timeline.now + NS_PER_MS))  # what the last look sent is out
        bus = Adapter(segment=self.segment)
        self.looks.append(bus)
        return OpenedBus(OpenBus(bus, StampSource.MONOTONIC, "made up"), 500_000, plan.bitrate_bit_s is None)


@pytest.fixture
def on(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Have the drives of a segment on every bus that is looked at."""

    def put(segment: Segment) -> Segment:
        monkeypatch.setattr(scanning, "open_to_look", segment.open)
        monkeypatch.setattr(scanning, "MonotonicClock", lambda: SimulatedClock(segment.timeline))
        return segment

    return put


def plan(*assign: int, passive: bool = False) -> ScanPlan:
    spec = parse_bus_spec("slcan:/dev/ttyACM0")
    return ScanPlan(spec, None, Duration(NS_PER_S // 5), passive, assign)


def text(*commands: str) -> Iterator[str]:
    for command in commands:
        done = CliRunner(env={"COLUMNS": "160"}).invoke(app, command.split())
        yield f"$ hil {command}\n{done.output}exit status {done.exit_code}\n"


@pytest.mark.long
def test_what_is_told_of_buses_and_adapters(on: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        scanning, "find_adapters", lambda: Adapters(KERNEL, SERIAL, ("pcan:PCAN_USBBUS1",), ("bench",))
    )
    told = list(text("scan", "scan --json", "scan --assign 3", "scan --passive", "scan --bitrate 500000"))
    look = "scan --bus slcan:/dev/ttyACM0 --listen 0.2"
    on(Segment(1, 5, UNCONFIGURED, UNCONFIGURED, streams=(Stream(0x190, Duration(10 * NS_PER_MS)),)))
    told += text(
        look,
        f"{look} --json",
        f"{look} --passive",
        f"{look} --passive --assign 7",
        f"{look} --assign 5",
        f"{look} --assign 255",
        f"{look} --bitrate 250000 --assign 7 --store",
        f"{look} --assign 8,9",
    )
    on(Segment())
    told += text(look, f"{look} --assign 3")
    monkeypatch.setattr(scanning, "find_adapters", lambda: Adapters((), (), (), ()))
    told += text("scan")
    hold("\n".join(told), TOLD / "scanned.txt")


def test_a_scan_says_what_it_does_and_closes_its_bus(on: Any) -> None:
    segment, said = on(Segment(1)), list[str]()
    report = scan_bus(plan(), said.append)
    assert said == [
        "listening for 0.2 s",
        "asking the nodes 1 to 127",
        "looking for devices without node-ID (LSS fast scan)",
    ]
    assert (report.spec, report.bitrate_bit_s, report.bitrate_detected) == (
        "slcan:/dev/ttyACM0",
        500_000,
        True,
    )
    (bus,) = segment.looks
    assert bus.closed


def test_who_waits_looks_again_until_a_drive_has_answered_that_comes_later(on: Any) -> None:
    segment, said = on(Segment()), list[str]()
    servo = SimulatedServo(1, LING2012.parameters)
    segment.timeline.call_at(
        Instant(3 * NS_PER_S), lambda _now: AttachedDevice(servo, segment.segment, "drive")
    )
    report = scan_bus(replace(plan(), wait=Duration(60 * NS_PER_S)), said.append)
    assert [(node.node_id, node.profile) for node in report.nodes] == [(1, "servo drive (CiA 402)")]
    assert said.count("nobody has answered: looking again") == len(segment.looks) - 1 > 0
    assert all(bus.closed for bus in segment.looks)
    assert 3 * NS_PER_S < segment.timeline.now < 7 * NS_PER_S


@pytest.mark.parametrize("passive", [False, True])
def test_the_waiting_ends(on: Any, passive: bool) -> None:
    segment = on(Segment())
    asked = replace(plan(passive=passive), wait=Duration(4 * NS_PER_S))
    assert scan_bus(asked, list[str]().append).nodes == []
    assert 4 * NS_PER_S <= segment.timeline.now < 7 * NS_PER_S


def test_who_only_listens_sends_nothing(on: Any) -> None:
    segment = on(Segment(1))
    sent: list[Any] = []
    segment.segment.add_monitor(lambda frame, _at: sent.append(frame.can_id))
    report = scan_bus(plan(passive=True), list[str]().append)
    assert {can_id for can_id in sent if can_id not in (0x701, 0x081)} == set()
    assert report.unconfigured == []


def test_another_lss_master_is_left_alone(on: Any) -> None:
    on(Segment(UNCONFIGURED, streams=(Stream(0x7E5, Duration(20 * NS_PER_MS)),)))
    report = scan_bus(plan(), list[str]().append)
    assert report.unconfigured == []
    assert report.notes == ["no search for devices without node-ID: another LSS master is at work"]


class Opened:
    """What was opened, in place of adapters."""

    def __init__(self) -> None:
        self.calls: list[Any] = []

    def open_bus(self, spec: Any, bitrate: int) -> OpenBus:
        self.calls.append((str(spec), bitrate))
        return OpenBus(SimpleNamespace(), StampSource.RECEIPT, str(spec))  # type: ignore[arg-type]

    def open_listening(self, spec: Any, bitrate: int) -> Any:
        self.calls.append((str(spec), bitrate, "listening"))
        return SimpleNamespace()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Opened:
    made = Opened()
    monkeypatch.setattr(scanning, "open_bus", made.open_bus)
    monkeypatch.setattr(scanning, "open_listening", made.open_listening)
    monkeypatch.setattr(scanning, "can_links", lambda: KERNEL)
    monkeypatch.setattr(
        scanning,
        "detect_bitrate",
        lambda *_: SimpleNamespace(bitrate_bit_s=125_000, silent=False, trials=()),
    )
    return made


def look(spec: str, bitrate: int | None, passive: bool = False) -> OpenedBus:
    return open_to_look(ScanPlan(parse_bus_spec(spec), bitrate, Duration(0), passive), list[str]().append)


@pytest.mark.parametrize(
    ("spec", "bitrate", "passive", "call", "told"),
    [
        ("socketcan:can0", None, False, ("socketcan:can0", 500_000), (500_000, False)),
        ("socketcan:can0", 250_000, False, ("socketcan:can0", 250_000), (500_000, False)),
        ("socketcan:can1", None, True, ("socketcan:can1", 1_000_000), (None, False)),
        ("socketcan:can9", None, False, ("socketcan:can9", 1_000_000), (None, False)),
        ("slcan:/dev/ttyACM0", 250_000, False, ("slcan:/dev/ttyACM0", 250_000), (250_000, False)),
        ("slcan:/dev/ttyACM0", None, False, ("slcan:/dev/ttyACM0", 125_000), (125_000, True)),
        ("slcan:/dev/ttyACM0", 1, True, ("slcan:/dev/ttyACM0", 1, "listening"), (1, False)),
        ("slcan:/dev/ttyACM0", None, True, ("slcan:/dev/ttyACM0", 125_000, "listening"), (125_000, True)),
        ("pcan:PCAN_USBBUS1", 250_000, True, ("pcan:PCAN_USBBUS1", 250_000), (250_000, False)),
    ],
)
def test_a_bus_is_opened_at_its_rate(
    opened: Opened, monkeypatch: pytest.MonkeyPatch, spec: str, bitrate: int | None, passive: bool, call: Any,
    told: Any,
) -> None:  # fmt: skip
    monkeypatch.setattr(scanning, "can_listen_only", lambda spec: str(spec).startswith("slcan"))
    made = look(spec, bitrate, passive)
    assert opened.calls == [call]
    assert (made.bitrate_bit_s, made.detected) == told
    assert made.bus.stamps is StampSource.RECEIPT


def test_what_cannot_listen_needs_a_rate(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scanning, "can_listen_only", lambda _spec: False)
    with pytest.raises(BadInput, match="a bit rate, because this adapter cannot listen without taking part"):
        look("pcan:PCAN_USBBUS1", None)
    assert opened.calls == []


@pytest.mark.parametrize(
    ("silent", "trials", "said"),
    [
        (True, (125_000,), ("cannot be heard", "nothing is being sent on the bus", "--bitrate 500000")),
        (False, (125_000, 250_000), ("was not found", "has: 125000, 250000", "check termination")),
    ],
)
def test_a_rate_that_is_not_found(
    opened: Opened, monkeypatch: pytest.MonkeyPatch, silent: bool, trials: Any, said: tuple[str, ...]
) -> None:
    found = SimpleNamespace(
        bitrate_bit_s=None, silent=silent, trials=[SimpleNamespace(bitrate_bit_s=rate) for rate in trials]
    )
    monkeypatch.setattr(scanning, "detect_bitrate", lambda *_: found)
    with pytest.raises(NoAnswer) as caught:
        look("slcan:/dev/ttyACM0", None)
    assert all(part in str(caught.value) for part in said)
    assert opened.calls == []


def test_no_other_process_can_join_a_simulated_bus() -> None:
    with pytest.raises(BadInput, match="a bus that other processes can join"):
        look("simulated", None)


@pytest.mark.parametrize("wanted", [None, 250_000])
def test_a_hub_tells_its_own_rate(monkeypatch: pytest.MonkeyPatch, wanted: int | None) -> None:
    asked: list[Any] = []

    def join(channel: str, bitrate: int | None) -> Any:
        asked.append((channel, bitrate))
        return SimpleNamespace(bitrate_bit_s=250_000)

    monkeypatch.setattr(scanning, "HubBus", join)
    made = look("hub:bench", wanted)
    assert asked == [("bench", wanted)]
    assert (made.bitrate_bit_s, made.detected) == (250_000, wanted is None)
    assert (made.bus.stamps, made.bus.name) == (StampSource.MONOTONIC, "hub:bench")


def test_a_hub_that_cannot_be_joined_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise can.CanInitializationError("another rate")

    monkeypatch.setattr(scanning, "HubBus", refuse)
    with pytest.raises(BusDown) as caught:
        look("hub:bench", 1)
    error: BenchError = caught.value
    assert "cannot join hub:bench" in str(error)
    assert "another rate" in str(error)
    assert "leave --bitrate out" in str(error)


def test_a_node_id_that_nobody_was_left_for_is_told(on: Any) -> None:
    on(Segment(UNCONFIGURED))
    report = scan_bus(plan(8, 9, 10), list[str]().append)
    assert [node_id for node_id, _ in report.assigned] == [8]
    assert report.notes == ["no further device without node-ID was there for 9, 10"]

"""What puts loads on shafts: what the instrument is told and when, what a simulated drive's object gets."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.write_list import WriteGate
from servobench.drivers.errors import BadInput, NoAnswer, TransferAborted
from servobench.drivers.instruments.dynamometer import Dynamometer, LineCounts, LoadReading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant, MonotonicClock
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.references import SignalFile
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.load.load_machines import (
    InstrumentLoadMachine,
    ObjectLoadMachine,
    ShaftLoad,
    find_load_machine,
    instrument_line,
)
from servobench.hil.load.simulated_load import load_table
from servobench.hil.write_lists import RUN
from servobench.virtual_bus.drive.load_object import SIMULATED_DRIVE
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.unit.hil.test_load_machine_config import FakeDynamometer
from tests.unit.hil.test_signal_file import written

MS: Final = NS_PER_MS
ZERO: Final = Instant(100 * MS)


class Instrument(FakeDynamometer):
    """A load machine that notes in which order it is dealt with."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[str] = []
        self.fails = False

    def connect(self, wait: Callable[[Instant], None]) -> str:
        wait(Instant(7))
        return "a brake"

    def pump(self, now: Instant) -> None:
        self.calls.append(f"pump {now / MS:g}")

    def take_off(self, wait: Callable[[Instant], None]) -> None:
        wait(Instant(9))
        self.calls.append("off")
        self.set_torque(0.0)
        if self.fails:
            raise NoAnswer("nothing came")

    def close(self) -> None:
        self.calls.append("closed")


@pytest.fixture
def bus() -> Iterator[CanopenNetwork]:
    """A simulated segment without a node; its time goes on as it is pumped."""
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 0), []) as world:
        yield CanopenNetwork(world.link, world.clock, 126, writes=RUN)


class Bench:
    """An instrument on a shaft beside a bus."""

    def __init__(self, bus: CanopenNetwork, every: Duration | None = None) -> None:
        self.kept: list[tuple[str, LoadReading]] = []
        self.instrument = Instrument()
        self.machine = InstrumentLoadMachine(
            cast(Dynamometer, self.instrument),
            "axis1",
            bus,
            lambda axis, reading: self.kept.append((axis, reading)),
            every,
        )

    def read(self, at_ms: float, torque_nm: float) -> LoadReading:
        """Let the instrument tell a reading, and the machine look."""
        reading = LoadReading(Instant(round(at_ms * MS)), Duration(0), torque_nm, 1.0, False)
        self.instrument.readings.append(reading)
        self.machine.attend(reading.at)
        return reading


def test_it_waits_as_it_is_told_and_gives_the_port_back(bus: CanopenNetwork) -> None:
    bench = Bench(bus)
    assert bench.machine.connect() == "a brake"
    bench.machine.take_off()
    bench.machine.close()
    assert bus.clock.now() == 9
    assert bench.instrument.calls == ["off", "closed"]


def test_readings_count_from_the_first_cycle_on(bus: CanopenNetwork) -> None:
    bench = Bench(bus)
    bench.read(10.0, 0.1)
    bench.instrument.readings.append(LoadReading(ZERO, Duration(0), 0.1, 1.0, False))
    bench.instrument.tally.late = 3
    bench.machine.begin(ZERO)
    early, first = bench.read(99.999, 0.1), bench.read(100.0, 0.2)
    assert early.at < ZERO == first.at
    assert bench.kept == [("axis1", first)]
    last = LoadReading(Instant(ZERO + 5), Duration(0), 0.3, 1.0, False)
    bench.instrument.readings.append(last)
    bench.machine.take_off()
    assert bench.kept[1:] == [("axis1", last)]
    bench.instrument.tally = LineCounts(readings=2, late=1, spoilt=4, unasked=5, error_ns_max=1_500)
    assert bench.machine.figures() == {
        "axis": "axis1",
        "identity": "FAKE",
        "readings": 2,
        "late": 1,
        "spoilt": 4,
        "stamp_error_us_max": 1.5,
        "steps": [],
    }


def test_what_went_over_the_line_before_the_run_is_forgotten(bus: CanopenNetwork) -> None:
    bench = Bench(bus)
    bench.instrument.tally = LineCounts(late=3, spoilt=2, error_ns_max=9)
    bench.machine.begin(ZERO)
    figures = bench.machine.figures()
    assert (figures["late"], figures["spoilt"], figures["stamp_error_us_max"]) == (0, 0, 0.0)


@pytest.mark.parametrize(
    ("torques", "measured", "reached_ms"),
    [
        ([0.951], 0.951, 1.0),
        ([0.949], 0.949, None),
        ([1.051], 1.051, None),
        ([1.049], 1.049, 1.0),
        ([0.5, 0.96, 1.02, 0.98], 1.0, 2.0),
        ([0.2, 0.4, 1.0], 0.7, 3.0),
        ([0.2, 1.0, 0.3, 1.0, 0.7], 2.0 / 3.0, 2.0),
    ],
)
def test_each_step_has_the_mean_of_its_second_half_and_when_it_was_reached(
    bus: CanopenNetwork, torques: list[float], measured: float, reached_ms: float | None
) -> None:
    """Within a twentieth of what is asked."""
    bench = Bench(bus)
    bench.machine.begin(ZERO)
    bus.pump(Instant(ZERO + 500 * MS))
    bench.machine.set_torque(0.3)
    bus.pump(Instant(ZERO + 1000 * MS))
    bench.machine.set_torque(1.0)
    for number, torque_nm in enumerate(torques, 1):
        bench.read(1100.0 + number, torque_nm)
    assert bench.instrument.asked == [0.3, 1.0]
    assert bench.machine.figures()["steps"] == [
        {
            "at_s": 1.0,
            "asked_nm": 1.0,
            "measured_nm": pytest.approx(measured),
            "reached_ms": reached_ms,
            "readings": len(torques),
        }
    ], "and one that was not measured is none"


def test_steps_of_a_run_that_begins_with_the_clock_count_from_its_zero(bus: CanopenNetwork) -> None:
    bench = Bench(bus)
    bench.machine.begin(Instant(0))
    bus.pump(Instant(2 * NS_PER_S))
    bench.machine.set_torque(0.5)
    bench.read(2500.0, 0.5)
    (step,) = bench.machine.figures()["steps"]
    assert (step["at_s"], step["reached_ms"]) == (2.0, 500.0)


def test_a_load_over_time_is_told_as_often_as_the_line_takes_it(bus: CanopenNetwork) -> None:
    """The newest torque, every 20 ms; nothing where nothing new is asked."""
    bench = Bench(bus, Duration(20 * MS))
    told: list[tuple[int, float]] = []
    for at_ms in range(0, 100, 5):
        if at_ms < 70:
            bench.machine.set_torque(at_ms / 100.0)
        assert len(bench.instrument.asked) == len(told), "a set-point waits for the cycle"
        bench.machine.attend(Instant(at_ms * MS))
        told += [(at_ms, torque_nm) for torque_nm in bench.instrument.asked[len(told) :]]
    assert told == [(0, 0.0), (20, 0.2), (40, 0.4), (60, 0.6), (80, 0.65)]
    assert bench.instrument.calls[:2] == ["pump 0", "pump 5"]
    assert bench.machine.figures()["steps"] == []


def test_taking_off_forgets_what_was_to_be_told(bus: CanopenNetwork) -> None:
    bench = Bench(bus, Duration(20 * MS))
    bench.machine.set_torque(0.5)
    bench.machine.take_off()
    bench.machine.attend(Instant(50 * MS))
    assert bench.instrument.asked == [0.0]


def test_a_simulated_instrument_needs_a_simulated_drive() -> None:
    config = cast(Any, SimpleNamespace(port="simulated"))
    servo = cast(SimulatedServo, SimpleNamespace())
    for clock, made in ((MonotonicClock(), servo), (SimulatedClock(Timeline()), None)):
        with pytest.raises(BadInput) as caught:
            instrument_line(config, "bench.toml", clock, made, 0)
        error = caught.value
        assert (error.source, error.key, error.value) == ("bench.toml", "load_machine.port", "simulated")
        assert error.expected == "a serial port, because the drive is not simulated in this process"
        assert error.remedy == (
            "simulate the instrument beside the drive: hil simulate --load-machine PATH, and name PATH here"
        )


# ---- the object of a simulated drive ------------------------------------------------------------------


class Dictionary:
    """A network of one node's objects of the load machine; sub-index -> value."""

    def __init__(self, held: Mapping[int, bytes] | None = None) -> None:
        self.held = dict(held or {})
        self.written: list[tuple[int, int, int, bytes]] = []
        self.posted: list[tuple[int, int, int, bytes]] = []
        self.fails = False
        self.writes = WriteGate(RUN)
        self.writes.products[3] = SIMULATED_DRIVE

    def upload(self, node: int, index: int, sub: int) -> bytes:
        assert (node, index) == (3, 0x2100)
        if sub not in self.held:
            raise TransferAborted("no such object")
        return self.held[sub]

    def download(self, node: int, index: int, sub: int, data: bytes) -> None:
        if self.fails:
            raise NoAnswer("nothing came")
        self.written.append((node, index, sub, data))

    def post_download(self, node: int, index: int, sub: int, data: bytes) -> None:
        self.posted.append((node, index, sub, data))


def network(dictionary: Dictionary) -> CanopenNetwork:
    return cast(CanopenNetwork, dictionary)


@pytest.mark.parametrize(
    ("torque_nm", "raw"), [(0.6, b"\x58\x02\0\0"), (-0.001, b"\xff\xff\xff\xff"), (0.0004, b"\0\0\0\0")]
)
def test_a_torque_is_sent_in_thousandths_without_waiting_and_taken_off_with(
    torque_nm: float, raw: bytes
) -> None:
    node = Dictionary()
    machine = ObjectLoadMachine(network(node), 3)
    machine.set_torque(torque_nm)
    assert (node.posted, node.written) == ([(3, 0x2100, 1, raw)], [])
    machine.take_off()
    assert node.written == [(3, 0x2100, 1, b"\0\0\0\0")]


def signal_file(folder: Path, **more: Any) -> SignalFile:
    path = written(folder / "load.csv", {"time_s": [0.0, 1.0], "torque_nm": [0.1, 0.5]})
    return SignalFile.model_validate({"kind": "file", "path": str(path), **more})


@pytest.mark.parametrize(
    ("more", "delay", "course"),
    [
        ({}, b"\0\0\0\0", 1),
        ({"at_s": 0.25, "between": "held"}, (250_000).to_bytes(4, "little"), 2),
        ({"at_s": 1e-6, "between": "interpolated"}, b"\1\0\0\0", 1),
    ],
)
def test_a_load_over_time_begins_so_many_us_after_the_next_sync(
    tmp_path: Path, more: dict[str, Any], delay: bytes, course: int
) -> None:
    node = Dictionary()
    load = ShaftLoad(network(node), 3, signal_file(tmp_path, **more))
    load.begin_with_next_sync()
    assert node.written == [(3, 0x2100, 5, delay), (3, 0x2100, 3, bytes([course]))]
    node.written.clear()
    load.take_off()
    assert node.written == [(3, 0x2100, 3, b"\0"), (3, 0x2100, 1, b"\0\0\0\0")]


def found(node: Dictionary, wanted: Sequence[Any] = ()) -> object:
    return find_load_machine(network(node), 3, "bench.toml", "axis1", wanted)


STEP: Final = SimpleNamespace()
"""A load that is no file's."""


def test_a_drive_with_the_object_has_a_load_machine_and_one_without_needs_none(tmp_path: Path) -> None:
    unasked = Dictionary({1: b"\0" * 4, 3: b"\0"})
    assert found(unasked) is None
    assert unasked.written == []
    left = Dictionary({1: b"\1\0\0\0", 3: b"\0"})
    assert found(left) is None
    assert left.written == [(3, 0x2100, 3, b"\0"), (3, 0x2100, 1, b"\0\0\0\0")]
    assert type(found(Dictionary({1: b"\0" * 4}), [STEP])) is ObjectLoadMachine
    assert found(Dictionary()) is None
    number = load_table(signal_file(tmp_path).signal).number
    shaft = Dictionary({4: number.to_bytes(4, "little")})
    assert type(found(shaft, [STEP, signal_file(tmp_path)])) is ShaftLoad


@pytest.mark.parametrize("over_time", [True, False])
def test_a_load_that_nothing_can_make_is_told_in_whole(tmp_path: Path, over_time: bool) -> None:
    wanted = signal_file(tmp_path) if over_time else STEP
    with pytest.raises(BadInput) as caught:
        found(Dictionary(), [wanted])
    error = caught.value
    assert (error.source, error.key) == ("bench.toml", "load.axis1")
    assert error.value == f"a load for {SIMULATED_DRIVE}, which was made without 2100h"
    assert error.expected == (f"a load for the {SIMULATED_DRIVE}, the only drive with a load machine (2100h)")
    assert error.remedy == (
        "take load.axis1 out of the file, or couple an instrument to the shaft: [load_machine]"
    )


@pytest.mark.parametrize(("number", "has"), [(0, "none"), (77, "another file")])
def test_a_drive_that_was_started_with_other_loads_is_told_in_whole(
    tmp_path: Path, number: int, has: str
) -> None:
    load = signal_file(tmp_path)
    with pytest.raises(BadInput) as caught:
        found(Dictionary({4: number.to_bytes(4, "little")}), [load])
    error = caught.value
    assert (error.source, error.key, error.value) == ("bench.toml", "load.axis1[0].path", load.path)
    assert error.expected == f"a drive that was started with this file; node 3 has {has}"
    assert error.remedy == f"hil simulate --load 3={load.path}"

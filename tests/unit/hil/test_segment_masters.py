"""Several segments and one loop, and who makes its SYNCs."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.frame_port import UNTOLD, EchoBasis
from servobench.hil.execution.segments import (
    SegmentMasters,
    check_sync_source,
    heard_syncs,
    kernel_sync,
    listen_for_syncs,
    masters,
    record_frames,
    sync_log,
    sync_producer,
    timing_without_bench,
)
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.loop.loop import Actuation, LoopTiming
from servobench.hil.loop.pace import HeardSync, OwnSync
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.timeline import Timeline
from tests.unit.hil.loop_fakes import FakeBus
from tests.unit.hil.test_config import edited, load

FAR = Instant(1 << 60)
PERIOD = Duration(NS_PER_MS)


class Pump:
    """Frames that are there at instants of the test's choice."""

    def __init__(self, log: list[tuple[str, Instant]], name: str, handed_at: int = 0) -> None:
        self.attend_at = FAR
        self.frames: list[int] = []
        self._log, self._name, self._handed_at = log, name, handed_at

    def send_sync(self) -> Instant:
        self._log.append((f"{self._name} SYNC", Instant(self._handed_at)))
        return Instant(self._handed_at)

    def pump_one(self, until: Instant) -> bool:
        if self.frames and self.frames[0] <= until:
            self._log.append((self._name, Instant(self.frames.pop(0))))
            return True
        if until >= self.attend_at:
            self.attend_at = FAR
            return True
        return False


class Segments:
    """Two of them, on a clock that only waiting moves."""

    def __init__(self) -> None:
        self.now = Instant(0)
        self.log: list[tuple[str, Instant]] = []
        self.waits: list[Instant] = []
        self.pumps = [Pump(self.log, "one", 11), Pump(self.log, "two", 22)]
        clock = SimpleNamespace(now=lambda: self.now)
        self.networks = [SimpleNamespace(frame_pump=pump, clock=clock) for pump in self.pumps]
        self.masters = SegmentMasters(cast(list[CanopenNetwork], self.networks), self.wait)

    def wait(self, until: Instant) -> None:
        """Until a frame is there, or until then."""
        self.waits.append(until)
        due = [Instant(frame) for pump in self.pumps for frame in pump.frames[:1]]
        self.now = Instant(max(self.now, min([until, *due])))


@pytest.fixture
def two() -> Segments:
    return Segments()


def test_a_sync_goes_out_on_every_segment_and_counts_once(two: Segments) -> None:
    assert two.masters.send_sync() == 11
    assert two.log == [("one SYNC", 11), ("two SYNC", 22)]
    assert (two.masters.sync_handed_at, two.masters.sync_count) == ([11, 22], 1)
    two.masters.send_sync()
    assert two.masters.sync_count == 2


@pytest.mark.parametrize("wait", ["pump", "rest"])
def test_frames_are_handled_as_they_come_and_of_one_instant_by_segment(two: Segments, wait: str) -> None:
    two.pumps[0].frames = [30, 50, 101]
    two.pumps[1].frames = [20, 30, 100]
    getattr(two.masters, wait)(Instant(100))
    assert two.log == [("two", 20), ("one", 30), ("two", 30), ("one", 50), ("two", 100)]
    assert two.now == 100


def test_a_network_that_waits_serves_the_others_too(two: Segments) -> None:
    two.pumps[1].frames = [20, 40]
    one: Any = two.networks[0]
    assert one.pump_one(Instant(30))
    assert two.log == [("two", 20)]
    assert not one.pump_one(Instant(30))
    one.pump(Instant(60))
    assert two.log == [("two", 20), ("two", 40)]
    assert (two.networks[1].pump, two.networks[1].pump_one) == (two.masters.pump, two.masters.pump_one)


def test_at_its_end_what_is_there_is_still_handled_and_nothing_is_waited_for(two: Segments) -> None:
    two.pumps[0].frames = [0]
    assert two.masters.pump_one(Instant(0))
    assert not two.masters.pump_one(Instant(0))
    assert not two.masters.pump_one(Instant(-5))
    assert two.waits == []


def test_nobody_sleeps_beyond_the_next_housekeeping_of_any(two: Segments) -> None:
    two.pumps[1].attend_at = Instant(40)
    assert two.masters.pump_one(Instant(90))
    assert not two.masters.pump_one(Instant(90))
    assert two.waits == [40, 90]


def test_a_loop_without_bench_decides_at_seven_tenths_and_sends_at_once() -> None:
    # at 500 kbit/s a SYNC has 47 bits with its stuff bits
    found = timing_without_bench(Duration(2_000_001), 500_000, Duration(7))
    assert found == LoopTiming(
        period=Duration(2_000_001),
        decide_after=Duration(1_400_000),
        settle=Duration(7),
        actuation=Actuation.ON_ARRIVAL,
        sync_latency=Duration(2 * timing_without_bench(PERIOD, 1_000_000, Duration(0)).sync_latency),
        command_latency=Duration(2 * timing_without_bench(PERIOD, 1_000_000, Duration(0)).command_latency),
    )


class Listening:
    """A network that is told what to listen for."""

    def __init__(self, echoes: EchoBasis) -> None:
        self.link = SimpleNamespace(echoes=echoes, patience={})
        self.frame_pump = FakeBus([])
        self.heard: dict[int, Callable[[bytes, Instant], object]] = {}

    def listen(self, can_id: int, heard: Callable[[bytes, Instant], object]) -> None:
        self.heard[can_id] = heard


def test_own_syncs_are_known_by_their_echoes_and_others_are_strays() -> None:
    network = Listening(EchoBasis.BUS)
    log = sync_log(cast(CanopenNetwork, network), Duration(47_000), PERIOD)
    assert log.echoes is EchoBasis.BUS
    mark = log.handed(1, Instant(0))
    assert network.frame_pump.on_sync_echo is not None
    network.frame_pump.on_sync_echo(Instant(50_000), UNTOLD)
    assert mark.on_bus_at == 50_000
    assert list(network.heard) == [0x080]
    network.heard[0x080](b"", Instant(300_000))
    assert (log.surplus, log.marks[-1].on_bus_at) == (1, 300_000)


def test_without_echoes_a_sync_is_reckoned_by_its_latency() -> None:
    log = sync_log(cast(CanopenNetwork, Listening(EchoBasis.NONE)), Duration(47_000), PERIOD)
    assert log.handed(1, Instant(1_000)).on_bus_at == 48_000


@pytest.mark.parametrize(
    ("echoes", "basis"),
    [
        (EchoBasis.NONE, EchoBasis.RECEIPT),
        (EchoBasis.KERNEL, EchoBasis.KERNEL),
        (EchoBasis.BUS, EchoBasis.BUS),
    ],
)
def test_syncs_that_are_heard_are_stamped_as_they_are_received(echoes: EchoBasis, basis: EchoBasis) -> None:
    network = Listening(echoes)
    log, pace = heard_syncs(cast(CanopenNetwork, network), network.frame_pump, PERIOD, None)
    assert log.echoes is basis
    assert isinstance(pace, HeardSync)
    assert list(network.heard) == [0x080]
    assert callable(network.frame_pump.on_sync_echo)


def test_each_segment_has_a_network_of_its_own_in_the_order_of_the_plan() -> None:
    config = load(edited("loop", "period_us", value=1000))
    assert config.bus.segment == ()
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 0), []) as world:
        first = CanopenNetwork(world.link, world.clock)
        networks, master = masters(first, world)
        assert networks == {None: first}
        assert master is first.frame_pump


def test_frames_of_each_segment_go_to_its_own_tap() -> None:
    calls: list[tuple[str, object]] = []

    class End:
        def __init__(self, name: str) -> None:
            self.link = SimpleNamespace(tap=lambda tap: calls.append((f"{name} frames", tap)))
            self.tap_errors = lambda frame: calls.append((f"{name} errors", frame))

    world: Any = End("first")
    world.further = (End("second"), End("third"))
    taps: list[Any] = [SimpleNamespace(frame=object()) for _ in range(3)]
    record_frames(world, lambda number: taps[number])
    assert calls == [
        (f"{name} {what}", taps[number] if what == "frames" else taps[number].frame)
        for number, name in enumerate(("first", "second", "third"))
        for what in ("frames", "errors")
    ]


@pytest.mark.parametrize("sync", ["own", "foreign"])
def test_the_pace_of_a_loop_is_its_own_or_that_of_whom_it_hears(sync: str) -> None:
    config = load(edited("loop", "sync", value=sync))
    clock = FakeBus([])
    world: Any = SimpleNamespace(clock=clock, faults=SimpleNamespace(host_stall=None))
    network = Listening(EchoBasis.BUS)
    networks: Any = {None: network}
    logs, pace = listen_for_syncs(config, world, networks, clock, PERIOD)
    assert list(logs) == [None]
    assert type(pace) is (OwnSync if sync == "own" else HeardSync)
    network.heard[0x080](b"", Instant(300_000))
    assert logs[None].surplus == (1 if sync == "own" else 0)


@pytest.mark.parametrize(("source", "count"), [("kernel", 5), ("own", 0), ("foreign", 0)])
def test_this_process_makes_syncs_for_the_kernel_alone(source: str, count: int) -> None:
    timeline = Timeline()
    segment = CanSegment(timeline, 1_000_000)
    ends: list[int] = []
    segment.add_monitor(lambda frame, at: ends.append(frame.can_id))
    with SimulatedBus(segment=segment) as bus, sync_producer(source, bus, PERIOD):
        timeline.run_until(Instant(5 * PERIOD - 1))
    assert ends == [0x080] * count


def test_a_cyclic_sender_is_given_the_period_in_seconds() -> None:
    asked: list[tuple[int, bool, bytes, float]] = []

    class Sender:
        def send_periodic(self, message: Any, period_s: float) -> Any:
            asked.append((message.arbitration_id, message.is_extended_id, bytes(message.data), period_s))
            return SimpleNamespace(stop=lambda: None)

    with kernel_sync(cast(Any, Sender()), Duration(NS_PER_S // 500)):
        pass
    assert asked == [(0x080, False, b"", 0.002)]


ELSEWHERE = "only SocketCAN and the bus 'simulated' send cyclic frames by themselves"


@pytest.mark.parametrize(
    ("spec", "remedy"),
    [
        ("hub:a", f"{ELSEWHERE}; on a hub it would be a thread of this process"),
        ("pcan:PCAN_USBBUS1", ELSEWHERE),
    ],
)
def test_where_the_kernel_cannot_is_told_in_whole(spec: str, remedy: str) -> None:
    config = load(edited("loop", "sync", value="kernel"))
    with pytest.raises(BadInput) as caught:
        check_sync_source(config, parse_bus_spec(spec))
    error = caught.value
    assert (error.source, error.key, error.value) == (config.source, "loop.sync", "kernel")
    assert error.expected == f"'own' or 'foreign' on the bus {spec}"
    assert error.remedy == remedy


@pytest.mark.parametrize(
    ("background", "fits"),
    [
        ([], False),
        ([{"can_id": 0x080, "bytes_max": 0, "period_us": 1000}], True),
        ([{"can_id": 0x3A0, "bytes_max": 0, "period_us": 1000}], False),
        ([{"can_id": 0x080, "bytes_max": 0, "period_us": 1000, "extended": True}], False),
        (
            [
                {"can_id": 0x700, "bytes_max": 1, "period_us": 1000},
                {"can_id": 0x080, "bytes_max": 0, "period_us": 1000},
            ],
            True,
        ),
    ],
)
def test_on_a_simulated_bus_only_background_traffic_makes_foreign_syncs(
    background: list[dict[str, Any]], fits: bool
) -> None:
    config = load(edited("loop", "sync", value="foreign") | {"bus": {"background": background}})
    simulated = parse_bus_spec("simulated")
    if fits:
        check_sync_source(config, simulated)
        return
    with pytest.raises(BadInput) as caught:
        check_sync_source(config, simulated)
    error = caught.value
    assert (error.source, error.key, error.value) == (config.source, "loop.sync", "foreign")
    assert error.expected == "'own' or 'kernel' on the bus 'simulated', where nobody else makes SYNCs"
    assert error.remedy == "or let a [[bus.background]] with can_id = 0x080 and bytes_max = 0 make them"
    check_sync_source(config, parse_bus_spec("hub:a"))

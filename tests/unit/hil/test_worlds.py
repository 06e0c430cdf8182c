"""The world of a run: its faults, the load of its bus, and what a bus in real time does not bear."""

from dataclasses import replace
from typing import Any, Final, cast

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.frame_port import FrameTap
from servobench.hil.configuration.config import Background, BusSegment
from servobench.hil.execution.segments import SegmentMasters, masters
from servobench.hil.execution.world import WorldFaults, WorldPlan, check_time, open_world
from servobench.hil.write_lists import RUN
from servobench.virtual_bus.faults.faulty_bus import FaultyBus
from servobench.virtual_bus.hosting.injection import Injection
from tests.unit.hil.test_config import edited, load

SIMULATED: Final = parse_bus_spec("simulated")
PLAN: Final = WorldPlan(SIMULATED, 1_000_000, False, None, 0)


class Noted:
    """A part of the faults of a world."""

    def __init__(self, log: list[str], name: str, stalls: bool = False) -> None:
        self._log, self._name = log, name
        self.stalls_host = stalls

    def host_stall(self, now: Instant) -> Duration:
        return Duration(now + 1)

    def wrap(self, device: str) -> str:
        return f"{self._name} {device}"

    def start(self, now: Instant) -> None:
        self._log.append(f"{self._name} starts {now}")

    def stop(self) -> None:
        self._log.append(f"{self._name} stops")

    def finish(self) -> None:
        self._log.append(f"{self._name} finishes")


def test_all_parts_of_the_faults_begin_and_end_together() -> None:
    log: list[str] = []
    first, bus, second = (Noted(log, name, name != "bus") for name in ("first", "bus", "second"))
    faults = WorldFaults([(cast(Injection, first), cast(FaultyBus, bus)), (cast(Injection, second), None)])
    faults.start(Instant(7))
    faults.stop()
    faults.finish()
    assert log == [
        *("bus starts 7", "first starts 7", "second starts 7"),
        *("bus stops", "first stops", "second stops"),
        *("first finishes", "second finishes"),
    ]
    assert faults.host_stall == first.host_stall
    device: Any = "drive"
    wrapped: object = faults.wrap(device)
    assert wrapped == "first drive"


def test_without_a_plan_nothing_is_stalled_or_struck() -> None:
    device: Any = object()
    assert WorldFaults([]).wrap(device) is device
    assert WorldFaults([]).host_stall is None
    calm = Noted([], "first")
    assert WorldFaults([(cast(Injection, calm), None)]).host_stall is None


def test_the_plan_of_a_bench_s_world_is_its_bus() -> None:
    config = load(edited("bench", "seed", value=77))
    log: Any = object()
    assert WorldPlan.of_bench(config, SIMULATED, True, log) == WorldPlan(
        SIMULATED,
        config.bus.bitrate_bit_s,
        True,
        config.faults,
        77,
        fault_log=log,
        background=config.bus.background,
        segments=config.bus.segment,
        segment_of={config.drive["axis1"].node: None},
    )


@pytest.mark.parametrize(("time", "paced"), [(None, False), ("real", True), ("simulated", False)])
def test_simulated_time_is_paced_where_it_is_asked_for(time: str | None, paced: bool) -> None:
    assert check_time(SIMULATED, time) is paced


BACKGROUND: Final = (Background(can_id=0x3A0, period_us=1000),)
SECOND: Final = BusSegment(name="second", bitrate_bit_s=500_000)
MADE_HERE: Final = "the bus 'simulated', which the bench makes itself"


@pytest.mark.parametrize(
    ("change", "source", "remedy"),
    [
        (
            {"background": BACKGROUND},
            "bus.background",
            "send it from another process: hil simulate --background FILE",
        ),
        ({"segments": (SECOND,)}, "bus.segment", ""),
    ],
)
def test_what_only_a_simulated_bus_has_is_refused_elsewhere(
    change: dict[str, Any], source: str, remedy: str
) -> None:
    plan = replace(PLAN, spec=parse_bus_spec("hub:nobody"), **change)
    with pytest.raises(BadInput) as caught, open_world(plan, []):
        pass
    error = caught.value
    assert (error.source, error.value, error.expected) == (source, "the bus hub:nobody", MADE_HERE)
    assert error.remedy == remedy


class Seen(FrameTap):
    """Identifiers of the frames on a link."""

    def __init__(self) -> None:
        self.can_ids: list[int] = []

    def frame(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        del direction, data, extended, remote, at
        self.can_ids.append(can_id)


def test_each_segment_has_its_own_frames_and_the_busiest_is_the_load() -> None:
    second = SECOND.model_copy(update={"background": BACKGROUND})
    with open_world(replace(PLAN, segments=(second,)), []) as world:
        (further,) = world.further
        first = CanopenNetwork(world.link, world.clock, 126, writes=RUN)
        networks, master = masters(first, world)
        assert list(networks) == [None, "second"]
        assert networks["second"].node_id == 126
        assert networks["second"].writes.allowed is RUN
        assert networks["second"].link is further.link
        assert isinstance(master, SegmentMasters)
        here, there = Seen(), Seen()
        world.link.tap(here)
        further.link.tap(there)
        master.send_sync()
        master.pump(Instant(10 * NS_PER_MS))
        assert world.clock.now() == 10 * NS_PER_MS
        assert here.can_ids == [0x080]
        assert set(there.can_ids) == {0x080, 0x3A0}
        assert there.can_ids.count(0x3A0) in (9, 10, 11)
        # 111 bits and some stuff bits of 2 us each in every ms
        assert 22.0 < world.load_percent(Instant(0), world.clock.now()) < 30.0
        assert world.error_frames() == 0
        assert (world.real_time, world.wall_offset, world.trouble()) == (False, None, "")

"""A world on a bus in real time, which is one within this process here, and how each world is left."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import count
from typing import Final

import can
import pytest

from servobench.drivers.canopen.write_list import NOTHING
from servobench.drivers.errors import BadInput, BusDown, LimitExceeded, NoAnswer
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock, wall_clock_offset
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.link import BusLink
from servobench.hil.configuration.config import Background, BusSegment
from servobench.hil.execution.world import World, WorldPlan, drive_network, open_world
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.kinds.loss import Loss

SIMULATED: Final = WorldPlan(parse_bus_spec("simulated"), 1_000_000)
SEGMENTS: Final = (BusSegment(name="second"), BusSegment(name="third"))
FRAME_BITS: Final = 44 + 64 + 2 + 3
"""Of 7FFh with 8 bytes of 55h: a stuff bit after each five ones of the identifier, and the intermission."""
AT_ONCE: Final = Instant(0)
_channels: Final = count()


def real_plan(faults: FaultPlan | None = None) -> WorldPlan:
    """On a bus of its own."""
    return WorldPlan(parse_bus_spec(f"virtual:world-{next(_channels)}"), 100_000, faults=faults)


@contextmanager
def with_another(plan: WorldPlan) -> Iterator[tuple[World, can.BusABC]]:
    """The world, and another node of its bus."""
    with open_world(plan, []) as world, can.Bus(interface="virtual", channel=plan.spec.channel) as other:
        yield world, other


def is_down(link: BusLink) -> bool:
    return bool(getattr(link.bus, "_is_shutdown"))  # noqa: B009 - python-can's own note of it


def message(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def test_a_real_world_has_the_time_of_its_host() -> None:
    plan = real_plan()
    before = MonotonicClock().now()
    with open_world(plan, []) as world:
        assert before <= world.clock.now() <= MonotonicClock().now()
        assert world.wall_offset is not None
        assert abs(world.wall_offset - wall_clock_offset()) < NS_PER_S
        assert (world.real_time, world.further, world.faults.host_stall) == (True, (), None)
        assert (world.link.name, world.trouble(), world.error_frames()) == (str(plan.spec), "", 0)


def test_the_load_of_a_real_bus_is_that_of_the_frames_in_and_out() -> None:
    with with_another(real_plan()) as (world, other):
        began = world.clock.now()
        other.send(message(0x7FF, b"\x55" * 8))
        received = world.link.recv(AT_ONCE)
        assert received is not None
        assert received[:2] == (0x7FF, b"\x55" * 8)
        world.link.send(0x7FF, b"\x55" * 8)
        load = world.load_percent(Instant(began - 100 * NS_PER_S), Instant(began + 900 * NS_PER_S))
        assert load == pytest.approx(2 * FRAME_BITS * 1e-5 / 1000.0 * 100.0), "10 us a bit"


def test_error_frames_of_a_real_bus_are_counted_and_no_tap_is_shown_them() -> None:
    shown: list[int] = []
    with with_another(real_plan()) as (world, other):
        world.tap_errors(lambda _direction, can_id, *_: shown.append(can_id))
        for _ in range(2):
            other.send(can.Message(is_error_frame=True, arbitration_id=4, data=bytes(8)))
        assert world.link.recv(AT_ONCE) is None
        assert (world.error_frames(), shown) == (2, [])


def test_faults_on_the_host_s_side_strike_what_a_real_bus_brings_from_start_to_stop() -> None:
    loss = Loss(side="host", probability=1.0, frames=(0x181,))

    def heard(world: World, other: can.BusABC) -> list[int]:
        for can_id in (0x181, 0x182):
            other.send(message(can_id))
        came = iter(lambda: world.link.recv(AT_ONCE), None)
        return [can_id for can_id, _, _ in came]

    with with_another(real_plan(FaultPlan((loss,)))) as (world, other):
        world.faults.start(world.clock.now())
        assert heard(world, other) == [0x182]
        world.faults.stop()
        assert heard(world, other) == [0x181, 0x182]


def test_faults_on_the_drives_side_of_a_real_bus_are_for_the_process_of_the_drives() -> None:
    plan = real_plan(FaultPlan((Loss(side="drive", probability=1.0),)))
    with pytest.raises(BadInput) as caught, open_world(plan, []):
        pass
    assert str(caught.value) == (
        f"fault plan: loss.side: found 'the bus {plan.spec}', expected the bus 'simulated', where the bench"
        " makes the drives itself; give these faults to the drives: hil simulate --faults FILE"
    )


@pytest.mark.parametrize("plan", [SIMULATED, replace(SIMULATED, segments=SEGMENTS), real_plan()])
@pytest.mark.parametrize("fails", [False, True])
def test_every_bus_of_a_world_is_closed_when_it_is_left(plan: WorldPlan, fails: bool) -> None:
    def leave() -> None:
        if fails:
            raise ZeroDivisionError

    with suppress(ZeroDivisionError), open_world(plan, []) as world:
        links = [world.link, *(segment.link for segment in world.further)]
        assert [is_down(link) for link in links] == [False] * (1 + len(plan.segments))
        leave()
    assert [is_down(link) for link in links] == [True] * (1 + len(plan.segments))


def test_segments_bear_their_names_and_rates() -> None:
    """A SYNC is 44 bits, three stuff bits and an intermission of three at the rate of each."""
    slow = BusSegment(
        name="slow", bitrate_bit_s=250_000, background=(Background(can_id=0x7FF, period_us=1000),)
    )
    with open_world(replace(SIMULATED, segments=(slow,)), []) as world:
        assert (world.link.name, world.further[0].link.name) == ("simulated", "slow")
        assert world.further[0].name == "slow"
        arrivals = []
        for link in (world.link, world.further[0].link):
            began = world.clock.now()
            link.send(0x080, b"")
            assert link.fetch(Instant(began + NS_PER_MS))
            arrivals.append(link.last_at - began)
        assert arrivals[1] >= 4 * arrivals[0] > 0


def test_an_error_says_what_mends_the_adapter_and_of_silence_which_setting_may_be_its_cause() -> None:
    setting, anew, cure = "can0 has a queue of 1 frames", "can0 only listens", "ip link set can0 up"
    with open_world(SIMULATED, []) as made:
        vars(made.link.bus)["frame_port"].cure = cure
        said = []
        for error, changed in (
            (NoAnswer("node 1 is silent", "", "look at it"), False),
            (LimitExceeded("too fast"), False),
            (BusDown("cannot send", "", cure), False),
            (LimitExceeded("no usable reading"), True),
        ):
            looks = iter([[setting], [setting, *[anew] * changed]])  # as the run begins, and after its end
            world = replace(made, settings=partial(next, looks))
            with pytest.raises(type(error)), world.settings_told():
                raise world.explained(error)
            said.append(str(error))
    assert said == [
        f"node 1 is silent; look at it; {cure}; {setting}",
        f"too fast; {cure}",
        f"cannot send; {cure}; {setting}",
        f"no usable reading; {cure}; {anew}",
    ]


def test_a_master_of_a_bus_with_drives_is_not_on_the_simulated_one() -> None:
    with pytest.raises(BadInput) as caught, drive_network("simulated", 1_000_000, NOTHING):
        pass
    error = caught.value
    assert (error.source, error.key, error.value) == ("--bus", "", "simulated")
    assert (error.expected, error.remedy) == (
        "a bus with a drive on it",
        "use hub:NAME and `hil simulate`",
    )


def test_a_master_sends_on_the_bus_that_it_was_made_for_until_it_is_left() -> None:
    spec = f"virtual:master-{next(_channels)}"
    with can.Bus(interface="virtual", channel=spec.partition(":")[2]) as drive:
        with drive_network(spec, 500_000, NOTHING) as network:
            assert network.link.name == spec
            network.link.send(0x601, b"\x40")
            heard = drive.recv(0.0)
            assert heard is not None
            assert (heard.arbitration_id, bytes(heard.data)) == (0x601, b"\x40")
        assert is_down(network.link)

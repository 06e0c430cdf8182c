"""``hil stop``: drives come to rest whoever commands them, and what happened to each is said."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest
from typer.testing import CliRunner

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import NoAnswer
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.cli import app
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.inspecting.stopping import NodeStopped, stop_drives
from servobench.hil.write_lists import STOP
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.motors import LING
from tests.scenario.foreign_node import put_on_the_bus

MASTER_CYCLE = Duration(NS_PER_MS)
START = Frame(0x000, b"\x01\x01")
TORQUE_MODE = Frame(0x601, bytes.fromhex("2f60600004000000"))
"""6060h = 4, profile torque."""
TORQUE = (200).to_bytes(2, "little")
"""Thousandths of the rated one, 6071h."""


class OtherMaster:
    """Enables node 1 in torque mode and streams RPDOs to it, one a millisecond.

    ``again``: its controlwords walk the state machine for ever. ``starts``: it sends NMT start each time too.
    """

    def __init__(self, *, again: bool, starts: bool = False) -> None:
        self.wake_at: Instant | None = None
        self._again, self._starts = again, starts
        self._cycle = 0

    def start(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = Instant(now + 50 * NS_PER_MS)  # when the drive has booted
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        del frame, now
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = Instant(now + MASTER_CYCLE)
        self._cycle += 1
        if self._cycle == 1:
            return (START, TORQUE_MODE)
        walking = self._again or self._cycle < 30
        word = (0x06, 0x07, 0x0F)[self._cycle // 3 % 3] if walking else 0x0F
        frame = Frame(0x201, word.to_bytes(2, "little") + TORQUE)
        return (frame, START) if self._starts else (frame,)


class Shafts:
    """Drives on a simulated bus, and somebody who wants them stopped."""

    def __init__(self, world: World, servos: Sequence[SimulatedServo]) -> None:
        self.world, self.servos = world, servos

    def let_run(self, seconds: float) -> None:
        self.world.clock.sleep_until(Instant(self.world.clock.now() + round(seconds * NS_PER_S)))

    def speed(self, place: int = 0) -> float:
        servo = self.servos[place]
        servo.drive.advance(self.world.clock.now())
        return abs(servo.drive.firmware.inner.speed_rad_s)

    def stop(self, *nodes: int) -> list[NodeStopped]:
        return stop_drives(CanopenNetwork(self.world.link, self.world.clock, 126, writes=STOP), nodes)


@contextmanager
def shafts(*masters: OtherMaster, count: int = 1) -> Iterator[Shafts]:
    servos = [SimulatedServo(node, LING, DriveParameters()) for node in range(1, count + 1)]
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 0), servos) as world:
        put_on_the_bus(world, *masters)
        yield Shafts(world, servos)


def test_a_drive_that_another_master_streams_to_is_stopped() -> None:
    with shafts(OtherMaster(again=False)) as bench:
        bench.let_run(0.5)
        assert bench.speed() > 10.0
        (told,) = bench.stop()
        assert told.at_rest, told
        assert (told.node, told.before) == (1, State.OPERATION_ENABLED.value)
        assert bench.speed() < 0.5
        bench.let_run(1.0)
        assert bench.speed() < 0.5, "and stays so"
        assert bench.servos[0].drive.power.state is State.SWITCH_ON_DISABLED


def test_one_that_is_enabled_again_and_again_is_taken_out_of_operational() -> None:
    with shafts(OtherMaster(again=True)) as bench:
        bench.let_run(0.5)
        (told,) = bench.stop(1)
        assert told.at_rest, told
        assert "enabled again" in told.text
        assert "enter pre operational" in told.text
        bench.let_run(1.0)
        assert bench.speed() < 0.5
        assert bench.servos[0].state is NmtState.PRE_OPERATIONAL


def test_one_that_is_started_again_too_is_said_to_be_not_at_rest() -> None:
    with shafts(OtherMaster(again=True, starts=True)) as bench:
        bench.let_run(0.5)
        (told,) = bench.stop()
        assert not told.at_rest
        assert "NOT known to be at rest" in told.text


def test_all_drives_are_found_and_each_is_told_of() -> None:
    with shafts(OtherMaster(again=False), count=3) as bench:
        bench.let_run(0.3)
        told = bench.stop()
        assert [(each.node, each.at_rest) for each in told] == [(1, True), (2, True), (3, True)]
        assert "already" not in told[0].text
        assert "already" in told[1].text


def test_a_node_that_is_not_there_is_not_at_rest() -> None:
    with shafts() as bench:
        first, second = bench.stop(1, 9)
        assert first.at_rest
        assert (second.at_rest, second.before) == (False, "")
        assert "it answers no SDO; NMT enter pre operational" in second.text
        assert "NMT stop" in second.text


def test_nobody_there() -> None:
    with shafts(count=0) as bench, pytest.raises(NoAnswer, match="no drive on"):
        bench.stop()


def test_bad_input_is_named() -> None:
    for options, said in (
        (["--bus", "simulated"], "--bus"),
        (["--bus", "hub:x", "--node", "200"], "--node"),
        (["--bus", "nonsense"], "--bus"),
    ):
        done = CliRunner().invoke(app, ["stop", *options])
        assert done.exit_code == 2
        assert said in done.stderr

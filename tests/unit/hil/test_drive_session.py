"""The way out of a run, a measurement and a commissioning: simulated drives at rest, disabled, in order."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import DriveInFault, LimitExceeded, PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.config import Guard
from servobench.hil.execution.bus_guard import ForeignTraffic
from servobench.hil.execution.drive_session import DriveSession
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.write_lists import RUN
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING

SETTINGS = DriveSettings(sync_period_ns=Duration(NS_PER_MS))


class Hosted:
    """Two simulated drives of a host, both enabled."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.network = CanopenNetwork(world.link, world.clock, writes=RUN)
        self.drives = [ServoDrive(self.network, node) for node in (1, 2)]
        self.told: list[str] = []
        self.session = DriveSession(
            world, {None: self.network}, self.drives, Guard(on_mode="stop", on_boot="stop"), self._tell
        )
        for drive in self.drives:
            drive.connect(self.network.deadline_after(Duration(NS_PER_S)))
            drive.configure(SETTINGS)
        self.session.guard.arm({}, SETTINGS.sync_period_ns)
        for drive in self.drives:
            self.session.enable(drive)

    def _tell(self, _at: Instant, _level: str, text: str) -> None:
        self.told.append(text)

    def states(self) -> list[State | None]:
        return [drive.control.read_state() for drive in self.drives]


@contextmanager
def hosted() -> Iterator[Hosted]:
    servos = [SimulatedServo(1, LING), SimulatedServo(2, LING)]
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000), servos) as world:
        yield Hosted(world)


OFF = [State.SWITCH_ON_DISABLED] * 2


def test_all_are_stopped_before_the_load_goes_and_the_first_is_let_go() -> None:
    with hosted() as host:
        assert host.states() == [State.OPERATION_ENABLED] * 2
        seen: list[list[State | None]] = []
        releases: dict[str, Release] = {}
        host.session.let_go(
            host.drives,
            lambda drive, release: releases.update({drive.name: release}),
            unload=lambda: seen.append(host.states()),
        )
        assert not {State.OPERATION_ENABLED} & set(seen[0]), "told to stop before the load goes"
        assert [release.at_rest for release in releases.values()] == [True, True]
        assert list(releases) == [drive.name for drive in host.drives]
        assert host.states() == OFF


@pytest.mark.parametrize("error", [LimitExceeded("too fast"), KeyboardInterrupt(), ZeroDivisionError()])
@pytest.mark.parametrize("where", ["unload", "released"])
def test_whatever_fails_on_the_way_out_each_drive_is_let_go(error: BaseException, where: str) -> None:
    released: list[str] = []

    def fail() -> None:
        if where == "unload":
            raise error

    def take(drive: ServoDrive, _release: Release) -> None:
        released.append(drive.name)
        if where == "released":
            raise error

    with hosted() as host:
        with pytest.raises(type(error)):
            host.session.let_go(host.drives, take, unload=fail)
        assert released == [drive.name for drive in host.drives]
        assert host.states() == OFF


def test_only_those_named_are_told_to_stop_and_a_drive_that_was_not_enabled_is_let_go() -> None:
    with hosted() as host:
        first, second = host.drives
        second.quick_stop(host.network.deadline_after(Duration(NS_PER_S)))
        releases: list[Release] = []
        host.session.let_go(host.drives, lambda _drive, release: releases.append(release), stopped=[first])
        assert [release.at_rest for release in releases] == [True, True]
        assert host.states() == OFF


def restart(host: Hosted) -> None:
    """The second drive starts anew: a boot-up message, on which the guard of ``hosted`` ends a run."""
    host.network.command(NmtCommand.RESET_NODE, 2)
    host.network.frame_pump.pump(host.network.deadline_after(Duration(NS_PER_S)))


def test_on_the_way_out_the_guard_tells_what_would_end_a_run() -> None:
    with hosted() as host, pytest.raises(ForeignTraffic, match="node 2 started"):
        restart(host)
    with hosted() as host:
        host.session.let_go(host.drives, lambda _drive, _release: None, unload=lambda: restart(host))
        assert any("node 2 started" in text for text in host.told)


def test_a_drive_that_cannot_be_enabled_says_so() -> None:
    with hosted() as host:
        (first, _) = host.drives
        first.quick_stop(host.network.deadline_after(Duration(NS_PER_S)))
        with pytest.raises((PeerFault, DriveInFault)):
            host.session.enable(first, 0.0)

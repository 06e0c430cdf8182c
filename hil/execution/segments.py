"""Several segments and one loop: a master on each of them, all of them served during any wait.

    loop ---- SegmentMasters ----+---- FramePump, BusLink ---- segment 1: its drives
                                 +---- FramePump, BusLink ---- segment 2: its drives

SYNC goes out on every segment at the same instant. What arrives is handled in the order of arrival, and in
the order of the segments where it arrives at one instant.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress

import can

from servobench.drivers.canopen.cob_ids import SYNC
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.exchange import Master
from servobench.drivers.timebase import NS_PER_S, Clock, Duration, Instant
from servobench.drivers.wire.adapters import HUB, SOCKETCAN, BusSpec
from servobench.drivers.wire.frame_port import EchoBasis, FrameTap
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.execution.assembly import command_latency, sync_latency
from servobench.hil.execution.world import FurtherSegment, World
from servobench.hil.loop.loop import Actuation, LoopTiming
from servobench.hil.loop.pace import HeardSync, OwnSync, Pace, Stall
from servobench.hil.loop.syncs import SyncLog


def timing_without_bench(period: Duration, bitrate_bit_s: int, settle: Duration) -> LoopTiming:
    """Return the timing of a loop without a bench file: that of a bench with defaults."""
    return LoopTiming(
        period=period,
        decide_after=Duration(7 * period // 10),
        settle=settle,
        actuation=Actuation.ON_ARRIVAL,
        sync_latency=sync_latency(bitrate_bit_s),
        command_latency=command_latency(bitrate_bit_s),
    )


class SegmentMasters(Master):
    """The masters of ``networks`` as one.

    A network that waits, for an answer to an SDO or for a state, now serves the others too: their heartbeats
    go out and their drives are heard.
    """

    def __init__(self, networks: Sequence[CanopenNetwork], wait: Callable[[Instant], object]) -> None:
        """``wait``: let time pass until a frame arrives on any of the segments, or until an instant."""
        super().__init__()
        self._pumps = [network.frame_pump for network in networks]
        self._now = networks[0].clock.now
        self._wait = wait
        for network in networks:
            network.pump, network.pump_one = self.pump, self.pump_one

    def send_sync(self) -> Instant:
        self.sync_handed_at = [pump.send_sync() for pump in self._pumps]
        self.sync_count += 1
        return self.sync_handed_at[0]

    def withdraw(self) -> None:
        for pump in self._pumps:
            pump.withdraw()

    def pump(self, until: Instant) -> None:
        while self.pump_one(until):
            pass

    def rest(self, until: Instant) -> None:
        self.pump(until)

    def pump_one(self, until: Instant) -> bool:
        while True:
            now = self._now()
            for pump in self._pumps:
                if pump.pump_one(now):
                    return True
            if now >= until:
                return False
            self._wait(min(until, *[pump.attend_at for pump in self._pumps]))


def sync_log(network: CanopenNetwork, latency: Duration, period: Duration) -> SyncLog:
    """Return the log of SYNCs sent on a network's segment. It receives their echoes from now on, and others'
    SYNCs.

    ``latency``: from handing one over until its end on an idle bus. One that finds no room there for half
    a ``period`` is given up: no drive gets two of them closer to one another than that.
    """
    log = SyncLog(latency, period, network.link.echoes)
    network.link.patience[SYNC] = Duration(period // 2)
    network.frame_pump.on_sync_echo = log.came
    network.frame_pump.on_sync_unsent = log.never_sent
    network.frame_pump.on_unheard = log.not_heard
    network.listen(SYNC, lambda _data, at: log.stray(at))
    return log


def heard_syncs(
    network: CanopenNetwork, clock: Clock, period: Duration, stall: Stall | None
) -> tuple[SyncLog, HeardSync]:
    """Return the log of SYNCs made by another node on a network's segment, and their pace.

    SocketCAN's cyclic sender has a socket of its own: its frames are received here as from another node.
    """
    basis = network.link.echoes
    log = SyncLog(Duration(0), period, EchoBasis.RECEIPT if basis is EchoBasis.NONE else basis)
    network.frame_pump.on_unheard = log.not_heard
    pace = HeardSync(network.frame_pump, clock, period, log, stall)
    network.frame_pump.on_sync_echo = lambda at, _handed_at: pace.hear(at)
    network.listen(SYNC, lambda _data, at: pace.hear(at))
    return log, pace


def listen_for_syncs(
    config: BenchConfig,
    world: World,
    networks: Mapping[str | None, CanopenNetwork],
    master: Master,
    period: Duration,
) -> tuple[dict[str | None, SyncLog], Pace]:
    """Return the SYNC log of each segment, and the source of the cycles."""
    if config.loop.sync != "own":
        log, heard = heard_syncs(networks[None], world.clock, period, world.faults.host_stall)
        return {None: log}, heard
    syncs = {
        segment: sync_log(network, sync_latency(config.bitrate_on(segment)), period)
        for segment, network in networks.items()
    }
    own = OwnSync(
        master,
        world.clock,
        period,
        list(syncs.values()),
        world.faults.host_stall,
        config.loop.sync_watermark,
    )
    return syncs, own


def masters(first: CanopenNetwork, world: World) -> tuple[dict[str | None, CanopenNetwork], Master]:
    """Return a network on each segment of ``world``, by name, None for the ``first``; and the loop's
    master."""
    networks: dict[str | None, CanopenNetwork] = {None: first}
    if not world.further:
        return networks, first.frame_pump
    for segment in world.further:
        networks[segment.name] = CanopenNetwork(
            segment.link, world.clock, first.node_id, writes=first.writes.allowed
        )
    return networks, SegmentMasters(list(networks.values()), world.wait)


def record_frames(world: World, tap_of: Callable[[int], FrameTap]) -> None:
    """Let ``tap_of(number)`` of each segment have its frames, error frames included."""
    ends: list[World | FurtherSegment] = [world, *world.further]
    for number, end in enumerate(ends):
        tap = tap_of(number)
        end.link.tap(tap)
        end.tap_errors(tap.frame)


@contextmanager
def kernel_sync(bus: can.BusABC, period: Duration) -> Iterator[None]:
    """Let the bus's own cyclic sender make SYNCs. Raises BusDown if it cannot."""
    message = can.Message(arbitration_id=SYNC, is_extended_id=False)
    try:
        task = bus.send_periodic(message, period / NS_PER_S)
    except (can.CanError, OSError, NotImplementedError) as error:
        raise BusDown("the bus's cyclic sender cannot make SYNCs", str(error)) from error
    try:
        yield
    finally:
        # If the interface is down, it sends none; the kernel forgets them when the bus is closed.
        with suppress(can.CanError, OSError):
            task.stop()


def sync_producer(source: str, bus: can.BusABC, period: Duration) -> AbstractContextManager[None]:
    """Return the producer of SYNCs on behalf of this process, while entered; ``source``: ``loop.sync``."""
    return kernel_sync(bus, period) if source == "kernel" else nullcontext()


def check_sync_source(config: BenchConfig, spec: BusSpec) -> None:
    """Raise BadInput if nobody can make the SYNCs of ``config`` on the bus ``spec``."""
    source = config.loop.sync
    if source == "kernel" and not spec.simulated and spec.interface != SOCKETCAN:
        expected = f"'own' or 'foreign' on the bus {spec}"
        why = "only SocketCAN and the bus 'simulated' send cyclic frames by themselves"
        if spec.interface == HUB:
            why += "; on a hub it would be a thread of this process"
        raise BadInput(config.source, "loop.sync", source, expected, why)
    if source == "foreign" and spec.simulated and not _produces_sync(config):
        raise BadInput(
            config.source,
            "loop.sync",
            source,
            "'own' or 'kernel' on the bus 'simulated', where nobody else makes SYNCs",
            "or let a [[bus.background]] with can_id = 0x080 and bytes_max = 0 make them",
        )


def _produces_sync(config: BenchConfig) -> bool:
    return any(entry.can_id == SYNC and not entry.extended for entry in config.bus.background)

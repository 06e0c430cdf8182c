"""A host, a bus and a drive with a clock, as instants only: what attribution is to find out, and the truth.

host     SYNC n handed over at n T + lateness(n), on the bus ``SYNC_LATENCY`` later, lost with ``sync_loss``
drive    hears it ``sync_delay(n)`` after that, stamps, answers
network  brings the answer after ``delay(n)``, or twice, or not at all
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from heapq import heappop, heappush
from itertools import count

from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.beats import Beats
from servobench.hil.loop.order_attribution import OrderAttribution
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.stamp_attribution import StampAttribution
from servobench.hil.loop.syncs import SyncLog
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TRANSIT, reading_at

CALIBRATION = 16
CALIBRATION_PERIODS = 30
"""Between two SYNCs of calibration: longer than any delay here."""


@dataclass
class Network:
    """What befalls SYNCs and readings; times in ns."""

    delay: Callable[[int, random.Random], int | None] = lambda _n, _r: 240_000
    """From the drive's sample until its reading is received; None: lost."""
    sync_delay: Callable[[int, random.Random], int] = lambda _n, _r: 0
    """From the SYNC's end on the bus until the drive hears it."""
    lateness: Callable[[int, random.Random], int] = lambda _n, _r: 0
    duplicate: Callable[[int, random.Random], int | None] = lambda _n, _r: None
    """How much later the same reading comes again; None: it does not."""
    drift_ppm: float = 0.0
    steps: dict[int, int] = field(default_factory=dict)
    """Before which SYNC the drive's clock is set, and by how much."""
    has_clock: bool = True


@dataclass
class Truth:
    """One reading as it was, and where it was placed."""

    sequence: int
    sampled_at: int
    sample: Sample


@dataclass
class Outcome:
    """All readings that were placed."""

    placed: list[Truth]
    by_stamp: StampAttribution
    by_order: OrderAttribution
    told: list[str]

    @property
    def misjudged(self) -> list[Truth]:
        """Readings placed for certain in another cycle than theirs."""
        return [
            truth for truth in self.placed if truth.sample.certain and truth.sample.sequence != truth.sequence
        ]

    @property
    def uncertain(self) -> list[int]:
        return [truth.sequence for truth in self.placed if not truth.sample.certain]

    @property
    def errors(self) -> list[int]:
        """Of the sampling instants placed for certain, sorted."""
        return sorted(
            abs(truth.sample.sampled_at - truth.sampled_at) for truth in self.placed if truth.sample.certain
        )

    @property
    def violations(self) -> list[Truth]:
        """Where the stated interval does not hold the instant."""
        return [
            truth
            for truth in self.placed
            if abs(truth.sample.sampled_at - truth.sampled_at) > truth.sample.sampled_at_error_ns
        ]


class _World:
    """One run of a network."""

    def __init__(self, network: Network, seed: int) -> None:
        self.network = network
        self.choices = random.Random(seed)
        self.log = log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
        self.told: list[str] = []
        self.by_stamp = StampAttribution(log, PERIOD, TRANSIT, self.told.append)
        self.by_order = OrderAttribution(log, PERIOD, TRANSIT, self.told.append, Beats(PERIOD, Duration(0)))
        self.placed: list[Truth] = []
        self._offset = 777_000_123
        self._order = count()
        self._due: list[tuple[int, int, Callable[[], None]]] = []

    def calibrate(self) -> int:
        """SYNCs far apart, answered at once; the instant of the last."""
        at = 0
        for _ in range(CALIBRATION):
            at += CALIBRATION_PERIODS * PERIOD
            mark = self.log.handed(0, Instant(at))
            on_bus = at + SYNC_LATENCY
            self.log.came(Instant(on_bus))
            reading = reading_at(Instant(on_bus + 240_000), self._stamp(on_bus))
            (self.by_stamp if self.network.has_clock else self.by_order).learn(reading, mark)
        return at

    def cycle(self, number: int, due: int) -> None:
        """Hand over the SYNC that is due, late as the host is, or for a probe."""
        handed = due + self.network.lateness(number, self.choices)
        self.run_until(handed)
        probes = self.by_order.wants_probe or self.by_stamp.doubt.wants_probe
        if probes:
            handed = max(handed, due + PERIOD // 4)
            self.run_until(handed)
        self._send_sync(number, handed)
        self.by_stamp.doubt.probed()
        if self.by_order.wants_probe:
            self.by_order.probed(self.log.marks[-1])

    def run_until(self, at: int) -> None:
        """Let everything happen that falls due."""
        while self._due and self._due[0][0] <= at:
            heappop(self._due)[2]()

    def _send_sync(self, number: int, handed: int) -> None:
        network, choices = self.network, self.choices
        self.log.handed(number, Instant(handed))
        on_bus = Instant(handed + SYNC_LATENCY)
        self._call_at(on_bus, lambda: self.log.came(on_bus))
        self._offset += network.steps.get(number, 0)
        sampled = on_bus + network.sync_delay(number, choices)
        shown = self._stamp(sampled)
        delay, again = network.delay(number, choices), network.duplicate(number, choices)
        if delay is None:
            return
        for arrival in [sampled + delay] if again is None else [sampled + delay, sampled + delay + again]:
            self._call_at(arrival, partial(self._receive, number, sampled, shown, arrival))

    def _receive(self, sequence: int, sampled: int, shown: int | None, received: int) -> None:
        reading = reading_at(Instant(received), shown)
        sample = self.by_stamp.place(reading) if shown is not None else self.by_order.place(reading)
        if sample is not None:
            self.placed.append(Truth(sequence, sampled, sample))

    def _call_at(self, at: int, what: Callable[[], None]) -> None:
        heappush(self._due, (at, next(self._order), what))

    def _stamp(self, at: int) -> int | None:
        shown = at + self._offset + int(at * self.network.drift_ppm * 1e-6)
        return shown // 1000 * 1000 if self.network.has_clock else None


def play(network: Network, cycles: int, seed: int = 1) -> Outcome:
    """Calibrate in peace, then run ``cycles`` SYNCs through ``network``."""
    world = _World(network, seed)
    start = world.calibrate() + CALIBRATION_PERIODS * PERIOD
    for number in range(1, cycles + 1):
        world.cycle(number, start + number * PERIOD)
    world.run_until(start + 2 * cycles * PERIOD + NS_PER_S)
    for truth in world.placed:
        came_at = truth.sample.reading.received_at
        amended = world.by_stamp.question.applied(truth.sample, came_at)
        amended = world.by_order.question.applied(amended, came_at)
        assert isinstance(amended, Sample)
        truth.sample = amended
    return Outcome(world.placed, world.by_stamp, world.by_order, world.told)

"""A host, a bus and a drive with a clock, as instants only: what attribution is to find out, and the truth.

host     SYNC n handed over at n T + lateness(n), on the bus ``SYNC_LATENCY`` later, lost with ``sync_loss``
drive    hears it ``sync_delay(n)`` after that, stamps, answers
network  brings the answer after ``delay(n)``, or twice, or not at all
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count

from drivers.frame_port import EchoBasis
from drivers.timebase import Instant
from hil.attribution import OrderAttribution, StampAttribution
from hil.clock_map import ClockMap
from hil.samples import Sample
from hil.syncs import SyncLog
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


def play(network: Network, cycles: int, seed: int = 1) -> Outcome:
    """Calibrate in peace, then run ``cycles`` SYNCs through ``network``."""
    choices = random.Random(seed)
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    told: list[str] = []
    by_stamp = StampAttribution(log, ClockMap(), PERIOD, TRANSIT, told.append)
    by_order = OrderAttribution(log, PERIOD, TRANSIT, told.append)
    offset = 777_000_123

    def stamp(at: int) -> int | None:
        shown = at + offset + int(at * network.drift_ppm * 1e-6)
        return shown // 1000 * 1000 if network.has_clock else None

    at = 0
    for _ in range(CALIBRATION):
        at += CALIBRATION_PERIODS * PERIOD
        mark = log.handed(0, Instant(at))
        on_bus = at + SYNC_LATENCY
        log.came(Instant(on_bus))
        reading = reading_at(Instant(on_bus + 240_000), stamp(on_bus))
        (by_stamp if network.has_clock else by_order).learn(reading, mark)
    start = at + CALIBRATION_PERIODS * PERIOD
    order = count()
    due: list[tuple[int, int, Callable[[], None]]] = []
    placed: list[Truth] = []

    def receive(sequence: int, sampled: int, shown: int | None, received: int) -> None:
        reading = reading_at(Instant(received), shown)
        sample = by_stamp.place(reading) if shown is not None else by_order.place(reading)
        if sample is not None:
            placed.append(Truth(sequence, sampled, sample))

    def sync(number: int, handed: int) -> None:
        nonlocal offset
        log.handed(number, Instant(handed))
        on_bus = handed + SYNC_LATENCY
        heappush(due, (on_bus, next(order), lambda: log.came(Instant(on_bus))))
        offset += network.steps.get(number, 0)
        sampled = on_bus + network.sync_delay(number, choices)
        shown = stamp(sampled)
        delay, again = network.delay(number, choices), network.duplicate(number, choices)
        if delay is not None:
            arrivals = [sampled + delay] if again is None else [sampled + delay, sampled + delay + again]
            for arrival in arrivals:
                heappush(
                    due,
                    (
                        arrival,
                        next(order),
                        lambda arrival=arrival: receive(number, sampled, shown, arrival),  # type: ignore[misc]
                    ),
                )

    for number in range(1, cycles + 1):
        handed = start + number * PERIOD + network.lateness(number, choices)
        while due and due[0][0] <= handed:
            heappop(due)[2]()
        probed = by_order.wants_probe
        if probed:
            handed = max(handed, start + number * PERIOD + PERIOD // 4)
            while due and due[0][0] <= handed:
                heappop(due)[2]()
        sync(number, handed)
        if probed:
            by_order.probed(log.marks[-1])
    while due:
        heappop(due)[2]()
    for truth in placed:
        amended = by_order.question.applied(by_stamp.question.applied(truth.sample))
        assert isinstance(amended, Sample)
        truth.sample = amended
    return Outcome(placed, by_stamp, by_order, told)

"""How a drive stamps: whether its counter runs, its unit, its steps, and whether a SYNC latches it.

Rounds at random distances, before anything is configured: a SYNC, and two reads of the stamp by SDO after it.

    SYNC  |                 |            |
    read     a     b           a  b         a        b      a = b in all rounds: latched when the SYNC arrives

    unit        slope of the counter over the host's clock, by the nearest one that makers use
    resolution  greatest common divisor of its differences; or the grid of a task, rounded to counts
    width       the least power of two modulo which the counter is a straight line, if it was seen to wrap

The latch delay of a stamp cannot be distinguished from a constant delay of the SYNC.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from random import Random
from typing import Final

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration
from servobench.drivers.vendors.stamps import BITS

ROUNDS: Final = 32
"""A step twice as long as the true one would pass for it in one of 2^31 cases."""
WAIT_MAX: Final = 5 * NS_PER_MS
"""Drawn anew before each read, to the ns; a counter of 16 bits of 1 us wraps after 65 ms and is followed."""
SETTLE: Final = Duration(NS_PER_MS)
"""From the SYNC to the first read: a task of 1 kHz has seen it by then."""
UNITS_NS: Final = tuple(
    int(part * 10**power) for power in range(1, 7) for part in (1, 1.25, 1.6, 2, 2.5, 3.2, 4, 5, 6.25, 8)
)
"""Counts of clocks and tasks: decimal, binary parts of a millisecond, bits of a bus. A fifth apart."""
TASKS_HZ: Final = (1000, 2000, 2500, 3000, 4000, 5000, 6000, 8000, 10_000, 12_000, 16_000, 20_000, 25_000)
"""Rates of the inner loops of drives, whose ticks need not be whole counts."""
GRID_COUNTS_MIN: Final = 5
"""A grid of fewer counts cannot be distinguished from single ones after rounding."""
RATE_MAX: Final = 2e-3
"""Largest error of a drive's clock, twice that of a simulated one."""


@dataclass(frozen=True, slots=True)
class StampFigures:
    """Properties of a drive's counter; None if the reads do not decide."""

    object: str
    reads: int
    runs: bool
    """False: it stood still, so a master sets it, or nothing does."""
    at_sync: bool | None
    """True: it changes with a SYNC only, latched at its arrival. None if it does not run."""
    unit_us: float | None
    resolution_us: float | None
    bits: int | None
    """None: it did not wrap during the test."""
    step_chance: float
    """Probability that a counter of finer steps would have looked the same."""


def find_stamp(network: CanopenNetwork, node: int, key: tuple[int, int], seed: int) -> StampFigures | None:
    """Examine the object ``key`` of ``node`` for a third of a second; None if the drive does not have it.

    SYNCs are sent. Raises NoAnswer and AnswersTwice.
    """
    objects, draw = RemoteObjects(network, node), Random(f"stamp {seed} {node}")
    if objects.read_if_there(*key) is None:
        return None
    first, second = _Series(), _Series()
    for _ in range(ROUNDS):
        at = network.frame_pump.send_sync()
        network.pump(network.deadline_after(Duration(SETTLE + draw.randrange(WAIT_MAX))))
        first.add(int(at), *_read(network, objects, key))
        network.pump(network.deadline_after(Duration(draw.randrange(WAIT_MAX))))
        second.add(int(at), *_read(network, objects, key))
    return _figures(object_name(*key), first, second)


class _Series:
    """Reads: when the previous SYNC went out, the middle of the transfer, half of its time, the count."""

    def __init__(self) -> None:
        self.sync_at: list[int] = []
        self.read_at: list[int] = []
        self.half_ns = 0
        self.counts: list[int] = []

    def add(self, sync_at: int, read_at: int, half_ns: int, count: int) -> None:
        self.sync_at.append(sync_at)
        self.read_at.append(read_at)
        self.half_ns = max(self.half_ns, half_ns)
        self.counts.append(count)


def _read(network: CanopenNetwork, objects: RemoteObjects, key: tuple[int, int]) -> tuple[int, int, int]:
    asked = network.clock.now()
    count = objects.read(*key)
    half = (network.clock.now() - asked) // 2
    return asked + half, half, count


def _figures(name: str, first: _Series, second: _Series) -> StampFigures:
    counts = [count for pair in zip(first.counts, second.counts, strict=True) for count in pair]
    chance = 2.0 ** (1 - ROUNDS)
    if len(set(counts)) == 1:
        return StampFigures(name, len(counts), False, None, None, None, None, chance)
    at_sync = first.counts == second.counts
    if at_sync:
        counts, times, error_ns = first.counts, first.sync_at, first.half_ns
    else:
        times = [at for pair in zip(first.read_at, second.read_at, strict=True) for at in pair]
        error_ns = max(first.half_ns, second.half_ns)
    line, bits = _unwrapped(counts, times, error_ns)
    if line is None:
        return StampFigures(name, 2 * ROUNDS, True, at_sync, None, None, bits, chance)
    unit_ns = _unit_ns(line, times, error_ns)
    differences = [count - line[0] for count in line]
    step = math.gcd(*differences)
    resolution_ns = None if unit_ns is None else _resolution_ns(differences, step, unit_ns)
    return StampFigures(
        name,
        2 * ROUNDS,
        True,
        at_sync,
        None if unit_ns is None else unit_ns / NS_PER_US,
        None if resolution_ns is None else resolution_ns / NS_PER_US,
        bits,
        chance,
    )


def _unwrapped(
    counts: Sequence[int], times: Sequence[int], error_ns: int
) -> tuple[list[int] | None, int | None]:
    """Return the unwrapped counts, and the width needed for that; no counts if none fits."""
    if all(later >= earlier for earlier, later in pairwise(counts)):
        return list(counts), None
    for bits in BITS:
        line = [counts[0]]
        for earlier, later in pairwise(counts):
            line.append(line[-1] + (later - earlier) % (1 << bits))
        if max(counts) < 1 << bits and _is_straight(line, times, error_ns):
            return line, bits
    return None, None


def _is_straight(line: Sequence[int], times: Sequence[int], error_ns: int) -> bool:
    """Return True if each count lies on the line through the first and the last one, to twice the errors of
    both and two steps."""
    per_ns = (line[-1] - line[0]) / (times[-1] - times[0])
    most = per_ns * (4 * error_ns + 2 * NS_PER_MS)
    return all(
        abs(count - line[0] - per_ns * (at - times[0])) <= most for count, at in zip(line, times, strict=True)
    )


def _unit_ns(line: Sequence[int], times: Sequence[int], error_ns: int) -> int | None:
    """Return the usual unit nearest to the slope, if the reads decide it."""
    passed_ns, counted = times[-1] - times[0], line[-1] - line[0]
    if counted <= 0:
        return None
    seen_ns = passed_ns / counted
    step = math.gcd(*(count - line[0] for count in line))
    error = RATE_MAX + (2 * error_ns + step * seen_ns) / passed_ns
    fitting = [unit for unit in UNITS_NS if abs(unit / seen_ns - 1.0) <= error]
    return fitting[0] if len(fitting) == 1 else None


def _resolution_ns(differences: Sequence[int], step: int, unit_ns: int) -> float:
    """Return the longest step of which all differences are multiples: of counts, or of ticks rounded to
    counts."""
    for rate_hz in TASKS_HZ:  # the slowest, so the longest, first
        tick = Fraction(NS_PER_S, rate_hz * unit_ns)
        if tick < GRID_COUNTS_MIN or tick <= step:
            break
        over = [difference % tick for difference in differences]
        if all(part <= 1 or part >= tick - 1 for part in over):
            return float(tick * unit_ns)
    return float(step * unit_ns)

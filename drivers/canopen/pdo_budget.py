"""The cost of a PDO plan: the time of each frame, the load, and the shortest possible cycle."""

from collections.abc import Iterable
from typing import NamedTuple

from servobench.drivers.canopen.cob_ids import SYNC
from servobench.drivers.canopen.pdo import PdoMap, PdoPlan, mapping_text
from servobench.drivers.timebase import NS_PER_S, Duration

LOAD_LIMIT_PERCENT = 80.0
"""Above it heartbeats, EMCYs and SDOs wait too long: with 20 % left one SDO transfer fits in two cycles."""
_SDO_BYTES = 8
"""Every SDO frame is full (CiA 301 7.2.4.3)."""


class BudgetLine(NamedTuple):
    """One frame of a cycle."""

    name: str
    cob_id: int
    data_bytes: int
    bits_max: int
    """Worst-case stuff bits and the interframe space included."""
    time_ns: Duration
    a_cycle: float
    """How often it travels in a cycle."""
    content: str


class Budget(NamedTuple):
    """A cycle on the bus."""

    lines: tuple[BudgetLine, ...]
    period_ns: Duration
    bitrate_bit_s: int

    @property
    def busy_ns(self) -> float:
        """Time of all frames in a mean cycle."""
        return sum(line.time_ns * line.a_cycle for line in self.lines)

    @property
    def load_percent(self) -> float:
        """Share of the bus."""
        return 100.0 * self.busy_ns / self.period_ns

    @property
    def fullest_cycle_percent(self) -> float:
        """Share of the bus in a cycle in which every frame travels."""
        return 100.0 * sum(line.time_ns for line in self.lines) / self.period_ns

    @property
    def shortest_period_ns(self) -> Duration:
        """The shortest cycle in which every frame leaves 20 % of the bus to other services."""
        all_of_them = sum(line.time_ns for line in self.lines)
        return Duration(int(all_of_them * 100.0 / LOAD_LIMIT_PERCENT) + 1)

    @property
    def sdo_transfers_a_s(self) -> float:
        """Expedited transfers, request and answer, that fit into the rest of the bus."""
        left = max(0.0, 1.0 - self.load_percent / 100.0)
        return left * self.bitrate_bit_s / (2 * frame_bits_max(_SDO_BYTES))


def budget_of(plans: Iterable[PdoPlan], period_ns: Duration, bitrate_bit_s: int) -> Budget:
    """Return the frames of a cycle: SYNC, every TPDO and every RPDO once; a statusword sent on change
    seldom."""
    lines = [_line("SYNC", SYNC, 0, bitrate_bit_s, 1.0, "")]
    for plan in plans:
        for pdo in plan:
            share, length = pdo.times_a_cycle(period_ns), (pdo.bits + 7) // 8
            lines.append(_line(pdo.name, pdo.cob_id, length, bitrate_bit_s, share, content_of(pdo)))
    return Budget(tuple(lines), period_ns, bitrate_bit_s)


def frame_bits_max(data_bytes: int) -> int:
    """Return the greatest length of a classical frame with an 11-bit identifier, bits, interframe space
    included.

    ISO 11898-1: 34 + 8 n bits are subject to stuffing, one stuff bit for the first five and then one for
    every four; 13 bits follow that are not.
    """
    stuffed = 34 + 8 * data_bytes
    return stuffed + (stuffed - 1) // 4 + 13


def content_of(pdo: PdoMap) -> str:
    """``6041h:00/16 606Ch:00/32``."""
    return mapping_text(entry.mapping_word for entry in pdo.entries)


def _line(name: str, cob_id: int, data_bytes: int, bitrate: int, share: float, content: str) -> BudgetLine:
    bits = frame_bits_max(data_bytes)
    time_ns = Duration(-(-bits * NS_PER_S // bitrate))
    return BudgetLine(name, cob_id, data_bytes, bits, time_ns, share, content)

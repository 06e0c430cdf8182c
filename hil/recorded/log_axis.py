"""One axis of a bench in a log of another program: its PDOs by cycle, its states and its EMCYs."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from servobench.drivers.canopen.objects301 import TPDO_COMMUNICATION
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import STATE_BITS, state_of
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.reviewing.log_content import (
    BusContent,
    CyclicPdo,
    LogContent,
    ObjectValues,
    PdoFrames,
    SyncGrid,
    cyclic_pdo,
    percentiles_us,
)

_READINGS: Final = (
    Object.VELOCITY_ACTUAL_VALUE,
    Object.POSITION_ACTUAL_VALUE,
    Object.TORQUE_ACTUAL_VALUE,
    Object.STATUSWORD,
)
"""The TPDO with the first of these is the reading of the axis."""
_COMMANDS: Final = {
    "cst": Object.TARGET_TORQUE,
    "csv": Object.TARGET_VELOCITY,
    "csp": Object.TARGET_POSITION,
    "ip": Object.TARGET_POSITION,
    "vl": Object.VL_TARGET_VELOCITY,
}


_BOOT_UP: Final = "boot-up"


@dataclass(frozen=True, slots=True)
class PdoReview:
    """A PDO of an axis."""

    frames: PdoFrames
    cyclic: CyclicPdo
    objects: frozenset[int]
    """Indices that are mapped; empty: nobody told the mapping."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        cyclic, delays = self.cyclic, percentiles_us(self.cyclic.delay_ns[self.cyclic.delay_ns >= 0])
        names = ("p50", "p99", "max")
        return {
            "name": self.frames.name,
            "can_id": self.frames.can_id,
            "mapping_known": bool(self.objects),
            "frames": cyclic.frames,
            "every_nth_sync": cyclic.every,
            "cycles_expected": int(np.count_nonzero(cyclic.expected)),
            "lost": int(np.count_nonzero(cyclic.lost)),
            "lost_in_a_row": cyclic.in_a_row(),
            "after_the_next_sync": int(np.count_nonzero(cyclic.late)),
            "uncertain": int(np.count_nonzero(cyclic.uncertain)),
            "extra": cyclic.extra,
            "cycles_behind_the_last": cyclic.behind,
            "delay_us": None if delays is None else dict(zip(names, delays, strict=True)),
        }


@dataclass(frozen=True, slots=True)
class AxisReview:
    """One axis of the bench in the log."""

    name: str
    node: int
    channel: str
    pdos: tuple[PdoReview, ...]
    reading: PdoReview | None
    """The TPDO that its figures are of; None: there is none with the SYNCs."""
    command: PdoReview | None
    objects: Mapping[tuple[int, int], ObjectValues]
    states: tuple[tuple[float, str], ...]
    """Since when, s, and the state."""
    emergencies: tuple[tuple[float, str], ...]
    nmt: tuple[tuple[float, str], ...]
    """Boot-ups and changes of the NMT state, by its heartbeats."""
    heartbeat_gap_s: float | None
    """The longest, but for those behind a boot-up, when none is asked for yet; None: it sends none."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "node": self.node,
            "channel": self.channel,
            "reading": None if self.reading is None else self.reading.frames.name,
            "command": None if self.command is None else self.command.frames.name,
            "pdos": [pdo.as_json() for pdo in self.pdos],
            "states": [{"at_s": at, "state": state} for at, state in self.states],
            "nmt": [{"at_s": at, "state": state} for at, state in self.nmt],
            "emergencies": [{"at_s": at, "text": text} for at, text in self.emergencies],
            "heartbeat_gap_s": self.heartbeat_gap_s,
        }


def axis_review(
    name: str, drive: DriveConfig, content: LogContent, grids: Mapping[str, SyncGrid]
) -> AxisReview:
    """Review one axis; ``grids``: by interface, at least one."""
    bus = _bus_of(drive.node, drive.segment, content)
    grid = grids.get(bus.channel) or next(iter(grids.values()))
    pdos = tuple(_pdo(bus, pdo, grid) for pdo in bus.pdos() if pdo.node == drive.node)
    objects = bus.objects(drive.node)
    begin = content.begin_ns
    beats = [
        entry for entry in bus.entries if entry.kind in ("heartbeat", "guarding") and entry.node == drive.node
    ]
    at_ns = [entry.at_ns or 0 for entry in beats if entry.kind == "heartbeat"]
    booted = np.array([entry.text == _BOOT_UP for entry in beats if entry.kind == "heartbeat"], np.bool_)
    gaps = np.diff(np.array(at_ns, np.int64))[~booted[:-1]]
    gap_s = gaps.max() / NS_PER_S if gaps.size else None
    told = [((entry.at_ns or 0) - begin, entry.text) for entry in beats]
    emergencies = [entry for entry in bus.entries if entry.kind == "emcy" and entry.node == drive.node]
    return AxisReview(
        name,
        drive.node,
        bus.channel,
        pdos,
        _main(pdos, "T", _READINGS),
        _main(pdos, "R", (_COMMANDS[drive.mode],)),
        objects,
        tuple(_states(objects.get((Object.STATUSWORD, 0)), begin)),
        tuple(((each.at_ns or 0) / NS_PER_S - begin / NS_PER_S, each.text) for each in emergencies),
        tuple(_changes(told)),
        None if gap_s is None else float(gap_s),
    )


def _bus_of(node: int, segment: str | None, content: LogContent) -> BusContent:
    """The interface that bears the segment's name, else the one with most PDOs of the node."""
    if segment in content.buses:
        return content.buses[segment]
    buses = list(content.buses.values())
    counts = [sum(pdo.at.size for pdo in bus.pdos() if pdo.node == node) for bus in buses]
    return buses[int(np.argmax(counts))]


def _pdo(bus: BusContent, pdo: PdoFrames, grid: SyncGrid) -> PdoReview:
    objects = bus.decoder.objects(pdo.node)
    number = int(pdo.name[4:])
    told = objects.held(TPDO_COMMUNICATION + number - 1, 2) if pdo.name[0] == "T" else None
    layout = bus.decoder.layout(pdo.can_id)
    mapped = frozenset(field.index for field in (layout.objects or ())) if layout is not None else frozenset()
    return PdoReview(pdo, cyclic_pdo(pdo.at, grid, told), mapped)


def _main(pdos: Sequence[PdoReview], letter: str, objects: Sequence[int]) -> PdoReview | None:
    """The PDO with the first of ``objects`` that comes with the SYNCs; else the one with most frames."""
    cyclic = [pdo for pdo in pdos if pdo.frames.name[0] == letter and pdo.cyclic.every is not None]
    for index in objects:
        for pdo in cyclic:
            if index in pdo.objects:
                return pdo
    return max(cyclic, key=lambda pdo: pdo.cyclic.frames, default=None)


def _states(words: ObjectValues | None, begin_ns: int) -> Iterator[tuple[float, str]]:
    if words is None or not words.raw.size:
        return
    bits = words.raw.astype(np.int64) & STATE_BITS
    for place in np.flatnonzero(np.diff(bits, prepend=-1)):
        state = state_of(int(words.raw[place]))
        told = "no state of CiA 402" if state is None else state.value
        yield (int(words.at[place]) - begin_ns) / NS_PER_S, told


def _changes(told: Sequence[tuple[int, str]]) -> Iterator[tuple[float, str]]:
    before = ""
    for at_ns, text in told:
        if text != before or text == _BOOT_UP:
            yield at_ns / NS_PER_S, text
        before = text

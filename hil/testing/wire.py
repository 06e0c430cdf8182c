"""The frames that a host's adapter sent and received, and expectations about them.

Frames are compared in candump's form, ``201#0F00F401``. In a pattern a dot stands for any hexadecimal digit
and a star at the end for any rest: ``201#0F00*`` is an RPDO1 of node 1 with controlword 000Fh, ``7..#05`` a
heartbeat of any node that is operational, ``.*`` everything.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from struct import Struct
from typing import NamedTuple

from servobench.drivers.canopen.cob_ids import ERROR_CONTROL, SDO_ANSWER, SDO_REQUEST, frame_name
from servobench.drivers.canopen.pdo import PdoDirection, PdoPlan
from servobench.drivers.cia402.drive_setup import with_observed
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import plan_pdos
from servobench.drivers.cia402.pdo_plans import Features, PlanWish
from servobench.drivers.cia402.profile import BENCH_MODES
from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.sheets.dictionary import LoadedDictionary
from servobench.drivers.sheets.fitness import told_by_sheet
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_checks import standard_plan
from servobench.hil.execution.drive_session import data_sheets
from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.reviewing.trace.run_trace import RecordedBus
from servobench.hil.rows.run_files import FRAMES_LOG
from servobench.hil.verdict.arguments import checked

__tracebackhide__ = True
"""Hides this file from pytest's tracebacks: a failed assertion is shown where the test makes it."""
ORIGIN = Instant(0)
SHOWN_MAX = 5
"""Frames that a message lists."""
_PATTERN = re.compile(r"(?P<id>[0-9A-Fa-f.]{3}|[0-9A-Fa-f.]{8})#(?P<data>R|[0-9A-Fa-f.]*)(?P<rest>\*?)")
_SDO_WRITE = 0x20
"""Initiate download: the upper three bits of the command (CiA 301 7.2.4.3.3)."""
_STANDARD_DIGITS = 3


class SeenFrame(NamedTuple):
    """A frame on the wire."""

    at: Instant
    sent: bool
    """True: sent by the host; False: received."""
    can_id: int
    data: bytes
    extended: bool = False
    remote: bool = False

    @property
    def text(self) -> str:
        """The frame in candump's form."""
        digits = 8 if self.extended else _STANDARD_DIGITS
        return f"{self.can_id:0{digits}X}#{'R' if self.remote else self.data.hex().upper()}"

    def described(self, zero: Instant) -> str:
        """Describe it for a message: when, whose, what."""
        whose = "sent" if self.sent else "received"
        return (
            f"{(self.at - zero) / NS_PER_S:.6f} s {whose} {self.text} ({frame_name(self.can_id, self.data)})"
        )


class Controlword(NamedTuple):
    """A controlword sent by PDO or SDO."""

    at: Instant
    word: int


@cache
def _compiled(pattern: str) -> re.Pattern[str]:
    """Compile a frame pattern. Raises ValueError for an invalid one."""
    if pattern == ".*":
        return re.compile(r".*", re.DOTALL)
    match = _PATTERN.fullmatch(pattern)
    if match is None or (len(match["data"]) % 2 and match["data"] != "R"):
        raise ValueError(f"{pattern!r} is no pattern of a frame; write e.g. '201#0F00*' or '7..#05'")
    text = f"{match['id']}#{match['data']}".upper().replace(".", "[0-9A-F]")
    return re.compile(text + (".*" if match["rest"] else ""))


class Wire:
    """Every frame since :meth:`clear`, in the order in which the host's adapter saw it.

    Frames removed by fault injection before they reach the host are not included; removed frames of the host
    are.
    """

    def __init__(
        self, zero: Instant = ORIGIN, frames: Iterable[SeenFrame] = (), recording: Path | None = None
    ) -> None:
        """``zero``: times in messages count from it. ``recording``: the folder of their run."""
        self.zero = zero
        self.recording = recording
        self.frames: list[SeenFrame] = list(frames)

    def take(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, at: Instant
    ) -> None:
        """Take a frame in; fits ``BusLink.tap``."""
        self.frames.append(SeenFrame(at, direction == "tx", can_id, bytes(data), extended, remote))

    def clear(self) -> None:
        """Discard the frames seen so far."""
        self.frames.clear()

    @checked
    def find(self, pattern: str, *, sent: bool | None = None) -> list[SeenFrame]:
        """Return the frames that match; ``sent``: only the host's (True) or only the others' (False)."""
        matches = _compiled(pattern).fullmatch
        return [
            frame for frame in self.frames if (sent is None or frame.sent is sent) and matches(frame.text)
        ]

    @checked
    def between(self, from_s: float, until_s: float) -> "Wire":
        """Return the part of [from_s, until_s), counted from ``zero``."""
        first, end = (self.zero + round(limit * NS_PER_S) for limit in (from_s, until_s))
        return Wire(self.zero, [frame for frame in self.frames if first <= frame.at < end], self.recording)

    @checked
    def assert_seen(self, pattern: str, *, times: int | None = None, sent: bool | None = None) -> None:
        """Assert that a frame matches; ``times``: exactly this many do."""
        frames = self.find(pattern, sent=sent)
        if times is None and not frames:
            raise AssertionError(f"no frame {pattern} among {len(self.frames)}{self._list(self.frames)}")
        if times is not None and len(frames) != times:
            raise AssertionError(f"{len(frames)} frames {pattern}, {times} expected{self._list(frames)}")

    @checked
    def assert_none(self, pattern: str, *, sent: bool | None = None) -> None:
        """Assert that no frame matches."""
        frames = self.find(pattern, sent=sent)
        if frames:
            raise AssertionError(f"{len(frames)} frames {pattern}, none expected{self._list(frames)}")

    @checked
    def assert_sequence(self, *patterns: str, sent: bool | None = None) -> None:
        """Assert that matching frames come in this order; others may be between them."""
        place = 0
        for number, pattern in enumerate(patterns):
            matches = _compiled(pattern).fullmatch
            while place < len(self.frames):
                frame = self.frames[place]
                place += 1
                if (sent is None or frame.sent is sent) and matches(frame.text):
                    break
            else:
                before = f" after {patterns[number - 1]}" if number else ""
                seen = self._list(self.find(pattern, sent=sent), "; there are, too early:")
                raise AssertionError(f"no frame {pattern}{before}{seen}")

    def assert_only(self, intended: Sequence["Intended"], allow: Sequence[str] = ()) -> None:
        """Assert that every frame is one of ``intended``, or matches a pattern of ``allow``."""
        sent = _accepts([rule.pattern for rule in intended if rule.sent is not False] + [*allow])
        received = _accepts([rule.pattern for rule in intended if rule.sent is not True] + [*allow])
        frames = [frame for frame in self.frames if not (sent if frame.sent else received)(frame.text)]
        if frames:
            raise AssertionError(f"{len(frames)} unintended of {len(self.frames)} frames{self._list(frames)}")

    def controlwords(self, node: int, plan: PdoPlan) -> list[Controlword]:
        """Return every controlword to a node, by the RPDOs of its plan or by SDO; consecutive repetitions
        count once."""
        codecs = {
            pdo.cob_id: (pdo.codec(), place)
            for pdo in plan.rpdos
            if (place := pdo.place_of(Object.CONTROLWORD)) is not None
        }
        words: list[Controlword] = []
        for frame in self.frames:
            word = _controlword_in(frame, node, codecs) if frame.sent else None
            if word is not None and (not words or words[-1].word != word):
                words.append(Controlword(frame.at, word))
        return words

    def _list(self, frames: Sequence[SeenFrame], head: str = ":") -> str:
        named = "" if self.recording is None else f"\nrecording: {self.recording}"
        if not frames:
            return named
        lines = [f"  {frame.described(self.zero)}" for frame in frames[:SHOWN_MAX]]
        if len(frames) > SHOWN_MAX:
            lines.append(f"  and {len(frames) - SHOWN_MAX} more")
        return "\n".join([head, *lines]) + named


class Intended(NamedTuple):
    """Frames that belong to normal operation."""

    pattern: str
    sent: bool | None
    """Sent by the host (True), by others (False), or by either."""


def intended_frames(host_node: int, node: int, plan: PdoPlan) -> list[Intended]:
    """Return the regular frames between a host and one drive.

    NMT, SYNC, the host's heartbeat, SDO both ways, the PDOs of the plan in their lengths, the drive's boot-up
    and heartbeat; no EMCY.
    """
    rules = [
        Intended("000#....", True),
        Intended("080#", True),
        Intended(f"{ERROR_CONTROL + host_node:03X}#05", True),
        Intended(f"{SDO_REQUEST + node:03X}#{'.' * 16}", True),
        Intended(f"{SDO_ANSWER + node:03X}#{'.' * 16}", False),
        Intended(f"{ERROR_CONTROL + node:03X}#..", False),
    ]
    for pdo in plan:
        sent = pdo.direction is PdoDirection.RECEIVE
        rules.append(Intended(f"{pdo.cob_id:03X}#{'.' * (pdo.bits // 4)}", sent))
    return rules


def read_wire(folder: Path) -> Wire:
    """Read the wire from a run's folder, in run time. Raises BadInput if it has none."""
    bus = RecordedBus(folder)
    frames = [
        SeenFrame(
            Instant((frame.at_ns or 0) - (bus.zero_ns or 0)),
            frame.sent == "T",
            frame.can_id,
            frame.data,
            frame.extended,
            frame.remote,
        )
        for frame in bus
    ]
    if isinstance(bus.log, BusLog) and bus.log.malformed:
        raise ValueError(f"{folder / FRAMES_LOG}: no line of a candump log: {bus.log.first_malformed}")
    return Wire(frames=frames, recording=folder)


def _accepts(patterns: Sequence[str]) -> Callable[[str], bool]:
    texts = [_compiled(pattern).pattern for pattern in patterns]
    matches = re.compile("|".join(f"(?:{text})" for text in texts)).fullmatch
    return lambda text: matches(text) is not None


def _controlword_in(frame: SeenFrame, node: int, codecs: dict[int, tuple[Struct, int]]) -> int | None:
    """Return the controlword; None for a frame of another length than its mapping (CiA 301 7.2.2.2.1: error
    8210h)."""
    codec = codecs.get(frame.can_id)
    if codec is not None and len(frame.data) == codec[0].size:
        word: int = codec[0].unpack(frame.data)[codec[1]]
        return word
    is_write = frame.can_id == SDO_REQUEST + node and frame.data[:1] and frame.data[0] & 0xE0 == _SDO_WRITE
    if is_write and frame.data[1:4] == Object.CONTROLWORD.to_bytes(2, "little") + b"\0":
        return int.from_bytes(frame.data[4:6], "little")
    return None


def pdo_plans(config: BenchConfig) -> dict[str, PdoPlan]:
    """Return the PDO plan of each axis: by its data sheet if it has one, else the standard one."""
    sheets = data_sheets(config)
    return {
        axis: _plan_by_sheet(config, axis, sheets[axis]) if axis in sheets else standard_plan(config, axis)
        for axis in config.drive
    }


def _plan_by_sheet(config: BenchConfig, axis: str, sheet: LoadedDictionary) -> PdoPlan:
    drive, loop = config.drive[axis], config.loop
    wish = PlanWish(
        BENCH_MODES[drive.mode],
        loop.actuation == "on_sync",
        loop.position_every_cycles,
        features=Features(counted=config.counted(axis)),
        coherent=config.coherent(axis),
        stamp=told_by_sheet(sheet).stamp,
        mode_apart=not drive.observed.entries,
    )
    plan = plan_pdos(capability_of(sheet), drive.node, wish).plan
    return with_observed(plan, drive.node, drive.observed) or plan

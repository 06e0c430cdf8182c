"""A node that sends one frame as another node: what it has heard of that one, altered where it matters."""

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.virtual_bus.frame import Frame

NODE: Final = 1
"""The drive of the bench."""
HOST: Final = 127
PHASES: Final = ("connecting", "running", "stopping")
SENT: Final = {
    "nmt": (0x000, "NMT command (000h)"),
    "sync": (0x080, "SYNC (080h)"),
    "heartbeat": (0x700 + HOST, f"heartbeat of node {HOST}"),
    "drive's heartbeat": (0x700 + NODE, f"heartbeat of node {NODE}"),
    "sdo_write": (0x600 + NODE, "SDO write of"),
    "sdo_answer": (0x580 + NODE, "SDO answer"),
    "rpdo": (0x200 + NODE, f"RPDO1 of node {NODE}"),
    "tpdo, stamped": (0x180 + NODE, f"TPDO1 of node {NODE}"),
    "tpdo": (0x280 + NODE, f"TPDO2 of node {NODE}"),
}
"""By kind, the identifier and what a finding says."""
RUNNING_ALONE: Final = ("drive's heartbeat", "tpdo, stamped", "tpdo")
"""A drive that connects may have these from an earlier session, and heartbeats end with the session."""
WRITTEN: Final = ("607E", "6072", "6065", "6085", "60C2")
ASKED: Final = ("6041", "1000", "6064", "6077")


@dataclass(frozen=True, slots=True)
class Forgery:
    """One frame, and when."""

    kind: str
    phase: str
    at_s: float
    """After power-on."""


class Forger:
    """Sends the frames of ``forgeries``, one at a time, and hears the bus."""

    def __init__(self, forgeries: Sequence[Forgery], draw: Random) -> None:
        self.wake_at: Instant | None = None
        self.sent: dict[Forgery, bytes] = {}
        self._left = sorted(forgeries, key=lambda each: each.at_s)
        self._draw = draw
        self._heard: dict[int, bytes] = {}
        self._zero = Instant(0)

    def start(self, now: Instant) -> Sequence[Frame]:
        self._zero = now
        self._plan()
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        del now
        self._heard[frame.can_id] = frame.data
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        del now
        forgery = self._left.pop(0)
        self._plan()
        can_id, _ = SENT[forgery.kind]
        data = self.sent[forgery] = self._data(forgery.kind, can_id)
        return (Frame(can_id, data),)

    def _plan(self) -> None:
        after = Duration(round(self._left[0].at_s * 1e6) * NS_PER_US) if self._left else None
        self.wake_at = None if after is None else Instant(self._zero + after)

    def _data(self, kind: str, can_id: int) -> bytes:
        """With which a run goes on: no drive is switched off, and no speed is beyond a limit."""
        draw = self._draw
        if kind == "nmt":
            return bytes((draw.choice((3, 7, 250)), draw.choice((0, NODE))))  # none of its commands
        if kind == "sync":
            return b""
        if kind == "heartbeat":
            return b"\x05"
        if kind in ("sdo_write", "sdo_answer"):
            index = bytes.fromhex(draw.choice(WRITTEN if kind == "sdo_write" else ASKED))[::-1]
            command = 0x2B if kind == "sdo_write" else draw.choice((0x4B, 0x60))
            return bytes((command, *index, 0, *draw.randbytes(2), 0, 0))
        data = bytearray(self._heard.get(can_id, bytes(8 if can_id < 0x300 else 1)))
        if kind == "tpdo, stamped":  # the speed, and in one of two frames the stamp of the next SYNC
            data[0] ^= draw.randrange(1, 256)
            stamp = int.from_bytes(data[4:], "little") + draw.choice((0, 1000))
            data[4:] = (stamp & 0xFFFFFFFF).to_bytes(4, "little")
        elif kind in ("tpdo", "rpdo") and data:
            data[-2] ^= draw.randrange(1, 256)
        return bytes(data)

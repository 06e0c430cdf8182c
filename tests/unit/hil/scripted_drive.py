"""A drive of which only the statusword, the position and its answers matter, and who hears all it is told."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.objects402 import CONTROL
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.virtual_bus.frame import Frame
from tests.scenario.foreign_node import put_on_the_bus

DISABLED, READY, SWITCHED_ON, ENABLED = 0x0240, 0x0221, 0x0223, 0x0227
"""Statuswords as drives tell them, with bits beside those of the state."""
STOPPING, REACTING, FAULT, NOT_READY, NO_STATE = 0x0207, 0x020F, 0x0208, 0x0200, 0x026F
QUICK_STOP, DISABLE_VOLTAGE = "word 0002", "word 0000"
PRE_OPERATIONAL, STOP = "nmt 128", "nmt 2"

_STATUS = bytes.fromhex("40416000")
_POSITION = bytes.fromhex("40646000")
_CONTROL = bytes.fromhex("2b406000")
"""Expedited downloads of two bytes, no other: a drive refuses a wrong length."""
_ABORT = b"\x80" + bytes.fromhex("00000206")
"""0602 0000h: there is no such object."""


class ScriptedDrive:
    """``status`` and ``position`` give each answer, asked with the drive.

    A status of None: it says nothing; a position of None: it has none. ``around``: what it answers instead
    of an answer.
    """

    def __init__(
        self,
        status: Callable[["ScriptedDrive"], int | None],
        position: Callable[["ScriptedDrive"], int | None] = lambda _drive: 1000,
        *,
        node: int = 1,
        around: Callable[[Frame], Sequence[Frame]] = lambda frame: (frame,),
    ) -> None:
        self.wake_at: Instant | None = None
        self.told: list[str] = []
        """Controlwords and NMT commands."""
        self.told_ms: list[float] = []
        """When, since its power-on."""
        self.looks = 0
        """How often its statusword was read."""
        self.places = 0
        """How often its position was read."""
        self.asked: list[bytes] = []
        """All SDO requests."""
        self.now_ms = 0.0
        self._status, self._position, self._node = status, position, node
        self._around = around

    def start(self, now: Instant) -> Sequence[Frame]:
        del now
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        del now
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        self.now_ms = now / NS_PER_MS
        if frame.can_id == 0:
            self._note(f"nmt {frame.data[0]}")
        if frame.can_id != 0x600 + self._node or frame.data[0] == 0x80:  # an abort gets no answer
            return ()
        self.asked.append(frame.data)
        answer = self._answer(frame.data[:4], frame.data[4:])
        if answer is None:
            return ()
        return self._around(
            Frame(0x580 + self._node, answer[:1] + frame.data[1:4] + answer[1:].ljust(4, b"\0"))
        )

    def _answer(self, request: bytes, data: bytes) -> bytes | None:
        if request == _STATUS:
            self.looks += 1
            status = self._status(self)
            return None if status is None else b"\x4b" + status.to_bytes(2, "little")
        if request == _POSITION:
            self.places += 1
            place = self._position(self)
            return _ABORT if place is None else b"\x43" + (place & 0xFFFF_FFFF).to_bytes(4, "little")
        if request == _CONTROL:
            self._note(f"word {int.from_bytes(data, 'little'):04x}")
            return b"\x60"
        return _ABORT

    def _note(self, told: str) -> None:
        self.told.append(told)
        self.told_ms.append(self.now_ms)


@contextmanager
def on_a_bus(*drives: ScriptedDrive) -> Iterator[tuple[World, CanopenNetwork]]:
    """A simulated segment with ``drives``, and a network of node 126 on it."""
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 0), []) as world:
        put_on_the_bus(world, *drives)
        yield world, CanopenNetwork(world.link, world.clock, 126, writes=CONTROL)

"""An emulated serial CAN adapter at work: a pseudo-terminal on one side, any bus on the other."""

import select
from collections.abc import Callable
from pathlib import Path

import can

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Clock, Instant
from servobench.drivers.wire.adapters import BusSpec, open_bus
from servobench.drivers.wire.message import frame_of, message_of
from servobench.drivers.wire.slcan_protocol import SlcanStatus
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.instruments.serial_line import DeviceLine, LineFaults, PseudoTerminal
from servobench.virtual_bus.instruments.slcan_adapter import SlcanAdapter

TRANSMIT_FIFO = 64
"""Frames that the adapter holds for the bus."""
POLL_NS = 50 * NS_PER_MS
"""Longest wait, so that ``stop`` is noticed."""
_FRAMES_A_TURN = 256
"""In which a bus at 1 Mbit/s is busy for 12 ms at least: so the host's line waits no longer on a full one."""
NO_FLAGS = SlcanStatus(0)


class BusCan:
    """The adapter's CAN controller, as a participant of ``bus``.

    That a controller which only listens does not acknowledge makes no difference on a hub, where every
    frame is acknowledged; that it sends nothing is seen to by the adapter's firmware.
    """

    def __init__(self, bus: can.BusABC, bitrate_bit_s: int, told: SlcanStatus = NO_FLAGS) -> None:
        """``bitrate_bit_s``: at which the bus runs. ``told``: flags that are always up."""
        self._told = told
        self.right_rate = True
        """The channel was opened at the rate of the bus."""
        self._bus = bus
        self._bitrate_bit_s = bitrate_bit_s
        self._counts_sent = isinstance(bus, HubBus)
        self._under_way = 0
        self._flags = SlcanStatus(0)

    def open(self, bitrate_bit_s: int, listen_only: bool) -> None:  # noqa: ARG002
        self.right_rate = bitrate_bit_s == self._bitrate_bit_s
        self._under_way = 0
        self._flags = SlcanStatus(0)

    def close(self) -> None:
        self._under_way = 0

    def send(self, frame: Frame) -> bool:
        if self._under_way >= TRANSMIT_FIFO:
            return False
        if not self.right_rate:
            # No frame of another rate ever ends well; after 16 attempts the controller is error passive.
            self._under_way += 1
            self._flags |= SlcanStatus.BUS_ERROR | SlcanStatus.ERROR_WARNING | SlcanStatus.ERROR_PASSIVE
            return True
        try:
            self._bus.send(message_of(frame, Instant(0)))
        except can.CanOperationError:
            return False  # full or bus-off; a bus that is gone shows when it is read
        self._under_way += self._counts_sent
        return True

    def sent(self) -> None:
        """A frame of its own has ended on the bus."""
        self._under_way = max(0, self._under_way - 1)

    def flags(self) -> SlcanStatus:
        flags, self._flags = self._flags | self._told, SlcanStatus(0)
        return flags


class AdapterServer:
    """One adapter between ``terminal`` and ``bus``."""

    def __init__(
        self,
        bus: can.BusABC,
        bitrate_bit_s: int,
        terminal: PseudoTerminal,
        clock: Clock,
        faults: LineFaults | None = None,
        seed: int = 0,
    ) -> None:
        faults = faults or LineFaults()
        self.line = DeviceLine(terminal, faults, seed)
        self._bus = bus
        self._can = BusCan(bus, bitrate_bit_s, SlcanStatus(faults.status))
        self._clock = clock
        self._terminal = terminal
        self.adapter = SlcanAdapter(self._can, lambda: self.line.spoiler.strikes("refuse"))

    def serve(self, stop: Callable[[], bool]) -> None:
        """Serve until ``stop()``, or until the adapter is unplugged. Raises BusDown if the bus is gone."""
        self.line.start(self._clock.now())
        try:
            while self._terminal.plugged and not stop():
                self._turn()
        except can.CanError as error:
            raise BusDown("the bus of the emulated adapter went away", str(error)) from error

    def _turn(self) -> None:
        now = self._clock.now()
        for answer in self.adapter.take(self.line.read(now)):
            self.line.send(answer, now)
        for _ in range(_FRAMES_A_TURN):
            message = self._bus.recv(0)
            if message is None:
                break
            self._hear(message, now)
        self.line.flush(now)
        if self._terminal.plugged:
            self._wait(now)

    def _hear(self, message: can.Message, now: Instant) -> None:
        if message.is_error_frame or (self.adapter.is_open and not self._can.right_rate):
            self.adapter.raise_flags(SlcanStatus.BUS_ERROR)
        elif not message.is_rx and isinstance(self._bus, HubBus):
            self._can.sent()
        elif not message.is_fd:
            line = self.adapter.hear(frame_of(message), now)
            if line is not None and not self.line.send(line, now):
                self.adapter.raise_flags(SlcanStatus.RECEIVE_FIFO_FULL)

    def _wait(self, now: Instant) -> None:
        due = self.line.due_at()
        paced = due is not None and due > now
        until = min(due, now + POLL_NS) if due is not None and paced else now + POLL_NS
        blocked = self.line.blocked and not paced
        sources: list[object] = [self._bus]
        if not self.line.holds_back(now):
            sources.append(self._terminal)
        writable = [self._terminal] if blocked else []
        wait_s = max(0, until - self._clock.now()) / NS_PER_S
        select.select(sources, writable, [], wait_s)  # type: ignore[type-var]


def open_far_side(spec: BusSpec, bitrate_bit_s: int | None) -> tuple[can.BusABC, int]:
    """The bus on which an emulated adapter hangs, and its bit rate; a hub that runs keeps its own.

    Raises BusDown or BadInput.
    """
    if spec.interface != "hub":
        bit_s = bitrate_bit_s or 1_000_000
        return open_bus(spec, bit_s, for_link=False).bus, bit_s
    try:
        bus = HubBus(spec.channel, bitrate=bitrate_bit_s, receive_own_messages=True)
    except can.CanError as error:
        raise BusDown(f"cannot join {spec}", str(error), "use the hub's bit rate, or another hub") from error
    return bus, bus.bitrate_bit_s


def serve_adapter(
    spec: BusSpec,
    *,
    bitrate_bit_s: int | None,
    link: Path | None,
    faults: LineFaults,
    seed: int,
    clock: Clock,
    stop: Callable[[], bool],
    announce: Callable[[str, str], None],
) -> None:
    """An emulated adapter as a process, until ``stop()`` or its unplugging.

    ``announce`` is told its port, and what to do with it.
    """
    bus, rate = open_far_side(spec, bitrate_bit_s)
    terminal = None
    try:
        terminal = PseudoTerminal(link)
        server = AdapterServer(bus, rate, terminal, clock, faults, seed)
        text = f"SLCAN adapter on {spec} at {rate} bit/s: --bus slcan:{terminal.name}; Ctrl-C unplugs it"
        announce(terminal.name, text)
        server.serve(stop)
    finally:
        if terminal is not None:
            terminal.unplug()
        bus.shutdown()

"""A serial CAN adapter that speaks the Lawicel protocol, as a bus with a frame port.

Own code beside python-can's, because that one takes a refusal for success, fails with ValueError on a
spoilt line, waits without bound for a port that stands still, and reads byte by byte
(docs/decisions/0012).

The stamps are the instants of reception by the host: the protocol's own have a resolution of 1 ms.
"""

import errno
from collections import deque
from contextlib import suppress
from typing import NoReturn

import can
from can.typechecking import CanFilters

from servobench.drivers.timebase import (
    NEVER,
    NS_PER_MS,
    Clock,
    Duration,
    Instant,
    MonotonicClock,
    instant_after,
)
from servobench.drivers.wire.frame_port import FramePort, WireFrame, accepts
from servobench.drivers.wire.message import frame_of, message_of
from servobench.drivers.wire.serial_line import LineFull, LineGone, SerialLine
from servobench.drivers.wire.slcan_protocol import (
    BITRATE_CODES,
    LineSplitter,
    SlcanLine,
    SlcanStatus,
    decode_frame,
    decode_status,
    encode_frame,
    is_error_report,
    status_text,
)

LINE_BAUD = 115_200
REFUSALS_MAX = 32
"""Consecutive refusals before the adapter counts as failed."""
ANSWER_NS = Duration(250 * NS_PER_MS)
OBEYING_NS = Duration(1500 * NS_PER_MS)
"""Time for a command that sets the CAN controller up."""
LEAVING_NS = Duration(10 * NS_PER_MS)
"""Time for the frames that the adapter has taken: 64 of them at 1 Mbit/s."""
OPENING_ATTEMPTS = 12
"""Requests of 250 ms: boards that start anew when their port is opened need two seconds."""
_AWAITED_MAX = 1024
_TELLING = (b"V", b"N", b"F")
"""Commands whose answer starts with their letter, which identifies them."""


class SlcanPort(FramePort):
    """The frames of an :class:`SlcanBus`.

    They are stamped when they are taken in. The adapter's acknowledgement does not prove that a frame was on
    the bus: there are no echoes, unless the bus was opened with ``receive_own_messages``.
    """

    def __init__(self, bus: "SlcanBus") -> None:
        super().__init__()
        self.needs_watching = True
        self._bus = bus

    def receive(self, until: Instant) -> WireFrame | None:
        received = self._bus._receive(until)
        if received is None:
            return None
        frame, self.came_at, self.came_own = received
        return frame

    def transmit(self, frame: WireFrame) -> None:
        """Hand ``frame`` to the adapter without waiting. Raises can.CanOperationError."""
        self._bus._transmit(frame)


class SlcanBus(can.BusABC):
    """One serial adapter, as a participant of its bus.

    ``recv`` and ``send`` raise can.CanOperationError if the adapter is gone, does not take what is written,
    or has refused 32 frames one after another.
    """

    def __init__(
        self,
        channel: str,
        can_filters: CanFilters | None = None,
        *,
        bitrate: int = 1_000_000,
        tty_baudrate: int = LINE_BAUD,
        listen_only: bool = False,
        receive_own_messages: bool = False,
        clock: Clock | None = None,
        **_: object,
    ) -> None:
        """Open the port and then the adapter's CAN channel.

        ``tty_baudrate``: speed of the serial line, baud; USB adapters ignore it. Raises
        can.CanInitializationError if no adapter answers or it refuses the bit rate, OSError if the port
        cannot be opened.
        """
        if bitrate not in BITRATE_CODES:
            known = ", ".join(map(str, BITRATE_CODES))
            raise can.CanInitializationError(f"an SLCAN adapter has no {bitrate} bit/s; it has {known}")
        self.channel_info = f"slcan:{channel}"
        self._is_shutdown = False
        self._filters: CanFilters | None = None
        self.refused_frames = 0
        """Frames that the adapter did not take."""
        self.malformed_lines = 0
        """Lines outside the protocol: cut, spoilt, or of an unknown kind."""
        self.error_reports = 0
        self.adapter_status = SlcanStatus(0)
        """The last flags received; requested whenever a frame is refused, and by :meth:`status`."""
        self.acknowledges = True
        """True if the adapter answers each command; some firmwares never do."""
        self.version = self.serial_number = ""
        self._clock = clock or MonotonicClock()
        self._splitter = LineSplitter()
        self._inbox: deque[tuple[WireFrame, Instant, bool]] = deque()
        self._awaited: deque[WireFrame | bytes] = deque(maxlen=_AWAITED_MAX)
        """Items that the adapter still has to answer, in order: frames, and texts of commands."""
        self._answer: SlcanLine | None = None
        self._refusals = 0
        self._asked_why_at = Instant(0)
        self._own = receive_own_messages
        self.frame_port = SlcanPort(self)
        self._listen_only = listen_only
        self._bitrate_bit_s = bitrate
        self._line = SerialLine(channel, tty_baudrate)
        try:
            self._start()
        except BaseException:
            self._is_shutdown = True
            self._line.close()
            raise
        super().__init__(channel, can_filters)

    def _transmit(self, frame: WireFrame) -> None:
        self._check_open()
        if self._listen_only:
            raise can.CanOperationError(f"{self.channel_info} only listens")
        try:
            self._line.write(encode_frame(frame))
        except LineFull:
            full = f"{self.channel_info}: transmit queue is full"
            raise can.CanOperationError(full, errno.ENOBUFS) from None
        except LineGone as error:
            self._lost(error)
        if self.acknowledges:
            self._awaited.append(frame)

    # ---- python-can's interface -----------------------------------------------------------------------

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next message; None after ``timeout`` seconds."""
        until = NEVER if timeout is None else instant_after(self._clock.now(), timeout)
        received = self._receive(until)
        if received is None:
            return None
        frame, at, own = received
        return message_of(frame, at, is_rx=not own, channel=str(self.channel_info))

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand ``msg`` to the adapter, waiting up to ``timeout`` seconds for room."""
        frame = frame_of(msg)
        deadline = instant_after(self._clock.now(), timeout or 0.0)
        while self._line.held_bytes and self._clock.now() < deadline:
            self._take(deadline)
        self._transmit(frame)

    def fileno(self) -> int:
        """Return the serial port, for an event loop to watch. Frames read already do not show there."""
        return self._line.fileno()

    @property
    def state(self) -> can.BusState:
        """PASSIVE if the adapter last reported it; see :meth:`status`."""
        return (
            can.BusState.PASSIVE if self.adapter_status & SlcanStatus.ERROR_PASSIVE else can.BusState.ACTIVE
        )

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        """Raise NotImplementedError: the state belongs to the adapter."""
        raise NotImplementedError("the error state follows the adapter's error counters")

    def status(self) -> SlcanStatus:
        """Read the adapter's flags, which clears them; frames that come meanwhile are kept."""
        self._ask(b"F")
        return self.adapter_status

    def trouble(self) -> str:
        """Describe the problems so far; empty if there were none."""
        counts = {
            "frames refused by the adapter": self.refused_frames,
            "spoilt lines from the adapter": self.malformed_lines + self._splitter.overlong,
            "error reports of the adapter": self.error_reports,
        }
        return ", ".join(f"{count} {what}" for what, count in counts.items() if count)

    def shutdown(self) -> None:
        """Close the CAN channel and the port; frames sent before still go out."""
        if self._is_shutdown:
            return
        try:
            self._let_go_out()
            self._line.write(b"C\r")
        except (can.CanError, OSError):
            pass  # it is gone, or stands still: nothing is left to close
        finally:
            super().shutdown()
            self._line.close()

    # ---- inside ---------------------------------------------------------------------------------------

    def _receive(self, until: Instant) -> tuple[WireFrame, Instant, bool] | None:
        self._check_open()
        while True:
            while self._inbox:
                received = self._inbox.popleft()
                if self._filters is None or accepts(self._filters, received[0]):
                    return received
            if not self._take(until) and self._clock.now() >= until:
                return None

    def _take(self, until: Instant) -> bool:
        """Take in received bytes, else wait for some until then; False if none came."""
        try:
            data = self._line.read()
            if not data:
                if self._clock.now() >= until:
                    return False
                self._line.wait(until, self._clock)
                data = self._line.read()
        except LineGone as error:
            self._lost(error)
        if not data:
            return False
        now = self._clock.now()
        for line in self._splitter.feed(data):
            self._note(line, now)
        # the reason, asked for after the first refusal, is worth a little patience
        reason_known = b"F" not in self._awaited or now - self._asked_why_at > ANSWER_NS
        if self._refusals >= REFUSALS_MAX and reason_known:
            count, self._refusals = self._refusals, 0
            raise can.CanOperationError(
                f"{self.channel_info}: the adapter refused {count} frames one after another:"
                f" {status_text(self.adapter_status)}"
            )
        return True

    def _note(self, line: SlcanLine, now: Instant) -> None:
        text = line.text
        if not line.refused and text[:1] in (b"t", b"T", b"r", b"R"):
            frame = decode_frame(text)
            if frame is None:
                self.malformed_lines += 1
            else:
                self._inbox.append((frame, now, False))
        elif is_error_report(text):
            self.error_reports += 1
        elif text not in (b"", b"z", b"Z") and text[:1] not in (b"F", b"V", b"N"):
            self.malformed_lines += 1
        else:
            self._settle(line, now)

    def _settle(self, line: SlcanLine, now: Instant) -> None:
        """Match an answer to the oldest command outstanding, or to the one that it names."""
        letter = line.text[:1]
        if letter in _TELLING:
            while self._awaited:
                if self._awaited.popleft() == letter:
                    self._answered(line)
                    return
            return
        if not self._awaited:
            return
        awaited = self._awaited.popleft()
        if isinstance(awaited, bytes):
            self._answered(line)
        elif line.refused:
            self.refused_frames += 1
            self._refusals += 1
            if self._refusals == 1:
                self._request_status()
        else:
            self._refusals = 0
            if self._own:
                self._inbox.append((awaited, now, True))

    def _request_status(self) -> None:
        """Request the flags for a reason; the answer is taken in when it comes."""
        with suppress(OSError):  # a port that is gone shows at the next call
            self._line.write(b"F\r")
            self._awaited.append(b"F")
            self._asked_why_at = self._clock.now()

    def _answered(self, line: SlcanLine) -> None:
        self._answer = line
        flags = decode_status(line.text)
        if flags is not None:
            self.adapter_status = flags

    def _start(self) -> None:
        """Bring the adapter from any state to an open channel."""
        name = str(self.channel_info)
        if not self._wake_up():
            raise can.CanInitializationError(
                f"no SLCAN adapter answers on {self._line.name}; check the port and the line speed behind '@'"
            )
        self._command(b"S%d" % BITRATE_CODES[self._bitrate_bit_s], f"{name} refuses its bit rate")
        if self.acknowledges:
            # CAN232 hands frames out only on request until told otherwise; others refuse to know of it.
            self._ask(b"X1")
        self._command(b"L" if self._listen_only else b"O", f"{name} does not open its CAN channel")
        self._inbox.clear()

    def _wake_up(self) -> bool:
        """Close the channel; False if no adapter answers."""
        for _ in range(OPENING_ATTEMPTS):
            self._line.write(b"\r\r\r")  # whatever was typed in part before is ended, as the manual advises
            self._drain()
            closed = self._ask(b"C")
            version = self._ask(b"V")
            if version is None:
                continue
            self.acknowledges = (closed or self._ask(b"C")) is not None
            self.version = _value(version)
            self.serial_number = _value(self._ask(b"N"))
            return True
        return False

    def _command(self, text: bytes, refusal: str) -> None:
        if not self.acknowledges:
            self._line.write(text + b"\r")
            return
        answer = self._ask(text, OBEYING_NS)
        if answer is None or answer.refused:
            said = "no answer came" if answer is None else "it was answered with BEL"
            raise can.CanInitializationError(f"{refusal}: {said}")

    def _ask(self, text: bytes, patience: Duration = ANSWER_NS) -> SlcanLine | None:
        """Send a command and await its answer; None if none comes."""
        self._answer = None
        try:
            self._line.write(text + b"\r")
        except LineGone as error:
            self._lost(error)
        except LineFull:
            return None
        self._awaited.append(text)
        deadline = Instant(self._clock.now() + patience)
        while self._answer is None or text in self._awaited:
            if not self._take(deadline) and self._clock.now() >= deadline:
                if text in self._awaited:
                    self._awaited.remove(text)
                return None
        return self._answer

    def _let_go_out(self) -> None:
        """Wait until the adapter has taken all frames and had time to send them: closing drops the rest."""
        deadline = Instant(self._clock.now() + ANSWER_NS)
        while (self._awaited or self._line.held_bytes) and self._clock.now() < deadline:
            self._take(deadline)
        deadline = Instant(self._clock.now() + LEAVING_NS)
        while self._clock.now() < deadline:
            self._take(deadline)

    def _drain(self) -> None:
        """Discard earlier input."""
        deadline = Instant(self._clock.now() + 20 * NS_PER_MS)
        while self._clock.now() < deadline:
            self._take(deadline)
        self._inbox.clear()
        self._awaited.clear()

    def _check_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")

    def _lost(self, error: OSError) -> NoReturn:
        if isinstance(error, LineGone) and not self._is_shutdown:
            raise can.CanOperationError(f"{self.channel_info}: the adapter was unplugged; {error}") from error
        raise can.CanOperationError(f"{self.channel_info}: {error}") from error


def _value(line: SlcanLine | None) -> str:
    """Return the text of an answer after its letter."""
    return "" if line is None or line.refused else line.text[1:].decode("ascii", "replace")

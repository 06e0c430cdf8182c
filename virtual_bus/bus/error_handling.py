"""A segment on which things go wrong: error frames, repetition, and the fault confinement of its ports.

A segment works without this as long as nobody asks for it. From then on each attempt to send is
settled 1 ns after its start of frame, when the arbitration is closed, for all its length; only a port
that is pulled off the wire meanwhile changes it. Clauses: Bosch CAN 2.0, part B (ISO 11898-1).

A controller that comes back from bus-off counts 11 recessive bits once for each frame that it sees
end (ACK or error delimiter, end of frame, intermission) and once for every 11 bits of idle bus.

One attempt to send, among the controllers of a segment: who got the frame, and what it cost.

Where nothing can go wrong the outcome is known without a look at single bits.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.virtual_bus.bus.controller import (
    RECOVERY_SEQUENCE_BITS,
    RECOVERY_SEQUENCES,
    SUSPEND_BITS,
    CanController,
    ErrorState,
)
from servobench.virtual_bus.bus.disturbance import BusError, Disturbance, ErrorKind
from servobench.virtual_bus.bus.error_frame import BITS_MAX, Node, attempt
from servobench.virtual_bus.bus.frame_image import (
    FrameImage,
    bits_duration,
    frame_bits,
    frame_image,
    resampled,
)
from servobench.virtual_bus.bus.port import Port
from servobench.virtual_bus.frame import Frame

if TYPE_CHECKING:
    from servobench.virtual_bus.bus.segment import CanSegment


class Trial(NamedTuple):
    """How an attempt goes, if nothing more happens to it."""

    completed: bool
    """Its sender holds the frame to be sent."""
    accepted: tuple[int, ...]
    """The ranks of the ports that hold it to be good."""
    frame_bits: int
    """From start of frame to the end of frame, or to where the last error delimiter ends."""
    bits: int
    """The same with an overload frame behind it."""
    error: tuple[int, ErrorKind] | None
    nodes: Mapping[int, Node]
    """The nodes by rank; empty if no counter goes up."""


def undisturbed(frame: Frame, sender: int, controllers: Mapping[int, CanController], bitrate: int) -> Trial:
    """A frame that everybody understands and somebody acknowledges."""
    bits = frame_bits(frame)
    accepted = tuple(rank for rank, one in controllers.items() if rank != sender and one.hears(bitrate))
    return Trial(True, accepted, bits, bits, None, {})


def is_plain(sender: int, controllers: Mapping[int, CanController], bitrate: int, acknowledged: bool) -> bool:
    """Return True if an undisturbed attempt is certain to succeed."""
    if not controllers[sender].hears(bitrate):
        return False
    for rank, one in controllers.items():
        if rank == sender or not one.on_bus or one.listen_only:
            continue
        if one.bitrate_bit_s != bitrate:
            return False
        acknowledged = True
    return acknowledged


class Conditions(NamedTuple):
    """Conditions of an attempt."""

    bitrate_bit_s: int
    acknowledged: bool
    """Something that is no port acknowledges every frame."""
    disturbance: Disturbance | None = None
    cut_at: int = BITS_MAX
    """Bit at which the sender leaves the wire."""


def bit_by_bit(
    frame: Frame,
    sender: int,
    controllers: Mapping[int, CanController],
    names: Mapping[int, str],
    conditions: Conditions,
) -> Trial:
    """The attempt on the wire. ``controllers``, ``names``: by rank, of all that are attached."""
    bitrate = conditions.bitrate_bit_s
    nodes = {
        rank: Node(
            sends=rank == sender,
            passive=one.state is ErrorState.PASSIVE,
            listen_only=one.listen_only,
            rate=one.bitrate_bit_s / bitrate,
        )
        for rank, one in controllers.items()
        if rank == sender or one.on_bus
    }
    image = frame_image(frame)
    if not controllers[sender].hears(bitrate) and controllers[sender].bitrate_bit_s != bitrate:
        image = resampled(image, controllers[sender].bitrate_bit_s / bitrate)
    result = attempt(
        image,
        list(nodes.values()),
        _flipped(conditions.disturbance, nodes, names, sender, image),
        acknowledged=conditions.acknowledged,
        cut_at=conditions.cut_at,
    )
    accepted = tuple(rank for rank, node in nodes.items() if node.accepted and rank != sender)
    length = min(image.last + 1, result.bits) if result.sent else result.bits
    return Trial(result.sent, accepted, length, result.bits, result.error, nodes)


def _flipped(
    disturbance: Disturbance | None,
    nodes: Mapping[int, Node],
    names: Mapping[int, str],
    sender: int,
    image: FrameImage,
) -> tuple[int, list[Node]] | None:
    if disturbance is None:
        return None
    victims = [
        node
        for rank, node in nodes.items()
        if disturbance.receivers is None or (rank != sender and names[rank] in disturbance.receivers)
    ]
    return min(max(disturbance.bit, 0), image.last), victims


INTEGRATION_BITS = 11
"""Recessive bits that a node sees before it takes part (ISO 11898-1, bus integration)."""
_TAIL_BITS = 8
"""Recessive bits at the end of a frame (ACK delimiter, end of frame) and of an error frame."""


class ErrorHandling:
    """Takes over the arbitration of ``segment``."""

    def __init__(self, segment: "CanSegment") -> None:
        self._segment = segment
        self._timeline = segment.timeline
        self._under_way = False
        self._sender: Port | None = None
        self._frame: Frame | None = None
        self._start_at = Instant(0)
        self._end_at = Instant(0)
        self._trial: Trial | None = None
        self._conditions = Conditions(segment.bitrate_bit_s, segment.acknowledged)
        self._leaving: list[Port] = []

    def choose(self) -> None:
        """Let the port begin that can do so first and, among several, wins the arbitration."""
        segment = self._segment
        if self._under_way or segment.delivering:
            return
        free_at = max(self._timeline.now, segment.free_at)
        best: tuple[Instant, int, int] | None = None
        sender: Port | None = None
        for port in (*segment.ports, *self._leaving):
            controller = port.controller
            key = port.key
            if key is None or not controller.can_send:
                continue
            rank = max(free_at, controller.suspended_until), key, port.rank
            if best is None or rank < best:
                best, sender = rank, port
        if best is None or (sender is self._sender and best[0] == self._start_at):
            self._sender = sender
            return
        self._sender = sender
        self._start_at = best[0]
        self._timeline.post(Instant(best[0] + 1), self._begin)

    def left(self, port: Port) -> None:
        """``port`` was detached; what it has queued still goes out."""
        if port.pending:
            self._leaving.append(port)

    def pull_off(self, port: Port) -> None:
        """``port`` has just left the wire: a frame of its own under way breaks off."""
        if self._under_way and self._trial is not None and self._trial.error is None:
            bit = (self._timeline.now - self._start_at) * self._segment.bitrate_bit_s // NS_PER_S
            if port is self._sender and bit < self._trial.frame_bits:
                self._settle(self._conditions._replace(cut_at=bit))
            elif port.rank in self._trial.accepted and bit < self._trial.frame_bits - 9:
                self._settle(self._conditions)
        self.choose()

    def plug(self, port: Port) -> None:
        """``port`` is on the wire again: it waits for 11 recessive bits."""
        integrated = self._timeline.now + self._bits(INTEGRATION_BITS)
        port.controller.suspended_until = max(port.controller.suspended_until, Instant(integrated))
        self.choose()

    def force_off(self, port: Port) -> None:
        """``port`` goes bus-off at once."""
        if port.controller.state is ErrorState.BUS_OFF:
            return
        port.controller.force_off()
        self.pull_off(port)
        self._enter(port, ErrorState.BUS_OFF, self._timeline.now)

    def recover(self, port: Port) -> None:
        """``port`` begins to look for 128 times 11 recessive bits (rule 12)."""
        controller = port.controller
        if controller.state is not ErrorState.BUS_OFF or controller.recovery_left:
            return
        controller.recovery_left = RECOVERY_SEQUENCES
        controller.recovery_from = self._timeline.now
        if not self._under_way:
            self._await_recovery(controller)

    def adopt(self) -> None:
        """Go on from where the segment is."""
        segment = self._segment
        sender, contenders = segment.hand_over(self)
        waiting = contenders if sender is None else (*contenders, sender)
        self._leaving = [port for port in waiting if port not in segment.ports]
        if sender is None or self._timeline.now <= segment.start_at:
            self.choose()
            return
        self._sender, self._under_way = sender, True
        self._start_at, self._end_at = segment.start_at, segment.end_at
        self._frame = sender.head
        assert self._frame is not None
        controllers = self._controllers()
        self._trial = undisturbed(self._frame, sender.rank, controllers, segment.bitrate_bit_s)
        self._timeline.post(self._end_at, self._finish)

    def _controllers(self) -> dict[int, CanController]:
        controllers = {port.rank: port.controller for port in self._segment.ports}
        if self._sender is not None:
            controllers.setdefault(self._sender.rank, self._sender.controller)
        return controllers

    def _bits(self, bits: int) -> Duration:
        return bits_duration(bits, self._segment.bitrate_bit_s)

    def _begin(self, now: Instant) -> None:
        """The start of frame has passed: nobody else can begin any more."""
        sender = self._sender
        if self._under_way or sender is None or now != self._start_at + 1:
            return  # another port, or another instant, was chosen since
        segment = self._segment
        self._under_way = True
        self._frame = frame = sender.head
        assert frame is not None
        self._count_idle_bits()
        judge = segment.disturb
        disturbance = None if judge is None else judge(sender.name, frame, self._start_at)
        self._settle(Conditions(segment.bitrate_bit_s, segment.acknowledged, disturbance))

    def _settle(self, conditions: Conditions) -> None:
        """Work out how the attempt goes, and wait for its end."""
        segment, sender, frame = self._segment, self._sender, self._frame
        assert sender is not None
        assert frame is not None
        self._conditions = conditions
        controllers = self._controllers()
        rate, rank = segment.bitrate_bit_s, sender.rank
        quiet = conditions.disturbance is None and sender.controller.on_bus
        if quiet and is_plain(rank, controllers, rate, segment.acknowledged):
            self._trial = trial = undisturbed(frame, rank, controllers, rate)
        else:
            names = {port.rank: port.name for port in segment.ports}
            self._trial = trial = bit_by_bit(frame, rank, controllers, names, conditions)
        self._end_at = Instant(max(self._start_at + self._bits(trial.frame_bits), self._timeline.now))
        self._timeline.post(self._end_at, self._finish)

    def _finish(self, now: Instant) -> None:
        """The frame or its error frame is over: count, hand out, and choose the next."""
        segment, sender, trial, frame = self._segment, self._sender, self._trial, self._frame
        if not self._under_way or now != self._end_at:
            return  # the end of an attempt that took another course
        assert sender is not None
        assert trial is not None
        assert frame is not None
        self._under_way, self._sender = False, None
        wire_free_at = max(self._start_at + self._bits(trial.bits), now)
        segment.free_at = free_at = Instant(wire_free_at + segment.intermission_ns)
        segment.load.add(free_at - self._start_at, free_at)
        if trial.completed:
            segment.frames += 1
        if trial.completed:
            sender.take_head()  # none is there if it went off in this instant
        states = self._count(sender, trial)
        if sender.controller.state is ErrorState.PASSIVE:
            sender.controller.suspended_until = Instant(free_at + self._bits(SUSPEND_BITS))
        if sender in self._leaving and not sender.pending:
            self._leaving.remove(sender)
        self._restart_recoveries(Instant(wire_free_at - self._bits(_TAIL_BITS)))
        segment.delivering = True
        try:
            self._hand_out(sender, frame, trial, now)
            for port, state in states:
                self._enter(port, state, now)
        finally:
            segment.delivering = False
            self.choose()

    def _hand_out(self, sender: Port, frame: Frame, trial: Trial, now: Instant) -> None:
        segment = self._segment
        if trial.completed or trial.accepted:
            for monitor in segment.monitors:
                monitor(frame, now)
        for port in segment.ports:
            listener = port.listener
            if listener is not None and port.rank in trial.accepted and port.controller.on_bus:
                listener.on_frame(frame, now)
        if trial.completed and sender.on_sent is not None:
            sender.on_sent(frame, now)
        if trial.error is not None and not trial.completed:
            segment.errors += 1
            bit, kind = trial.error
            error = BusError(now, kind, sender.name, frame, bit, trial.bits)
            for on_error in segment.error_monitors:
                on_error(error)

    def _count(self, sender: Port, trial: Trial) -> list[tuple[Port, ErrorState]]:
        """Move the counters; returns who is in another state now."""
        ports = (*self._segment.ports, *(port for port in self._leaving if port is sender))
        changed = []
        for port in ports:
            controller = port.controller
            before = controller.state
            if before is ErrorState.BUS_OFF:
                continue
            if (node := trial.nodes.get(port.rank)) is not None:
                controller.take(node)
            elif port is sender:
                controller.sent_well()
            elif port.rank in trial.accepted:
                controller.received_well()
            if controller.state is not before:
                changed.append((port, controller.state))
        return changed

    def _enter(self, port: Port, state: ErrorState, now: Instant) -> None:
        """Tell the port's owner; a controller that went off forgets what it had to send."""
        if state is ErrorState.BUS_OFF:
            port.clear()
            port.room = 0
            if port in self._leaving:
                self._leaving.remove(port)
            if port.recover_after_ns is not None:
                due = Instant(now + port.recover_after_ns)
                self._timeline.post(due, lambda _now: self.recover(port))
        if port.on_error_state is not None:
            port.on_error_state(state, now)

    def _count_idle_bits(self) -> None:
        """A frame begins: what recovering controllers have seen of the idle bus before it counts."""
        sequence = self._bits(RECOVERY_SEQUENCE_BITS)
        for controller in self._recovering():
            seen = max(self._start_at - controller.recovery_from, 0) // sequence
            controller.recovery_left = max(controller.recovery_left - seen, 1)

    def _restart_recoveries(self, recessive_from: Instant) -> None:
        for controller in self._recovering():
            controller.recovery_from = max(controller.recovery_from, recessive_from)
            self._await_recovery(controller)

    def _recovering(self) -> list[CanController]:
        return [port.controller for port in self._segment.ports if port.controller.recovery_left]

    def _await_recovery(self, controller: CanController) -> None:
        bits = controller.recovery_left * RECOVERY_SEQUENCE_BITS
        self._timeline.post(Instant(controller.recovery_from + self._bits(bits)), self._end_recoveries)

    def _end_recoveries(self, now: Instant) -> None:
        if self._under_way:
            return
        for port in self._segment.ports:
            controller = port.controller
            bits = controller.recovery_left * RECOVERY_SEQUENCE_BITS
            if controller.recovery_left and now >= controller.recovery_from + self._bits(bits):
                controller.come_back()
                port.reopen()
                if port.on_error_state is not None:
                    port.on_error_state(ErrorState.ACTIVE, now)
        self.choose()

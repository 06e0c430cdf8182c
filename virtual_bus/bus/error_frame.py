"""One attempt to send a frame, bit by bit, with every node's error handling.

ISO 11898-1, in the numbering of Bosch's CAN 2.0, part B: 3.1.3 error frame, 6 bit stuffing,
7 error handling, 8 fault confinement (the rules cited below). Each node samples the wired-AND
of what all drive, and drives in the next bit what it made of that. Error flags therefore pile
up to 6 to 12 dominant bits as they do on a wire, and the counters follow from what was seen.

Two things are not modelled bit by bit. A receiver that saw a wrong level without breaking
the stuffing is taken to find the CRC wrong and to stay in step; and a node of another bit rate
is hard-synchronised at the start of frame, sees no delimiter, and gives up at the ACK
delimiter at the latest.
"""

from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

from servobench.virtual_bus.bus.disturbance import ErrorKind
from servobench.virtual_bus.bus.frame_image import DOMINANT, RECESSIVE, SAMPLE_POINT, FrameImage

FLAG_BITS = 6
DELIMITER_BITS = 8
BITS_MAX = 2_000
"""Far beyond the longest frame with the longest pile of flags; a bound for the loop."""
_TOLERATED_DOMINANT = 8
"""Dominant bits behind a flag at which rule 6 begins to count, and the step in which it goes on."""


class _Phase(Enum):
    FRAME = 0
    FLAG = 1
    WAIT = 2
    DELIMITER = 3
    DONE = 4


class Node:
    """One controller during one attempt."""

    def __init__(
        self, *, sends: bool = False, passive: bool = False, listen_only: bool = False, rate: float = 1.0
    ) -> None:
        """``rate``: the node's bit rate over that of the bus."""
        self.sends = sends
        self.passive = passive
        self.listen_only = listen_only
        self.rate = rate
        self.transmit_errors = 0
        """Increase of the transmit error counter by the attempt."""
        self.receive_errors = 0
        """Increase of the receive error counter."""
        self.accepted = False
        """A receiver that holds the frame to be good: no error up to the last but one bit (5)."""
        self.completed = False
        """A sender that holds its frame to be sent: no error up to the last bit (5)."""
        self.detected: tuple[int, ErrorKind] | None = None
        """The first error that the node found, and where."""
        self._phase = _Phase.FRAME
        self._driven = RECESSIVE
        self._run = 0
        self._last = -1
        self._wrong = False
        self._flag_left = 0
        self._dominant = 0
        self._forgiven = False
        self._own_clock = SAMPLE_POINT / rate

    @property
    def in_frame(self) -> bool:
        """True while it still follows the frame."""
        return self._phase is _Phase.FRAME

    @property
    def done(self) -> bool:
        """True once the node waits for the next frame."""
        return self._phase is _Phase.DONE

    @property
    def busy(self) -> bool:
        """True while it handles an error or an overload."""
        return self._phase in (_Phase.FLAG, _Phase.WAIT, _Phase.DELIMITER)

    def drive(self, bit: int, image: FrameImage, cut_at: int) -> int:
        """The level that the node puts on the wire in ``bit``; a sender stops at ``cut_at``."""
        level = RECESSIVE
        if self._phase is _Phase.FLAG:
            level = RECESSIVE if self.passive or self.listen_only else DOMINANT
        elif self._phase is _Phase.FRAME:
            if self.sends:
                level = image.levels[bit] if bit < cut_at else RECESSIVE
            elif bit == image.acknowledge and not (self._wrong or self.listen_only) and self.rate == 1.0:
                level = DOMINANT if image.delimiter >= 0 else RECESSIVE
        self._driven = level
        return level

    def sample(self, bit: int, seen: int, image: FrameImage) -> None:
        """Look at the wire at the end of ``bit``."""
        phase = self._phase
        if phase is _Phase.FRAME:
            if self.sends:
                self._sample_own(bit, seen, image)
            elif self.rate != 1.0:
                self._sample_strange(bit, seen, image)
            else:
                self._sample_frame(bit, seen, image)
        elif phase is _Phase.FLAG:
            self._sample_flag(seen)
        elif phase is _Phase.WAIT:
            self._sample_wait(seen)
        elif phase is _Phase.DELIMITER:
            self._sample_delimiter(bit, seen)

    def give_up(self, bit: int) -> None:
        """A frame too slow to be followed to its end, which nobody understands."""
        self._fail(bit, ErrorKind.BIT)

    def leave(self) -> None:
        """Off the wire: neither drives nor counts."""
        self._phase = _Phase.DONE

    def _sample_own(self, bit: int, seen: int, image: FrameImage) -> None:
        if bit == image.acknowledge:
            if seen == RECESSIVE:
                self._fail(bit, ErrorKind.ACKNOWLEDGEMENT)
        elif seen != self._driven:
            if bit >= image.arbitration_end or seen == RECESSIVE:
                self._fail(bit, ErrorKind.BIT)
            elif bit in image.stuff_bits:
                self._fail(bit, ErrorKind.STUFF)  # rule 3, exception 2
            else:
                self.sends = False  # it takes itself to have lost the arbitration, and listens
                self._wrong = True
                self._last, self._run = self._run_before(bit, image, seen)
            return
        if bit == image.last and self._phase is _Phase.FRAME:
            self.completed = True
            self._phase = _Phase.DONE

    @staticmethod
    def _run_before(bit: int, image: FrameImage, seen: int) -> tuple[int, int]:
        """The run of equal levels that ends with ``seen`` in ``bit``."""
        run = 1
        while run <= bit and image.levels[bit - run] == seen:
            run += 1
        return seen, run

    def _sample_frame(self, bit: int, seen: int, image: FrameImage) -> None:
        if seen != image.levels[min(bit, image.last)] and bit != image.acknowledge:
            self._wrong = True
        delimiter = image.delimiter
        if delimiter < 0 or bit < delimiter or self._lost(bit, image):
            self._run = self._run + 1 if seen == self._last else 1
            self._last = seen
            if self._run == 6:
                self._fail(bit, ErrorKind.STUFF)
            elif bit >= image.last:
                self._fail(bit, ErrorKind.CRC)
        elif bit == delimiter:
            if seen == DOMINANT:
                self._fail(bit, ErrorKind.FORM)
        elif bit == delimiter + 2:
            if seen == DOMINANT:
                self._fail(bit, ErrorKind.FORM)
            elif self._wrong:
                self._fail(bit, ErrorKind.CRC)
        elif bit > delimiter:
            self._sample_end(bit, seen, image)

    def _lost(self, bit: int, image: FrameImage) -> bool:
        """A node that no longer follows the frame's fields sees one that breaks off."""
        return self._wrong and bit >= image.last

    def _sample_end(self, bit: int, seen: int, image: FrameImage) -> None:
        if bit == image.last:
            if seen == DOMINANT:
                self._begin_flag()  # an overload condition: the frame stays good
            else:
                self._phase = _Phase.DONE
        elif bit > image.acknowledge and seen == DOMINANT:
            self._fail(bit, ErrorKind.FORM)
        elif bit == image.last - 1:
            self.accepted = True

    def _sample_strange(self, bit: int, seen: int, image: FrameImage) -> None:
        """Another bit rate: as many samples of this bit as its own clock takes."""
        while self._own_clock < bit + 1:
            self._own_clock += 1.0 / self.rate
            self._run = self._run + 1 if seen == self._last else 1
            self._last = seen
            if self._run == 6:
                self._fail(bit, ErrorKind.STUFF)
                return
        if bit == image.acknowledge + 1:
            self._fail(bit, ErrorKind.FORM)

    def _fail(self, bit: int, kind: ErrorKind) -> None:
        """An error was found: its flag begins with the next bit (7.2), and rule 1 or 3 counts."""
        if self.detected is None:
            self.detected = (bit, kind)
        self._forgiven = False
        if self.sends:
            if kind is ErrorKind.ACKNOWLEDGEMENT and self.passive:
                self._forgiven = True  # rule 3, exception 1, unless a dominant bit shows up
            elif kind is not ErrorKind.STUFF:
                self.transmit_errors += 8
        elif not self.listen_only:
            self.receive_errors += 1
        self._begin_flag()

    def _samples_of(self, bits: int) -> int:
        """``bits`` bits of the node's own rate, in bits of the bus."""
        return max(round(bits / self.rate), 1)

    def _begin_flag(self) -> None:
        self._phase = _Phase.FLAG
        self._flag_left = self._samples_of(FLAG_BITS)
        self._dominant = 0
        self._last = -1

    def _sample_flag(self, seen: int) -> None:
        if self.passive or self.listen_only:  # complete once six equal bits have been seen (3.1.3)
            if self._forgiven and seen == DOMINANT:
                self._forgiven = False
                self.transmit_errors += 8
            if seen != self._last:
                self._flag_left = self._samples_of(FLAG_BITS)
            self._last = seen
        self._flag_left -= 1
        if self._flag_left == 0:
            self._phase = _Phase.WAIT

    def _sample_wait(self, seen: int) -> None:
        if seen == RECESSIVE:
            self._phase = _Phase.DELIMITER
            self._flag_left = self._samples_of(DELIMITER_BITS) - 1
            if self._flag_left == 0:
                self._phase = _Phase.DONE
            return
        self._dominant += 1
        if self._dominant == 1 and not self.sends:
            self._count(8)  # rule 2
        if self._dominant % _TOLERATED_DOMINANT == 0:
            self._count(8)  # rule 6

    def _sample_delimiter(self, bit: int, seen: int) -> None:
        if seen == DOMINANT:
            self._fail(bit, ErrorKind.FORM)
            return
        self._flag_left -= 1
        if self._flag_left == 0:
            self._phase = _Phase.DONE

    def _count(self, errors: int) -> None:
        if self.sends:
            self.transmit_errors += errors
        elif not self.listen_only:
            self.receive_errors += errors


class AttemptResult(NamedTuple):
    """How an attempt ended."""

    sent: bool
    """The sender holds its frame to be sent."""
    bits: int
    """From the start of frame to the end of the frame or, if there is one, of the last delimiter."""
    error: tuple[int, ErrorKind] | None
    """The first error on the bus, and where it was found."""


def attempt(
    image: FrameImage,
    nodes: Sequence[Node],
    flipped: tuple[int, Sequence[Node]] | None = None,
    *,
    acknowledged: bool = False,
    cut_at: int = BITS_MAX,
) -> AttemptResult:
    """Let the one of ``nodes`` that sends drive ``image``; the nodes hold what became of it.

    ``flipped``: a place, and the nodes that see the inverse level there. ``acknowledged``:
    something outside of ``nodes`` drives the ACK slot. ``cut_at``: the sender leaves the wire there.
    """
    flip_at, victims = flipped if flipped is not None else (-1, ())
    flip_at = min(flip_at, image.last)
    sender = next(node for node in nodes if node.sends)
    bit = 0
    while bit < BITS_MAX:
        if bit == cut_at:
            sender.leave()
        level = RECESSIVE
        for node in nodes:
            level &= node.drive(bit, image, cut_at)
        if acknowledged and bit == image.acknowledge and sender.in_frame and image.delimiter >= 0:
            level = DOMINANT
        for node in nodes:
            node.sample(bit, level ^ 1 if bit == flip_at and node in victims else level, image)
        bit += 1
        if all(node.done or _harmless(node, sender) for node in nodes):
            break
    if sender.sends and sender.in_frame and cut_at == BITS_MAX:
        sender.give_up(bit)
    if cut_at < BITS_MAX:
        error: tuple[int, ErrorKind] | None = (cut_at, ErrorKind.CUT_OFF)
    else:
        detected = [node.detected for node in nodes if node.detected is not None]
        error = min(detected, default=None, key=lambda first: first[0])
    return AttemptResult(sender.completed, bit, error)


def _harmless(node: Node, sender: Node) -> bool:
    """A node whose error handling nobody else notices, after the frame has been sent."""
    return sender.completed and node.busy and (node.passive or node.listen_only)

"""One attempt to send, among the controllers of a segment: who got the frame, and what it cost.

Where nothing can go wrong the outcome is known without a look at single bits.
"""

from collections.abc import Mapping
from typing import NamedTuple

from servobench.virtual_bus.bus.bit_length import frame_bits
from servobench.virtual_bus.bus.controller import CanController, ErrorState
from servobench.virtual_bus.bus.disturbance import Disturbance, ErrorKind
from servobench.virtual_bus.bus.error_frame import BITS_MAX, Node, attempt
from servobench.virtual_bus.bus.frame_image import FrameImage, frame_image, resampled
from servobench.virtual_bus.frame import Frame


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

"""Whether anybody has the node-ID that a simulated drive is about to take, on a bus that others share.

Two nodes with one id answer as one. On a bus with a real drive the second one would be its twin, and follow
the torques that are meant for it.
"""

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import Any, Final

from drivers.canopen.cob_ids import NODE_BITS, SENT_BY_NODES
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.nmt_states import NODE_ID_MAX
from drivers.canopen.objects301 import Cia301
from drivers.errors import BadInput, NoAnswer, PeerFault
from drivers.printable import printable
from drivers.timebase import NS_PER_S, Clock, Duration, Instant
from drivers.wire.link import BusLink

LISTEN_FOR: Final = Duration(NS_PER_S)
"""In so long a node with a heartbeat, or in operation, is heard nearly always; the others are asked."""
ANSWER_LIMIT_S: Final = 0.1
"""For one answer: a node that boots, or a full bus, takes less."""
ATTEMPTS: Final = 2
"""As a frame may be lost."""


def refuse_taken(
    link: BusLink, clock: Clock, nodes: Sequence[int], say: Callable[[str], None], force: bool
) -> None:
    """Listen and ask, before the devices of ``nodes`` are put on the bus; ids that are none are passed over.

    Nobody is asked on a hub on which nobody else is. Raises BadInput that names who has such an id; with
    ``force`` that is said only.
    """
    wanted = [node for node in nodes if 1 <= node <= NODE_ID_MAX]
    if not wanted or _alone(link.bus):
        return
    heard = _heard(link, clock, wanted)
    network = CanopenNetwork(link, clock)
    taken = [who for node in wanted if (who := _who_is(network, node, heard.get(node, ""))) is not None]
    if not taken:
        return
    there = "; ".join(taken)
    if not force:
        remedy = "take another node-ID, or end that one; --force joins nevertheless"
        raise BadInput("--node", "", there, f"node-IDs that nobody has on {link.name}", remedy)
    say(f"forced: joining {link.name} although {there}")


def _alone(bus: Any) -> bool:
    """On a hub only: whether nobody else is there. Whoever joins later looks for us."""
    status = getattr(getattr(bus, "inner", bus), "status", None)
    return status is not None and bool(getattr(status(), "alone", False))


def _heard(link: BusLink, clock: Clock, nodes: Collection[int]) -> dict[int, str]:
    """What was heard of the nodes, of each the last."""
    heard: dict[int, str] = {}
    until = Instant(clock.now() + LISTEN_FOR)
    while (received := link.recv(until)) is not None:
        kind, node = SENT_BY_NODES.get(received[0] & ~NODE_BITS), received[0] & NODE_BITS
        if kind is not None and node in nodes:
            heard[node] = f"{'an' if kind[0] in 'ES' else 'a'} {kind}"
        if clock.now() >= until:
            break
    return heard


def _who_is(network: CanopenNetwork, node: int, heard: str) -> str | None:
    """The node in words; None if nobody has that id."""
    answers = True
    try:
        network.upload(node, Cia301.DEVICE_TYPE, 0, ANSWER_LIMIT_S, ATTEMPTS)
    except NoAnswer:
        answers = False
    except PeerFault:
        pass  # an abort is an answer too
    if not answers:
        return f"node {node} is there: {heard} was heard" if heard else None
    name = b""
    with suppress(PeerFault):
        name = network.upload(node, Cia301.DEVICE_NAME, 0, ANSWER_LIMIT_S, ATTEMPTS)
    text = printable(name.split(b"\0", 1)[0].decode("latin-1").strip())
    return f"node {node} is there: {text or 'an unnamed device'} answers"

"""A segment with nodes that note all they are told, and with disturbances to order."""

from dataclasses import dataclass, field

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.disturbance import BusError, Disturbance
from servobench.virtual_bus.bus.port import Port
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import Timeline
from tests.hearing import Hearing
from tests.unit.virtual_bus.can_reference import wire_bits as reference_wire_bits

BIT_NS = 1_000
"""At 1 Mbit/s."""
FLAG, DELIMITER, INTERMISSION, SUSPEND = 6, 8, 3, 8
FRAME = Frame(0x181, bytes(range(1, 9)))


@dataclass
class Node:
    """A port with all that it was told."""

    port: Port
    got: list[tuple[int, Frame]]
    sent: list[int] = field(default_factory=list)
    states: list[tuple[int, ErrorState]] = field(default_factory=list)


class Bench:
    """A segment with nodes ``a``, ``b``, ``c`` ... and the error frames seen on it."""

    def __init__(self, nodes: int, *, acknowledged: bool = True, bitrate: int = 1_000_000) -> None:
        self.timeline = Timeline()
        self.segment = CanSegment(self.timeline, bitrate, acknowledged)
        self.errors: list[BusError] = []
        self.segment.add_error_monitor(self.errors.append)
        self.nodes = [self._node(chr(ord("a") + number)) for number in range(nodes)]

    def _node(self, name: str) -> Node:
        got: list[tuple[int, Frame]] = []
        node = Node(self.segment.attach(name, Hearing(lambda frame, at: got.append((at, frame)))), got)
        node.port.on_sent = lambda _frame, at: node.sent.append(at)
        node.port.on_error_state = lambda state, at: node.states.append((at, state))
        return node

    def disturb(self, bit: int, attempts: int, receivers: tuple[str, ...] | None = None) -> list[int]:
        """Disturb the next ``attempts`` at ``bit``; returns the starts of frame, filled as it goes."""
        starts: list[int] = []

        def judge(_sender: str, _frame: Frame, at: Instant) -> Disturbance | None:
            starts.append(at)
            return Disturbance(bit, receivers) if len(starts) <= attempts else None

        self.segment.set_disturb(judge)
        return starts

    def send_at(self, when_us: int, node: int, frame: Frame) -> None:
        port = self.nodes[node].port
        self.timeline.post(Instant(when_us * 1_000), lambda _now: port.send(frame))

    def go_off_at(self, when_ns: int, node: int) -> None:
        port = self.nodes[node].port
        self.timeline.post(Instant(when_ns), lambda _now: port.go_bus_off())

    def run(self, until_us: int = 100_000) -> None:
        self.timeline.run_until(Instant(until_us * 1_000))


def length(frame: Frame) -> int:
    return len(reference_wire_bits(frame))


def crc_delimiter(frame: Frame) -> int:
    return length(frame) - 10

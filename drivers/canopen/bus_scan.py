"""Finds the nodes on a CANopen bus: first by listening, then by reading three objects of each over SDO.

A running network is not disturbed: the scan only reads objects, one request at a time and with a small share
of the bus; its identifiers give way to every PDO. A node whose SDO channel another master is using is left
alone: a second client on one channel breaks the other's transfer (CiA 301 7.2.4).
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from servobench.drivers.canopen.cob_ids import BROADCASTS, RPDOS, SDO_ANSWER, SERVICES, TPDOS
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.errors import NoAnswer, TransferAborted
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant

NODES: Final = range(1, 128)
KNOCK_EVERY_NS: Final = Duration(2 * NS_PER_MS)
"""Interval between requests: two frames of 8 bytes, 13 % of a bus at 1 Mbit/s, and more at lower rates."""
KNOCK_WAIT_NS: Final = Duration(150 * NS_PER_MS)
"""Wait for the last answers."""
ROUNDS: Final = 2
"""A request or its answer may be lost; both rounds rarely are on a working bus."""
SDO_TIMEOUT_S: Final = 0.2
"""CiA 301 sets no limit; devices answer within some milliseconds, slow ones within a tenth of a second."""
SDO_ATTEMPTS: Final = 3
"""Attempts at a node known to be present, which may be busy; see :data:`ROUNDS`."""
_UPLOAD = 0x40
"""Command of a request for an object's value (initiate upload, CiA 301 7.2.4.3.5)."""
_ASKED_FOR = bytes((Cia301.DEVICE_TYPE & 0xFF, Cia301.DEVICE_TYPE >> 8, 0))
"""Index and sub-index as in a request and in its answer."""

PROFILES = {
    301: "no profile",
    401: "I/O module",
    402: "drive",
    404: "measuring device or controller",
    405: "programmable controller",
    406: "encoder",
    408: "hydraulic drive",
    410: "inclinometer",
    418: "battery module",
    419: "battery charger",
}
"""Low word of 1000h."""
DRIVE_KINDS = {1: "frequency converter", 2: "servo drive", 4: "stepper drive", 8: "multi-device drive"}
"""CiA 402: bits 16 to 23 of 1000h."""


def profile_title(number: int) -> str:
    """Name a device profile by its number, the low word of 1000h. Not every number is one of CiA's."""
    if number not in PROFILES:
        return f"device of profile {number} ({number:04X}h), no profile of CiA known here"
    return f"{PROFILES[number]} (CiA {number})"


@dataclass(slots=True)
class NodeFound:
    """Known facts about one node; None where unknown."""

    node_id: int
    nmt_state: str | None = None
    """From its heartbeat, or else inferred from its behaviour: sending PDOs, or answering SDO."""
    heartbeat_ms: int | None = None
    """Its object's value; 0: it sends none."""
    device_type: int | None = None
    error_register: int | None = None
    vendor_id: int | None = None
    product_code: int | None = None
    revision_number: int | None = None
    serial_number: int | None = None
    name: str = ""
    heard: dict[str, int] = field(default_factory=dict)
    """Kind of frame -> how many were heard before any request."""
    note: str = ""

    @property
    def profile(self) -> str:
        """Its device type in words."""
        if self.device_type is None:
            return ""
        number = self.device_type & 0xFFFF
        if number == 402:
            kind = DRIVE_KINDS.get(self.device_type >> 16 & 0xFF, PROFILES[402])
            return f"{kind} (CiA 402)"
        if number == 0:
            return "no standard profile"
        return profile_title(number)


@dataclass(slots=True)
class Traffic:
    """Bus traffic while the scan only listened."""

    frames: int = 0
    by_node: dict[int, Counter[str]] = field(default_factory=dict)
    broadcasts: Counter[str] = field(default_factory=Counter)
    others: int = 0
    """Frames that CANopen's default identifiers do not explain."""

    def masters_on(self, node_id: int) -> bool:
        """Return True if another master uses the SDO channel of this node."""
        return self.by_node.get(node_id, Counter())["SDO request"] > 0

    @property
    def running(self) -> bool:
        """True if a SYNC or process data are on the bus."""
        return self.broadcasts["SYNC"] > 0 or any(seen["PDO"] for seen in self.by_node.values())


_KINDS = SERVICES | dict.fromkeys(TPDOS | RPDOS, "PDO")


class BusScan:
    """One scan of one bus."""

    def __init__(self, network: CanopenNetwork) -> None:
        self.traffic = Traffic()
        self.nodes: dict[int, NodeFound] = {}
        self._network = network
        self._listening = self._knocking = False
        self._answered: set[int] = set()
        self._read_already: set[int] = set()
        for node_id in NODES:
            network.status(node_id)  # follows its heartbeat from now on
        network.link.tap(self._see)

    def listen(self, duration: Duration) -> None:
        """Listen for a while; enter the nodes heard."""
        self._listening = True
        self._network.pump(Instant(self._network.clock.now() + duration))
        self._listening = False
        for node_id, seen in self.traffic.by_node.items():
            # a request tells of a master only, and of nobody who would answer it
            if set(seen) - {"SDO request"}:
                self._node(node_id).heard = dict(seen)
        self._take_states()

    def probe(self) -> None:
        """Ask every node-ID, and read the identity of the nodes; a further call reads only new ones."""
        for node_id in sorted(self._knock()):
            self._read_already.add(node_id)
            self._read(self._node(node_id))
        self._take_states()
        self._note_masters()

    def read_booted(self) -> None:
        """Read the nodes that were booting when asked, and have sent their boot-up message since."""
        for node_id in NODES:
            new = node_id not in self._read_already and not self.traffic.masters_on(node_id)
            if new and self._network.status(node_id).boot_ups:
                self._read_already.add(node_id)
                self._read(self._node(node_id))
        self._take_states()
        self._note_masters()

    def found(self) -> list[NodeFound]:
        """Return the nodes, by number."""
        return [self.nodes[node_id] for node_id in sorted(self.nodes)]

    # ---- inside ---------------------------------------------------------------------------------------

    def _see(
        self, direction: str, can_id: int, data: bytes, extended: bool, remote: bool, _at: Instant
    ) -> None:
        if direction != "rx":
            return
        if self._knocking and can_id & 0x780 == SDO_ANSWER and data[1:4] == _ASKED_FOR and not extended:
            self._answered.add(can_id & 0x7F)
        if self._listening:
            self._sort(can_id, extended or remote)

    def _sort(self, can_id: int, foreign: bool) -> None:
        traffic = self.traffic
        traffic.frames += 1
        kind = _KINDS.get(can_id & 0x780)
        if foreign:
            traffic.others += 1
        elif can_id in BROADCASTS:
            traffic.broadcasts[BROADCASTS[can_id]] += 1
        elif kind is not None and can_id & 0x7F:
            traffic.by_node.setdefault(can_id & 0x7F, Counter())[kind] += 1
        else:
            traffic.others += 1

    def _node(self, node_id: int) -> NodeFound:
        return self.nodes.setdefault(node_id, NodeFound(node_id))

    def _knock(self) -> set[int]:
        """Return the node-IDs that answer a request for 1000h, with a value or with an abort."""
        network = self._network
        answered = self._answered
        unheard = [
            node_id
            for node_id in NODES
            if node_id not in self._read_already and not self.traffic.masters_on(node_id)
        ]
        request = (bytes((_UPLOAD,)) + _ASKED_FOR).ljust(8, b"\x00")
        answered.clear()
        self._knocking = True
        for _ in range(ROUNDS):
            due = network.clock.now()
            for node_id in unheard:
                if node_id not in answered:
                    network.send_request(node_id, request)
                    due = Instant(due + KNOCK_EVERY_NS)
                    network.pump(due)
            network.pump(Instant(network.clock.now() + KNOCK_WAIT_NS))
        self._knocking = False
        return answered & set(unheard)

    def _read(self, node: NodeFound) -> None:
        try:
            node.device_type = self._number(node.node_id, Cia301.DEVICE_TYPE)
            node.error_register = self._number(node.node_id, Cia301.ERROR_REGISTER)
            node.vendor_id = self._number(node.node_id, Cia301.IDENTITY, 1)
            node.product_code = self._number(node.node_id, Cia301.IDENTITY, 2)
            node.revision_number = self._number(node.node_id, Cia301.IDENTITY, 3)
            node.serial_number = self._number(node.node_id, Cia301.IDENTITY, 4)
            node.heartbeat_ms = self._number(node.node_id, Cia301.PRODUCER_HEARTBEAT_TIME)
            name = self._value(node.node_id, Cia301.DEVICE_NAME)
            node.name = "" if name is None else name.rstrip(b"\0").decode("latin-1")
        except NoAnswer as error:
            node.note = f"fell silent while it was read: {error.summary}"

    def _number(self, node_id: int, index: int, sub: int = 0) -> int | None:
        value = self._value(node_id, index, sub)
        return None if value is None else int.from_bytes(value, "little")

    def _value(self, node_id: int, index: int, sub: int = 0) -> bytes | None:
        """Read an object; None if the node lacks or refuses it."""
        try:
            return self._network.upload(node_id, index, sub, SDO_TIMEOUT_S, SDO_ATTEMPTS)
        except TransferAborted:
            return None

    def _note_masters(self) -> None:
        for node_id, node in self.nodes.items():
            if self.traffic.masters_on(node_id):
                node.note = "not asked: another master uses its SDO channel"

    def _take_states(self) -> None:
        """Enter the states from heartbeats; else from a node's behaviour (CiA 301 7.3.2.2.6, table of
        services)."""
        for node_id in NODES:
            status = self._network.status(node_id)
            if status.heartbeat_at is not None:
                state = status.state
                self._node(node_id).nmt_state = _STATE_NAMES[state] if state is not None else "unknown"
        for node in self.nodes.values():
            if node.nmt_state is None and node.heard.get("PDO"):
                node.nmt_state = "operational"
            elif node.nmt_state is None and node.device_type is not None:
                node.nmt_state = "operational or pre-operational"


_STATE_NAMES = {
    NmtState.INITIALISING: "boot-up",
    NmtState.STOPPED: "stopped",
    NmtState.OPERATIONAL: "operational",
    NmtState.PRE_OPERATIONAL: "pre-operational",
}

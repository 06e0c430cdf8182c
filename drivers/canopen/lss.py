"""LSS master (CiA 305): finds devices that have no node-ID yet, and gives them one.

Own code beside canopen's, whose fast scan sleeps by the wall clock and takes one lost answer for a 1 bit.
Requests go out on 7E5h, answers come on 7E4h, eight bytes each.
"""

from struct import Struct
from typing import NamedTuple

from drivers.canopen.network import CanopenNetwork
from drivers.errors import NoAnswer, PeerFault
from drivers.timebase import NS_PER_MS, Duration, Instant

REQUEST_ID, ANSWER_ID = 0x7E5, 0x7E4
ANSWER_NS = Duration(20 * NS_PER_MS)
"""Wait for an answer of a fast scan; half of the 128 steps wait for all of it."""
PATIENCE_NS = Duration(500 * NS_PER_MS)
"""Wait for the answer to a service that one device confirms."""
ATTEMPTS = 4
TRIALS = 3
LATE_BY = 4
"""An answer is given so many times the time that the slowest one of a trial took."""

_SWITCH_GLOBAL, _CONFIGURE_NODE_ID, _STORE = 0x04, 0x11, 0x17
_SELECT_VENDOR, _SELECTED = 0x40, 0x44
_IDENTIFY_UNCONFIGURED, _IDENTIFIED_UNCONFIGURED = 0x4C, 0x50
_FAST_SCAN, _IDENTIFIED = 0x51, 0x4F
_WAITING, _CONFIGURATION = 0, 1
_SCAN_RESET = 0x80
_SCAN = Struct("<BLBBB")
_NUMBER = Struct("<BL3x")


class LssAddress(NamedTuple):
    """What tells a device from every other one: its identity object 1018h."""

    vendor_id: int
    product_code: int
    revision_number: int
    serial_number: int

    def __str__(self) -> str:
        vendor, product, revision, serial = self
        return f"vendor {vendor:08X}h, product {product:08X}h, revision {revision:08X}h, serial {serial:08X}h"


class LssMaster:
    """The master's side, on a network that is pumped while it waits."""

    def __init__(self, network: CanopenNetwork, answer: Duration = ANSWER_NS) -> None:
        self._network = network
        self._answer = answer
        self._answers: list[bytes] = []
        network.listen(ANSWER_ID, lambda data, _at: self._answers.append(data))

    def close(self) -> None:
        """Leave all devices in LSS state waiting and listen no more."""
        self.to_waiting()
        self._network.unlisten(ANSWER_ID)

    def to_waiting(self) -> None:
        """Every device leaves the configuration state; one that has got its node-ID boots (CiA 305 6.4.1)."""
        self._send(bytes((_SWITCH_GLOBAL, _WAITING)))

    def any_unconfigured(self) -> bool:
        """Whether a device without node-ID is there (identify non-configured remote slaves)."""
        return self._ask(bytes((_IDENTIFY_UNCONFIGURED,)), self._answer, _IDENTIFIED_UNCONFIGURED) is not None

    def fast_scan(self) -> LssAddress | None:
        """One device without node-ID, which is in the configuration state then; None if there is none.

        Raises NoAnswer if answers are there but lead to no device, because too many are lost or late.
        """
        wait = self._patience()
        if wait is None:
            return None
        parts: list[int] = []
        for part in range(4):
            number = self._scan_part(part, wait)
            if number is None:
                raise NoAnswer(
                    f"devices without node-ID answer on {self._network.link.name}, but none was found",
                    f"{ATTEMPTS} searches, the last with {(wait << ATTEMPTS - 1) / 1e6:.0f} ms for an answer",
                    "check the wiring; frames are lost or very late",
                )
            parts.append(number)
        return LssAddress(*parts)

    def find_all(self, limit: int = 127) -> list[LssAddress]:
        """Every device without node-ID; all are waiting again afterwards."""
        found: list[LssAddress] = []
        try:
            while len(found) < limit and (address := self.fast_scan()) is not None:
                found.append(address)
        finally:
            self.to_waiting()
        return found

    def assign(self, address: LssAddress, node_id: int, store: bool = False) -> None:
        """Give the device its node-ID, have it store that if ``store``, and let it boot.

        Raises NoAnswer if it does not answer, PeerFault if it refuses.
        """
        self.to_waiting()
        self._select(address)
        try:
            self._confirmed(_CONFIGURE_NODE_ID, node_id, f"node-ID {node_id}", address)
            if store:
                self._confirmed(_STORE, 0, "to store its node-ID", address)
        finally:
            self.to_waiting()

    # ---- inside ---------------------------------------------------------------------------------------

    def _patience(self) -> Duration | None:
        """How long to wait for an answer: some times what one took now. None: nobody answers."""
        clock = self._network.clock
        slowest = 0
        answered = False
        for _ in range(TRIALS):
            asked_at = clock.now()
            request = _SCAN.pack(_FAST_SCAN, 0, _SCAN_RESET, 0, 0)
            if self._ask(request, Duration(LATE_BY * self._answer), _IDENTIFIED) is not None:
                answered = True
                slowest = max(slowest, clock.now() - asked_at)
                self._network.pump(Instant(clock.now() + self._answer))
        return Duration(max(self._answer, LATE_BY * slowest)) if answered else None

    def _scan_part(self, part: int, wait: Duration) -> int | None:
        """32 bits, each by a question that only devices with a 0 there answer; None if it led nowhere.

        The last question is whether anybody has the whole number; if not, answers were lost, or late and
        taken for those of the next question, and all is asked again with more patience.
        """
        for attempt in range(ATTEMPTS):
            patience = Duration(wait << attempt)
            number = 0
            for bit in range(31, -1, -1):
                if not self._scan_step(number, bit, part, part, patience):
                    number |= 1 << bit
            if self._scan_step(number, 0, part, (part + 1) % 4, Duration(LATE_BY * patience)):
                return number
        return None

    def _scan_step(self, number: int, bit: int, part: int, following: int, wait: Duration) -> bool:
        request = _SCAN.pack(_FAST_SCAN, number, bit, part, following)
        if self._ask(request, wait, _IDENTIFIED) is None:
            return False
        # Several devices answer, each in its own time: the last one must not answer the next question.
        self._network.pump(Instant(self._network.clock.now() + wait // 2))
        return True

    def _select(self, address: LssAddress) -> None:
        for place, number in enumerate(address[:3]):
            self._send(_NUMBER.pack(_SELECT_VENDOR + place, number))
        request = _NUMBER.pack(_SELECT_VENDOR + 3, address.serial_number)
        if self._ask(request, PATIENCE_NS, _SELECTED) is None:
            raise NoAnswer(f"the device with {address} does not answer to its LSS address")

    def _confirmed(self, command: int, value: int, what: str, address: LssAddress) -> None:
        answer = self._ask(bytes((command, value)), PATIENCE_NS, command)
        if answer is None:
            raise NoAnswer(f"the device with {address} does not answer the request: {what}")
        if answer[1]:
            raise PeerFault(f"the device with {address} refuses {what}", f"LSS error {answer[1]}")

    def _ask(self, request: bytes, wait: Duration, wanted: int) -> bytes | None:
        """The first answer of the kind ``wanted``; what came before the request belongs to another one."""
        clock = self._network.clock
        while self._network.pump_one(clock.now()):
            pass
        self._answers.clear()
        self._send(request)
        deadline = Instant(clock.now() + wait)
        while True:
            for answer in self._answers:
                if len(answer) == 8 and answer[0] == wanted:
                    return answer
            self._answers.clear()
            if not self._network.pump_one(deadline) and not self._answers:
                return None

    def _send(self, request: bytes) -> None:
        self._network.link.send(REQUEST_ID, request.ljust(8, b"\x00"))

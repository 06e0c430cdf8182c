"""LSS master (CiA 305): finds devices without a node-ID, and assigns them one.

Own code beside canopen's, whose fast scan sleeps by the wall clock and takes one lost answer for a 1 bit.
Requests go out on 7E5h, answers come on 7E4h, eight bytes each.

A fast scan asks whether anybody's address begins like this, bit by bit, a 0 first. Where the answer is yes
there may be another device with a 1. By CiA 305 devices that were found keep silent in configuration state,
until nobody answers any more; but some slaves say yes to every question in that state (CANopenNode). So each
device found tells its identity alone and goes back to the waiting state; then the search goes on where it had
a yes for a 0.
"""

from collections.abc import Iterator
from struct import Struct
from typing import Final, NamedTuple

from servobench.drivers.canopen.cob_ids import LSS_ANSWER, LSS_REQUEST
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import NoAnswer, PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant

ANSWER_NS = Duration(20 * NS_PER_MS)
"""Wait for an answer of a fast scan; half of the 128 steps wait for all of it."""
PATIENCE_NS = Duration(500 * NS_PER_MS)
"""Wait for the answer to a service that one device confirms."""
BOOT_NS = Duration(5 * NS_PER_S)
"""Wait for the boot-up message of a device that got its node-ID: slow drives take seconds."""
ATTEMPTS = 4
"""Attempts for a part of an address. The wait doubles each time, up to eight times the first one."""
TRIALS = 3
"""Questions used to measure how long the slowest device takes."""
ASK_AGAIN = 2
"""Repetitions of a question without an answer, where a lost answer would cost a device."""
DEVICES_MAX = 127
"""The number of node-IDs."""
LATE_BY = 4
"""An answer may take this many times as long as the slowest one of a trial."""

# Command specifiers, and the two values of a state and of a bit that are asked for (CiA 305).
_SWITCH_GLOBAL, _CONFIGURE_NODE_ID, _STORE = 0x04, 0x11, 0x17
_SELECT_VENDOR, _SELECTED = 0x40, 0x44
_IDENTIFY_UNCONFIGURED, _IDENTIFIED_UNCONFIGURED = 0x4C, 0x50
_FAST_SCAN, _IDENTIFIED = 0x51, 0x4F
_INQUIRE_VENDOR = 0x5A
_WAITING = 0
SCAN_RESET: Final = 0x80
"""Instead of the number of a bit: fast scan begins anew (CiA 305)."""
_SCAN = Struct("<BLBBB")
_NUMBER = Struct("<BL3x")


class LssAddress(NamedTuple):
    """The unique address of a device: its identity object 1018h."""

    vendor_id: int
    product_code: int
    revision_number: int
    serial_number: int

    def __str__(self) -> str:
        vendor, product, revision, serial = self
        return f"vendor {vendor:08X}h, product {product:08X}h, revision {revision:08X}h, serial {serial:08X}h"


class _Branch(NamedTuple):
    """Addresses with a common beginning, not searched yet."""

    known: tuple[int, ...]
    """The first parts."""
    number: int
    """The next part, its lower ``free`` bits 0."""
    free: int


_EVERYWHERE = _Branch((), 0, 32)


class LssMaster:
    """The master's side, on a network that is pumped while it waits."""

    def __init__(self, network: CanopenNetwork) -> None:
        self._network = network
        self._answers: list[bytes] = []
        self._followed: tuple[int, ...] | None = None
        """The parts that devices have confirmed; they wait for the question about the next one."""
        network.listen(LSS_ANSWER, lambda data, _at: self._answers.append(data))

    def close(self) -> None:
        """Return all devices to LSS state waiting and stop listening."""
        self.to_waiting()
        self._network.unlisten(LSS_ANSWER)

    def to_waiting(self) -> None:
        """Take every device out of the configuration state; one with a new node-ID boots (CiA 305 6.4.1)."""
        self._followed = None
        self._send(bytes((_SWITCH_GLOBAL, _WAITING)))

    def any_unconfigured(self) -> bool:
        """Return True if a device without node-ID is present (identify non-configured remote slaves)."""
        return self._ask(bytes((_IDENTIFY_UNCONFIGURED,)), ANSWER_NS, _IDENTIFIED_UNCONFIGURED) is not None

    def search(self, limit: int = DEVICES_MAX) -> Iterator[LssAddress]:
        """Yield every device without node-ID, the lowest address first; each may be assigned one before the
        next is requested. Until then it is in the configuration state; all are waiting again afterwards.

        Raises NoAnswer if answers are there but lead to no device, because too many are lost or late, and
        PeerFault if a device misleads the search.
        """
        self.to_waiting()
        wait = self._patience()
        branches = [] if wait is None else [_EVERYWHERE]
        answers = 0
        try:
            while wait is not None and branches and answers < limit:
                branch = branches.pop()
                address = self._descend(branch, wait)
                if address is None:
                    continue
                self._verify(address)
                yield address
                answers += 1
                if self._patience() is None:
                    return
                branches += _beside(branch, address)
        finally:
            self.to_waiting()

    def assign(self, address: LssAddress, node_id: int, store: bool = False) -> bool:
        """Assign a node-ID to the device, store it there if ``store``, and wait until it has booted; False:
        no boot-up message came.

        Raises NoAnswer if it does not answer, PeerFault if it refuses.
        """
        self.to_waiting()
        self._select(address)
        try:
            self._confirmed(_CONFIGURE_NODE_ID, node_id, f"node-ID {node_id}", address)
            if store:
                self._confirmed(_STORE, 0, "to store its node-ID", address)
            status = self._network.status(node_id)
            boot_ups = status.boot_ups
        finally:
            self.to_waiting()
        deadline = self._network.deadline_after(BOOT_NS)
        while status.boot_ups == boot_ups and self._network.clock.now() < deadline:
            self._network.pump(min(deadline, self._network.deadline_after(ANSWER_NS)))
        return status.boot_ups != boot_ups

    # ---- inside ---------------------------------------------------------------------------------------

    def _patience(self) -> Duration | None:
        """Measure how long to wait for an answer: a multiple of the present one. None: nobody answers."""
        clock = self._network.clock
        slowest = 0
        answered = False
        for _ in range(TRIALS):
            asked_at = clock.now()
            request = _SCAN.pack(_FAST_SCAN, 0, SCAN_RESET, 0, 0)
            if self._ask(request, Duration(LATE_BY * ANSWER_NS), _IDENTIFIED) is not None:
                answered = True
                slowest = max(slowest, clock.now() - asked_at)
                self._network.pump(Instant(clock.now() + ANSWER_NS))
        return Duration(max(ANSWER_NS, LATE_BY * slowest)) if answered else None

    def _descend(self, branch: _Branch, wait: Duration) -> LssAddress | None:
        """Return the lowest address on ``branch``, its device in configuration state; None if there is
        none."""
        known, number, free = branch
        if branch is not _EVERYWHERE and not self._anybody_on(branch, wait):
            return None
        while len(known) < len(LssAddress._fields):
            known = (*known, self._scan_part(_Branch(known, number, free), wait))
            number, free = 0, 32
        return LssAddress(*known)

    def _anybody_on(self, branch: _Branch, wait: Duration) -> bool:
        """Return True if a device is there; ask again without an answer, for one may be lost."""
        known, number, free = branch
        part = len(known)
        return any(
            self._follow(known, wait) and self._scan_step(number, free, part, part, wait)
            for _ in range(ASK_AGAIN)
        )

    def _follow(self, known: tuple[int, ...], wait: Duration) -> bool:
        """Return True if a device has these parts, and is ready for the question about the next one."""
        if self._followed == known:
            return True
        self.to_waiting()
        self._ask(_SCAN.pack(_FAST_SCAN, 0, SCAN_RESET, 0, 0), wait, _IDENTIFIED)
        self._network.pump(Instant(self._network.clock.now() + wait // 2))
        steps = (self._scan_step(number, 0, part, part + 1, wait) for part, number in enumerate(known))
        self._followed = known if all(steps) else None
        return self._followed is not None

    def _scan_part(self, branch: _Branch, wait: Duration) -> int:
        """Find 32 bits, each by a question that only devices with a 0 there answer.

        The last question checks the whole number; if not, answers were lost, or late and taken for those of
        the next question, and all is asked again, with more patience. Raises NoAnswer.
        """
        known, beginning, free = branch
        part = len(known)
        following = (part + 1) % len(LssAddress._fields)
        for attempt in range(ATTEMPTS):
            patience = Duration(wait << attempt)
            if not self._follow(known, patience):
                continue
            number = beginning
            for bit in range(free - 1, -1, -1):
                tries = 1 if attempt == 0 else ASK_AGAIN
                if not any(self._scan_step(number, bit, part, part, patience) for _ in range(tries)):
                    number |= 1 << bit
            self._followed = None
            if self._scan_step(number, 0, part, following, Duration(LATE_BY * patience)):
                self._followed = (*known, number) if following else None
                return number
        raise NoAnswer(
            f"devices without node-ID answer on {self._network.link.name}, but none was found",
            f"{ATTEMPTS} searches, the last with {(wait << ATTEMPTS - 1) / 1e6:.0f} ms for an answer",
            "check the wiring; frames are lost or very late",
        )

    def _scan_step(self, number: int, bit: int, part: int, following: int, wait: Duration) -> bool:
        request = _SCAN.pack(_FAST_SCAN, number, bit, part, following)
        if self._ask(request, wait, _IDENTIFIED) is None:
            return False
        # Several devices answer, each in its own time: the last one must not answer the next question.
        self._network.pump(Instant(self._network.clock.now() + wait // 2))
        return True

    def _verify(self, address: LssAddress) -> None:
        """Check that the device in configuration state has that address; if it cannot be asked, select it by
        address."""
        numbers: list[int] = []
        for part in range(len(address)):
            answers = self._ask_all(bytes((_INQUIRE_VENDOR + part,)))
            if not answers:
                self.to_waiting()
                self._select(address)
                return
            if len(answers) > 1 and part == len(address) - 1:
                raise PeerFault(
                    f"{len(answers)} devices have one LSS address on {self._network.link.name}: {address}",
                    "",
                    "no two devices may have one identity (1018h): give each its node-ID alone on the bus",
                )
            numbers.append(_NUMBER.unpack(answers[0])[1])
        if LssAddress(*numbers) != address:
            raise PeerFault(
                f"a device on {self._network.link.name} answers questions of a fast scan that are not for it",
                f"found {address}; it says {LssAddress(*numbers)}",
                "give it its node-ID by its own switches or tool, or alone on the bus",
            )

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
        """Return the first answer of the kind ``wanted``; earlier frames belong to another request."""
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

    def _ask_all(self, request: bytes) -> list[bytes]:
        """Return all answers to a question that one device should answer."""
        first = self._ask(request, PATIENCE_NS, request[0])
        if first is None:
            return []
        self._answers.clear()
        self._network.pump(Instant(self._network.clock.now() + ANSWER_NS))
        return [first, *(answer for answer in self._answers if len(answer) == 8 and answer[0] == request[0])]

    def _send(self, request: bytes) -> None:
        self._network.link.send(LSS_REQUEST, request.ljust(8, b"\x00"))


def _beside(branch: _Branch, address: LssAddress) -> Iterator[_Branch]:
    """Yield the other places on ``branch`` for devices, given its lowest address; the highest first."""
    for part in range(len(branch.known), len(address)):
        free = branch.free if part == len(branch.known) else 32
        for bit in range(free - 1, -1, -1):
            if not address[part] >> bit & 1:
                yield _Branch(address[:part], (address[part] >> bit | 1) << bit, bit)

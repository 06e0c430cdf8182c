"""PDO plan of a drive: the contents of each PDO, the bus load, and writing it into the drive.

CiA 301 7.5.2.35 to 7.5.2.38: communication parameters 0x1400 and 0x1800, mapping 0x1600 and 0x1A00. A mapping
may change only while the PDO does not exist (bit 31 of its COB-ID), with sub 0 of the mapping at 0 meanwhile.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from struct import Struct, calcsize
from typing import NamedTuple

from servobench.drivers.canopen.cob_ids import CAN_ID, NO_RTR, NOT_VALID, RPDOS, TPDOS
from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.canopen.objects301 import (
    MAPPING_OFFSET,
    RPDO_COMMUNICATION,
    TPDO_COMMUNICATION,
    mapping_word,
    object_name,
)
from servobench.drivers.errors import TransferAborted
from servobench.drivers.timebase import NS_PER_MS, Duration

BITS_MAX = 64
"""Bits in a PDO: the eight octets of a classical frame."""

# Transmission types (CiA 301 7.5.2.35, 7.5.2.37).
EVENT_DRIVEN = 255
EVERY_SYNC = 1
SYNCHRONOUS_MAX = 240
"""1 to 240: with every n-th SYNC."""

_PDOS_LOOKED_AT = 4
"""Predefined connection set: the PDOs that may be active by default."""
_WRITTEN, _SWITCHED_OFF = " written", " switched off"
DONE = (_WRITTEN, _SWITCHED_OFF)
"""Ending of a note on something done; every other note reports something impossible."""
Key = tuple[int, int]
"""Index and sub-index."""


def key_of(mapping_word: int) -> Key:
    """Return the object that a mapping word names."""
    return mapping_word >> 16, mapping_word >> 8 & 0xFF


def mapping_text(words: Iterable[int]) -> str:
    """``6041h:00/16 606Ch:00/32``: objects and bits that mapping words name."""
    return " ".join(f"{object_name(*key_of(word))}/{word & 0xFF}" for word in words)


class PdoDirection(Enum):
    """Seen from the drive, as CANopen does; the value is the base of the communication parameter."""

    TRANSMIT = TPDO_COMMUNICATION
    RECEIVE = RPDO_COMMUNICATION

    @property
    def letter(self) -> str:
        """T or R, as in TPDO and RPDO."""
        return self.name[0]

    @property
    def mapping_base(self) -> int:
        """Base index of the mapping parameters."""
        return self.value + MAPPING_OFFSET

    def default_cob_id(self, number: int, node_id: int) -> int:
        """Return the identifier by the predefined connection set (CiA 301 table 39), PDO 1 to 4."""
        if not 1 <= number <= _PDOS_LOOKED_AT:
            raise ValueError(f"PDO {number} has no predefined identifier")
        first = TPDOS if self is PdoDirection.TRANSMIT else RPDOS
        return list(first)[number - 1] + node_id


@dataclass(frozen=True, slots=True)
class PdoEntry:
    """One mapped object."""

    index: int
    sub: int
    code: str
    """``struct`` character of its type; ``3s`` and the like for octets that are not interpreted."""

    @property
    def bits(self) -> int:
        return 8 * calcsize("<" + self.code)

    def value(self, data: bytes) -> int | bytes:
        """Return the value that a frame carries for an object that holds ``data``, as :meth:`PdoMap.codec`
        packs it."""
        octets = data[: self.bits // 8]
        return (
            octets if self.code[-1] == "s" else int.from_bytes(octets, "little", signed=self.code.islower())
        )

    @property
    def mapping_word(self) -> int:
        """The UNSIGNED32 of the mapping parameter: index, sub-index, length."""
        return mapping_word(self.index, self.sub, self.bits)


@dataclass(frozen=True, slots=True)
class PdoMap:
    """One PDO: identifier, transmission type and content. Raises ValueError if it is impossible."""

    direction: PdoDirection
    number: int
    """1..512."""
    cob_id: int
    entries: tuple[PdoEntry, ...]
    transmission_type: int = EVERY_SYNC
    inhibit_time_100us: int = 0
    """Sub-index 3: shortest interval of an event-driven TPDO; 0: no limit."""
    event_timer_ms: int = 0
    """Sub-index 5: an event-driven TPDO is sent after this time even without an event; 0: never."""

    def __post_init__(self) -> None:
        if not 1 <= self.number <= 512:
            raise ValueError(f"PDO number {self.number} is not in 1..512")
        if not 0x180 <= self.cob_id <= 0x57F:
            raise ValueError(f"identifier {self.cob_id:03X}h is not in the range of PDOs")
        if not self.entries or self.bits > BITS_MAX:
            raise ValueError(f"{self.name} maps {self.bits} bits, 8 to {BITS_MAX} fit")

    @property
    def name(self) -> str:
        """TPDO1, RPDO2, ..."""
        return f"{self.direction.letter}PDO{self.number}"

    @property
    def bits(self) -> int:
        return sum(entry.bits for entry in self.entries)

    @property
    def communication_index(self) -> int:
        return self.direction.value + self.number - 1

    @property
    def mapping_index(self) -> int:
        return self.direction.mapping_base + self.number - 1

    @property
    def synchronous(self) -> bool:
        return self.transmission_type <= SYNCHRONOUS_MAX

    def times_a_cycle(self, period_ns: Duration) -> float:
        """Return how often it travels in a cycle of one SYNC and one command.

        A TPDO sent on change is counted by its event timer: changes are rare.
        """
        if self.synchronous:
            return 1.0 / max(1, self.transmission_type)
        if self.direction is PdoDirection.TRANSMIT and self.event_timer_ms:
            return min(1.0, period_ns / (self.event_timer_ms * NS_PER_MS))
        return 1.0

    def codec(self) -> Struct:
        """Return the compiled layout: little endian, no padding (CiA 301 7.1.4)."""
        return Struct("<" + "".join(entry.code for entry in self.entries))

    def place_of(self, index: int, sub: int = 0) -> int | None:
        """Return the position of an object among the entries."""
        for place, entry in enumerate(self.entries):
            if (entry.index, entry.sub) == (index, sub):
                return place
        return None


@dataclass(frozen=True, slots=True)
class PdoPlan:
    """Every PDO of one drive that the master uses; all others are switched off."""

    tpdos: tuple[PdoMap, ...]
    rpdos: tuple[PdoMap, ...]
    observed: tuple[PdoMap, ...] = ()
    """TPDOs for the recording alone: the loop does not use them."""

    def __post_init__(self) -> None:
        used = [pdo.cob_id for pdo in self]
        if len(set(used)) != len(used):
            raise ValueError("two PDOs of the plan share an identifier")

    def __iter__(self) -> Iterator[PdoMap]:
        """Iterate over all PDOs that the drive sends, then all that it receives."""
        return iter((*self.tpdos, *self.observed, *self.rpdos))

    def tpdo_with(self, index: int, sub: int = 0) -> PdoMap | None:
        """Return the first TPDO that carries an object."""
        return next((pdo for pdo in self.tpdos if pdo.place_of(index, sub) is not None), None)

    def timer_of(self, index: int, sub: int = 0) -> Duration:
        """Return after how long the first TPDO with an object is repeated; 0 if it goes with SYNCs."""
        pdo = self.tpdo_with(index, sub)
        return Duration(0 if pdo is None or pdo.synchronous else pdo.event_timer_ms * NS_PER_MS)

    def rpdo_with(self, index: int, sub: int = 0) -> PdoMap | None:
        """Return the first RPDO that carries an object."""
        return next((pdo for pdo in self.rpdos if pdo.place_of(index, sub) is not None), None)


def write_plan(objects: RemoteObjects, plan: PdoPlan) -> list[str]:
    """Write the plan to the drive, which must be pre-operational, read it back, and return what was done.

    PDOs that already hold the plan are left alone, so a drive with a fixed mapping that fits is served.
    Raises SettingRefused naming every difference that stays, or TransferAborted; the drive's PDOs then are
    what they were before.
    """
    held: dict[int, _Held] = {}
    try:
        notes = _write_all(objects, plan, held)
        verify_plan(objects, plan)
    except (TransferAborted, SettingRefused):
        _put_back(objects, held)
        raise
    return notes


def _write_all(objects: RemoteObjects, plan: PdoPlan, held: dict[int, "_Held"]) -> list[str]:
    """Write all PDOs; return notes on what was done. ``held`` receives the former contents of each PDO before
    its change, by the index of its communication parameter."""

    def switch_off(communication_index: int) -> bool:
        cob_id = objects.read_if_there(communication_index, 1)
        if cob_id is None or cob_id & NOT_VALID:
            return False
        held.setdefault(communication_index, _held(objects, communication_index))
        objects.write(communication_index, 1, "I", cob_id | NOT_VALID)
        return True

    notes: list[str] = []
    for direction in PdoDirection:
        pdos = [pdo for pdo in plan if pdo.direction is direction]
        for number in sorted(set(range(1, _PDOS_LOOKED_AT + 1)) - {pdo.number for pdo in pdos}):
            name = f"{direction.letter}PDO{number}"
            try:
                notes += [f"{name}{_SWITCHED_OFF}"] if switch_off(direction.value + number - 1) else []
            except TransferAborted as error:
                notes.append(f"{name} is not used and cannot be switched off: {error.evidence}")
        # All are switched off before one is moved: two PDOs may swap identifiers.
        for pdo in pdos:
            if differences(objects, pdo):
                # With a read-only COB-ID it stays on; its transmission type may be writable.
                with suppress(TransferAborted):
                    switch_off(pdo.communication_index)
        for pdo in pdos:
            if differences(objects, pdo):
                before = held.setdefault(pdo.communication_index, _held(objects, pdo.communication_index))
                _write_pdo(objects, pdo.communication_index, _planned(pdo, before))
                notes.append(f"{pdo.name}{_WRITTEN}")
    return notes


class _Held(NamedTuple):
    """Parameters of a PDO; None: it has none, or they stay unchanged."""

    cob_id: int
    """With its flags."""
    transmission_type: int | None
    timers: Mapping[int, int | None]
    """By sub-index: inhibit time and event timer."""
    mapping: tuple[int, ...]
    """Mapping words."""


def _held(objects: RemoteObjects, communication_index: int) -> _Held:
    """Read the present contents of a PDO. Raises TransferAborted if there is no such PDO."""
    return _Held(
        objects.read(communication_index, 1),
        objects.read_if_there(communication_index, 2, "B"),
        {sub: objects.read_if_there(communication_index, sub, "H") for sub in (3, 5)},
        tuple(_held_mapping(objects, communication_index + MAPPING_OFFSET)),
    )


def _put_back(objects: RemoteObjects, held: Mapping[int, _Held]) -> None:
    """Restore the PDOs found by :func:`_write_all`; here too all are off before one is moved."""
    for communication_index in held:
        with suppress(TransferAborted):
            cob_id = objects.read(communication_index, 1)
            if not cob_id & NOT_VALID:
                objects.write(communication_index, 1, "I", cob_id | NOT_VALID)
    for communication_index, before in held.items():
        with suppress(TransferAborted):
            _write_pdo(objects, communication_index, before)


def _planned(pdo: PdoMap, held: _Held) -> _Held:
    """Return the planned contents of a PDO in a drive whose PDO holds ``held``."""
    # Bit 30 (no remote frames) is kept: some drives refuse the other value. It is reserved in an RPDO.
    remote = held.cob_id & NO_RTR if pdo.direction is PdoDirection.TRANSMIT else 0
    return _Held(
        pdo.cob_id | remote,
        pdo.transmission_type,
        {3: pdo.inhibit_time_100us, 5: pdo.event_timer_ms},
        tuple(entry.mapping_word for entry in pdo.entries),
    )


def _write_pdo(objects: RemoteObjects, communication_index: int, wanted: _Held) -> None:
    """Write a PDO that is switched off, by the standard's procedure."""
    mapping_index = communication_index + MAPPING_OFFSET
    kind = objects.read_if_there(communication_index, 2, "B")
    if wanted.transmission_type is not None and kind not in (None, wanted.transmission_type):
        objects.write(communication_index, 2, "B", wanted.transmission_type)
    for sub, value in wanted.timers.items():
        _write_timer(objects, communication_index, sub, value)
    if tuple(_held_mapping(objects, mapping_index)) != wanted.mapping:
        objects.write(mapping_index, 0, "B", 0)
        for sub, word in enumerate(wanted.mapping, start=1):
            # A drive that refuses a word may refuse it too where it has it already.
            if objects.read_if_there(mapping_index, sub) != word:
                objects.write(mapping_index, sub, "I", word)
        objects.write(mapping_index, 0, "B", len(wanted.mapping))
    if (objects.read(communication_index, 1) ^ wanted.cob_id) & (NOT_VALID | CAN_ID):
        objects.write(communication_index, 1, "I", wanted.cob_id)


def _write_timer(objects: RemoteObjects, index: int, sub: int, value: int | None) -> None:
    """Write inhibit time or event timer; ``differences`` judges a drive that lacks or refuses it."""
    if value is not None and objects.read_if_there(index, sub, "H") not in (None, value):
        with suppress(TransferAborted):
            objects.write(index, sub, "H", value)


def verify_plan(objects: RemoteObjects, plan: PdoPlan) -> None:
    """Raise SettingRefused, naming every difference, unless the drive holds the plan."""
    texts = [text for pdo in plan for text in differences(objects, pdo)]
    if texts:
        raise SettingRefused(
            f"node {objects.node_id} does not hold the PDO plan",
            "; ".join(texts),
            "give a PDO plan that this drive's fixed mapping can serve",
        )


def differences(objects: RemoteObjects, pdo: PdoMap) -> list[str]:
    """Say how the drive's PDO differs from the plan's; empty if it does not."""
    cob_id = objects.read_if_there(pdo.communication_index, 1)
    if cob_id is None:
        return [f"{pdo.name} does not exist"]
    texts = []
    if cob_id & NOT_VALID:
        texts.append(f"{pdo.name} is switched off")
    if cob_id & CAN_ID != pdo.cob_id:
        texts.append(f"{pdo.name} has identifier {cob_id & CAN_ID:03X}h instead of {pdo.cob_id:03X}h")
    kind = objects.read_if_there(pdo.communication_index, 2, "B")
    if kind not in (None, pdo.transmission_type):
        texts.append(f"{pdo.name} has transmission type {kind} instead of {pdo.transmission_type}")
    texts += _timer_differences(objects, pdo)
    held = _held_mapping(objects, pdo.mapping_index)
    planned = [entry.mapping_word for entry in pdo.entries]
    if held != planned:
        texts.append(f"{pdo.name} maps {mapping_text(held) or 'nothing'} instead of {mapping_text(planned)}")
    return texts


def _timer_differences(objects: RemoteObjects, pdo: PdoMap) -> list[str]:
    """Compare the timers. A PDO works without its inhibit time; one that is to be repeated needs its event
    timer."""
    texts = []
    if pdo.inhibit_time_100us:
        inhibit = objects.read_if_there(pdo.communication_index, 3, "H")
        if inhibit not in (None, pdo.inhibit_time_100us):
            texts.append(
                f"{pdo.name} has an inhibit time of {inhibit} x 100 us instead of {pdo.inhibit_time_100us}"
            )
    if pdo.event_timer_ms:
        timer = objects.read_if_there(pdo.communication_index, 5, "H")
        if timer != pdo.event_timer_ms:
            held = "no event timer" if timer is None else f"an event timer of {timer} ms"
            texts.append(f"{pdo.name} has {held} instead of {pdo.event_timer_ms} ms")
    return texts


def _held_mapping(objects: RemoteObjects, mapping_index: int) -> list[int]:
    count = objects.read_if_there(mapping_index, 0, "B") or 0
    return [objects.read(mapping_index, sub) for sub in range(1, min(count, 64) + 1)]

"""PDO capability of a drive, by its dictionary or else read from the drive itself.

CiA 301 7.5.2.35 to 7.5.2.38. A drive may have its mappings fixed, may map only some objects, in one direction
only, may have identifiers or transmission types that cannot be changed, and fewer entries than would fit.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from servobench.drivers.canopen.cob_ids import CAN_ID, NOT_VALID
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import PDO_ENTRIES_MAX, mapping_word, object_name
from servobench.drivers.canopen.pdo import Key, PdoDirection, PdoEntry, key_of


@dataclass(frozen=True, slots=True)
class PdoSlot:
    """One PDO before anybody writes to it."""

    direction: PdoDirection
    number: int
    cob_id: int | None
    """COB-ID with its flags; None if unknown."""
    cob_id_writable: bool
    transmission_type: int | None
    type_writable: bool
    mapping: tuple[int, ...]
    """Mapping words: index, sub-index, bits."""
    mapping_writable: bool
    entries_max: int
    inhibit_time: int | None = None
    """100 us; None if it has none."""
    event_timer: int | None = None
    """ms; None if it has none."""
    entries_told: int = 0
    """High limit of sub-index 0, if it allows more entries than the file defines; else 0."""
    inhibit_writable: bool = False
    event_timer_writable: bool = False

    @property
    def name(self) -> str:
        """TPDO1, RPDO2, ..."""
        return f"{self.direction.letter}PDO{self.number}"

    @property
    def identifier(self) -> int | None:
        """The 11-bit identifier; None if it has none yet."""
        return (self.cob_id or 0) & CAN_ID or None

    @property
    def keys(self) -> set[Key]:
        """The mapped objects."""
        return set(map(key_of, self.mapping))

    @property
    def valid(self) -> bool:
        """True if it exists (bit 31 of its COB-ID)."""
        return self.cob_id is not None and not self.cob_id & NOT_VALID


@dataclass(frozen=True, slots=True)
class MappedObject:
    """An object that a PDO could carry."""

    index: int
    sub: int
    bits: int
    code: str
    """``struct`` character; empty for a length that has none."""
    mappable: bool
    """The dictionary says so."""
    transmittable: bool
    receivable: bool
    name: str = ""

    @property
    def word(self) -> int:
        """Its mapping word."""
        return mapping_word(self.index, self.sub, self.bits)

    def __str__(self) -> str:
        name = object_name(self.index, self.sub)
        return f"{name} ({self.name})" if self.name else name


@dataclass(frozen=True, slots=True)
class PdoCapability:
    """All PDOs of a drive, and the objects that they could carry."""

    slots: tuple[PdoSlot, ...]
    objects: Mapping[Key, MappedObject] = field(default_factory=dict)
    dummies: tuple[int, ...] = ()
    """Data types that serve as placeholders."""
    flags_tell: bool = True
    """Some object is marked mappable; if none is, the marks say nothing."""

    def of(self, direction: PdoDirection) -> tuple[PdoSlot, ...]:
        """Return the PDOs of one direction, by number."""
        return tuple(slot for slot in self.slots if slot.direction is direction)

    def can_carry(self, key: Key, direction: PdoDirection) -> bool:
        """Return True if some PDO carries the object, or could."""
        return self.flexible_object(key, direction) is not None or any(
            key in slot.keys for slot in self.of(direction) if not slot.mapping_writable
        )

    def flexible_object(self, key: Key, direction: PdoDirection) -> MappedObject | None:
        """Return the object, if a PDO with writable mapping may carry it."""
        entry = self.objects.get(key)
        if entry is None or not entry.code:
            return None
        may = entry.transmittable if direction is PdoDirection.TRANSMIT else entry.receivable
        flexible = [slot for slot in self.of(direction) if slot.mapping_writable]
        mapped_by_default = any(key in slot.keys for slot in flexible)
        if not mapped_by_default and not (may and (entry.mappable or not self.flags_tell)):
            return None
        return entry if flexible else None


def capability_of_drive(objects: RemoteObjects, wanted: Mapping[Key, str]) -> PdoCapability:
    """Read the capability of a drive without a dictionary over SDO, its mappings assumed fixed.

    ``wanted``: objects the bench would map, with their ``struct`` characters. Pumps the network.
    """
    slots = []
    for direction in PdoDirection:
        for number in range(1, 5):
            slot = _slot_of_drive(objects, direction, number)
            if slot is not None:
                slots.append(slot)
    return PdoCapability(tuple(slots), objects_of(wanted))


def objects_of(codes: Mapping[Key, str]) -> dict[Key, MappedObject]:
    """Return objects of these types, as if any PDO may carry them."""
    return {
        key: MappedObject(*key, PdoEntry(*key, code).bits, code, True, True, True)
        for key, code in codes.items()
    }


def _slot_of_drive(objects: RemoteObjects, direction: PdoDirection, number: int) -> PdoSlot | None:
    communication = direction.value + number - 1
    mapping = direction.mapping_base + number - 1
    cob_id = objects.read_if_there(communication, 1)
    if cob_id is None:
        return None
    count = min(objects.read_if_there(mapping, 0, "B") or 0, PDO_ENTRIES_MAX)
    words = tuple(objects.read_if_there(mapping, sub) or 0 for sub in range(1, count + 1))
    kind = objects.read_if_there(communication, 2, "B")
    return PdoSlot(direction, number, cob_id, True, kind, True, words, False, count)

"""A PDO plan for a drive's own PDOs: from what the loop needs and what the drive can do.

    flexible PDOs   the needed objects are packed in their order, 64 bits a PDO
    fixed PDOs      those that carry the needed objects are taken as they are, with what else they carry
    both            objects that no flexible PDO may carry are looked for in the fixed ones

The loop needs the statusword, velocity, position and, if the drive tells it, torque with every SYNC; and to
send the controlword and the set-point of a mode.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from drivers.errors import PeerFault
from drivers.objects402 import Object
from drivers.pdo import (
    EVENT_DRIVEN,
    EVERY_SYNC,
    HIGH_RESOLUTION_TIME_STAMP,
    SYNCHRONOUS_MAX,
    PdoDirection,
    PdoEntry,
    PdoMap,
    PdoPlan,
)
from drivers.pdo_capability import MappedObject, PdoCapability, PdoSlot
from drivers.pdo_plans import TARGETS
from drivers.profile402 import Mode
from drivers.sdo import object_name

_BITS_MAX = 64
_Key = tuple[int, int]

STATUS: _Key = (Object.STATUSWORD, 0)
VELOCITY: _Key = (Object.VELOCITY_ACTUAL_VALUE, 0)
TORQUE: _Key = (Object.TORQUE_ACTUAL_VALUE, 0)
CURRENT: _Key = (Object.CURRENT_ACTUAL_VALUE, 0)
POSITION: _Key = (Object.POSITION_ACTUAL_VALUE, 0)
STAMP: _Key = (HIGH_RESOLUTION_TIME_STAMP, 0)
CONTROL: _Key = (Object.CONTROLWORD, 0)


class PlanImpossible(PeerFault):
    """The drive's PDOs cannot carry what the loop needs; ``evidence`` says which of it."""


@dataclass(frozen=True, slots=True)
class PlanWish:
    """What the loop wants of a drive."""

    mode: Mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE
    synchronous_command: bool = False
    """The drive applies the set-point at the next SYNC, not on arrival."""
    position_every_cycles: int = 1
    """Above 1 the position comes with every so many SYNCs only."""
    device_stamp: bool = True
    """The drive's own clock 1013h with every position, if it can be mapped."""


@dataclass(frozen=True, slots=True)
class PlanResult:
    """A plan and what is to be said about it."""

    plan: PdoPlan
    notes: tuple[str, ...] = ()


@dataclass(slots=True)
class _Bin:
    """A PDO being filled."""

    slot: PdoSlot
    entries: list[PdoEntry] = field(default_factory=list)

    def takes(self, entry: PdoEntry) -> bool:
        full = sum(known.bits for known in self.entries) + entry.bits > _BITS_MAX
        return not full and len(self.entries) < self.slot.entries_max


def plan_pdos(capability: PdoCapability, node_id: int, wish: PlanWish) -> PlanResult:
    """The plan. Raises PlanImpossible, saying what cannot be carried.

    Where the entries that the dictionary defines do not do, those are used that sub-index 0 of a mapping
    allows: files define fewer than the drive has.
    """
    try:
        return _plan(capability, node_id, wish)
    except PlanImpossible:
        if not any(slot.entries_told for slot in capability.slots):
            raise
        more = tuple(
            replace(slot, entries_max=max(slot.entries_max, slot.entries_told)) for slot in capability.slots
        )
        result = _plan(replace(capability, slots=more), node_id, wish)
    note = "more objects are mapped than the dictionary defines entries for, as sub-index 0 allows"
    return PlanResult(result.plan, (*result.notes, note))


def _plan(capability: PdoCapability, node_id: int, wish: PlanWish) -> PlanResult:
    notes: list[str] = []
    planner = _Planner(capability, node_id, notes)
    sent = planner.wanted(_fed_back(capability, wish, notes), PdoDirection.TRANSMIT)
    target = TARGETS.get(wish.mode)
    told = [CONTROL] if target is None else [CONTROL, (target.index, target.sub)]
    received = planner.wanted(told, PdoDirection.RECEIVE)
    if planner.lacks:
        raise PlanImpossible(
            f"the drive's PDOs cannot carry what {_mode_name(wish.mode)} needs",
            "; ".join(planner.lacks),
            "use another mode, or another drive",
        )
    tpdos = planner.transmit(sent, wish)
    rpdos = planner.receive(received, wish)
    return PlanResult(PdoPlan(tpdos, rpdos), tuple(notes))


def _mode_name(mode: Mode) -> str:
    return mode.name.lower().replace("_", " ")


def _fed_back(capability: PdoCapability, wish: PlanWish, notes: list[str]) -> list[_Key]:
    """What the drive is to send, in the order of its urgency."""
    keys = [STATUS, VELOCITY]
    torque = next(
        (key for key in (TORQUE, CURRENT) if _can_carry(capability, key, PdoDirection.TRANSMIT)), None
    )
    if torque is None:
        notes.append("neither 6077h nor 6078h can be mapped: readings carry no torque")
    else:
        keys.append(torque)
        if torque == CURRENT:
            notes.append("6077h cannot be mapped: torque is taken from the current 6078h")
    keys.append(POSITION)
    stamped = wish.device_stamp and wish.position_every_cycles == 1
    if stamped and _can_carry(capability, STAMP, PdoDirection.TRANSMIT):
        keys.append(STAMP)
    return keys


def _can_carry(capability: PdoCapability, key: _Key, direction: PdoDirection) -> bool:
    return bool(_flexible_object(capability, key, direction)) or any(
        key in _keys(slot) for slot in capability.of(direction) if not slot.mapping_writable
    )


def _flexible_object(capability: PdoCapability, key: _Key, direction: PdoDirection) -> MappedObject | None:
    """The object, if a PDO whose mapping can be written may carry it."""
    found = capability.objects.get(key)
    if found is None or not found.code:
        return None
    may = found.transmittable if direction is PdoDirection.TRANSMIT else found.receivable
    flexible = [slot for slot in capability.of(direction) if slot.mapping_writable]
    mapped_by_default = any(key in _keys(slot) for slot in flexible)
    if not mapped_by_default and not (may and (found.mappable or not capability.flags_tell)):
        return None
    return found if flexible else None


def _keys(slot: PdoSlot) -> set[_Key]:
    return {(word >> 16, word >> 8 & 0xFF) for word in slot.mapping}


class _Planner:
    def __init__(self, capability: PdoCapability, node_id: int, notes: list[str]) -> None:
        self.lacks: list[str] = []
        self._capability = capability
        self._node_id = node_id
        self._notes = notes

    def wanted(self, keys: Sequence[_Key], direction: PdoDirection) -> list[_Bin]:
        """PDOs that carry the objects; :attr:`lacks` says which none can.

        If the flexible PDOs have no room for all, what fixed ones carry is left to those.
        """
        flexible = {key: made for key in keys if (made := _flexible_object(self._capability, key, direction))}
        bins, lacks = self._cover(keys, flexible, direction)
        if lacks:
            fixed = {key for slot in self._fixed(direction) for key in _keys(slot)}
            spared = {key: made for key, made in flexible.items() if key not in fixed}
            other_bins, other_lacks = self._cover(keys, spared, direction)
            if not other_lacks:
                bins, lacks = other_bins, other_lacks
        self.lacks += [self._lack(key, direction) for key in lacks]
        return sorted(bins, key=lambda made: made.slot.number)

    def _cover(
        self, keys: Sequence[_Key], flexible: Mapping[_Key, MappedObject], direction: PdoDirection
    ) -> tuple[list[_Bin], list[_Key]]:
        """PDOs for the objects, those of ``flexible`` in PDOs that can be mapped; and what none carries."""
        bins = self._pack(flexible, direction)
        lacks = []
        carried = {(entry.index, entry.sub) for made in bins for entry in made.entries}
        for key in (key for key in keys if key not in carried):
            if any(key in _keys(made.slot) for made in bins if not made.slot.mapping_writable):
                continue
            slot = self._fixed_slot(key, keys, direction)
            if slot is None:
                lacks.append(key)
            else:
                bins.append(_Bin(slot, self._entries(slot)))
        return bins, lacks

    def _fixed(self, direction: PdoDirection) -> list[PdoSlot]:
        return [slot for slot in self._capability.of(direction) if not slot.mapping_writable]

    def _pack(self, flexible: Mapping[_Key, MappedObject], direction: PdoDirection) -> list[_Bin]:
        """First fit in order; a PDO that need not be moved or switched on goes first."""
        free = [slot for slot in self._capability.of(direction) if slot.mapping_writable and slot.entries_max]
        free.sort(key=lambda slot: (slot.number > 4, slot.number))
        bins: list[_Bin] = []
        for key, found in flexible.items():
            entry = PdoEntry(*key, found.code)
            taking = next((made for made in bins if made.takes(entry)), None)
            if taking is None and free:
                taking = _Bin(free.pop(0))
                bins.append(taking)
            if taking is not None:
                taking.entries.append(entry)
        return bins

    def _fixed_slot(self, key: _Key, keys: Sequence[_Key], direction: PdoDirection) -> PdoSlot | None:
        """The PDO with a fixed mapping that carries the object and most of the others."""
        able = [slot for slot in self._fixed(direction) if key in _keys(slot) and self._readable(slot, keys)]
        return max(able, key=lambda slot: (len(_keys(slot) & set(keys)), -slot.number), default=None)

    def _readable(self, slot: PdoSlot, keys: Sequence[_Key]) -> bool:
        """Every entry is made of whole octets, and those that are needed have a known type."""
        octets = all(word & 0xFF and not word & 0x07 for word in slot.mapping)
        needed = [key for key in keys if key in _keys(slot)]
        return octets and all(self._code(key, slot) for key in needed)

    def _code(self, key: _Key, slot: PdoSlot) -> str:
        """``struct`` character of an object in a PDO with a fixed mapping; empty if it has none."""
        word = next(word for word in slot.mapping if (word >> 16, word >> 8 & 0xFF) == key)
        found = self._capability.objects.get(key)
        return found.code if found is not None and found.bits == word & 0xFF else ""

    def _entries(self, slot: PdoSlot) -> list[PdoEntry]:
        made = []
        for word in slot.mapping:
            key = (word >> 16, word >> 8 & 0xFF)
            code = self._code(key, slot) or {8: "B", 16: "H", 32: "I"}.get(
                word & 0xFF, f"{(word & 0xFF) // 8}s"
            )
            made.append(PdoEntry(*key, code))
        return made

    def _lack(self, key: _Key, direction: PdoDirection) -> str:
        """Why no PDO can carry an object."""
        name = object_name(*key)
        found = self._capability.objects.get(key)
        slots = self._capability.of(direction)
        kind = f"{direction.letter}PDO"
        if not slots:
            return f"{name}: there is no {kind}"
        if found is None:
            return f"{name} is not in the dictionary"
        if not any(slot.mapping_writable for slot in slots):
            return f"{name}: the {kind}s have fixed mappings without it"
        if not found.code:
            return f"{name} has {found.bits} bits, which is no whole number of octets that is known here"
        may = found.transmittable if direction is PdoDirection.TRANSMIT else found.receivable
        if found.mappable and may:
            return f"{name}: the {kind}s have no room left for it"
        return f"{name} cannot be mapped into a {kind}"

    # ---- communication parameters -------------------------------------------------------------------------

    def transmit(self, bins: Iterable[_Bin], wish: PlanWish) -> tuple[PdoMap, ...]:
        made = []
        for each in bins:
            keys = {(entry.index, entry.sub) for entry in each.entries}
            alone = POSITION in keys and not keys & {STATUS, VELOCITY}
            kind = wish.position_every_cycles if alone else EVERY_SYNC
            kind = self._type(each.slot, kind)
            if kind > SYNCHRONOUS_MAX:
                self._check_inhibit(each.slot)
            made.append(self._map(each, kind))
        return tuple(made)

    def receive(self, bins: Iterable[_Bin], wish: PlanWish) -> tuple[PdoMap, ...]:
        wanted = EVERY_SYNC if wish.synchronous_command else EVENT_DRIVEN
        return tuple(self._map(each, self._type(each.slot, wanted)) for each in bins)

    def _type(self, slot: PdoSlot, wanted: int) -> int:
        held = slot.transmission_type
        if slot.type_writable or held is None or held == wanted:
            return wanted
        if wanted > SYNCHRONOUS_MAX and held > SYNCHRONOUS_MAX:
            return held
        self._notes.append(f"{slot.name} keeps its transmission type {held}, {wanted} was wanted")
        return held

    def _check_inhibit(self, slot: PdoSlot) -> None:
        if slot.inhibit_time:
            text = f"{slot.name} is not synchronous and has an inhibit time of {slot.inhibit_time / 10:g} ms"
            self._notes.append(text)

    def _map(self, each: _Bin, kind: int) -> PdoMap:
        slot = each.slot
        number = min(slot.number, 4)
        predefined = slot.direction.default_cob_id(number, self._node_id) if slot.number <= 4 else None
        fixed = slot.identifier if not slot.cob_id_writable else None
        cob_id = fixed or predefined or slot.identifier
        if cob_id is None:
            summary = f"{slot.name} has no identifier, and the predefined ones are those of PDO 1 to 4"
            raise PlanImpossible(summary, "", "give a PDO plan by hand")
        if slot.cob_id is not None and not slot.valid and not slot.cob_id_writable:
            raise PlanImpossible(
                f"{slot.name} is switched off, and cannot be switched on", "1800h:1 is read-only"
            )
        return PdoMap(slot.direction, slot.number, cob_id, tuple(each.entries), kind)

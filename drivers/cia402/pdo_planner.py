"""Plans a drive's own PDOs: from what the loop needs and what the drive can do.

    flexible PDOs   the layouts of ``pdo_plans``, the best first, one after the other until one fits
    fixed PDOs      those that carry the needed objects are taken as they are, with what else they carry
    both            objects that no flexible PDO may carry are looked for in the fixed ones

A drive without a dictionary is assumed to have four PDOs each way that take any object of CiA 402-2.

The loop needs velocity, position, statusword and, if available, torque; it sends the controlword and the
set-point of a mode. PDOs that fit no layout carry all of it with every SYNC.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.canopen.pdo import (
    BITS_MAX,
    EVENT_DRIVEN,
    EVERY_SYNC,
    SYNCHRONOUS_MAX,
    Key,
    PdoDirection,
    PdoEntry,
    PdoMap,
    PdoPlan,
    key_of,
)
from servobench.drivers.canopen.pdo_capability import MappedObject, PdoCapability, PdoSlot
from servobench.drivers.cia402.pdo_plans import (
    CONTROL,
    CURRENT,
    DEMAND,
    MODE,
    POSITION,
    STAMP,
    STANDARD_CODES,
    STATUS,
    TARGETS,
    TORQUE,
    VELOCITY,
    Group,
    PlanWish,
    choices,
    features_of,
    layout,
    limits_of,
    standard,
)
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.errors import PeerFault


class PlanImpossible(PeerFault):
    """The drive's PDOs cannot carry what the loop needs; ``evidence`` says which part."""


@dataclass(frozen=True, slots=True)
class PlanResult:
    """A plan with its notes."""

    plan: PdoPlan
    notes: tuple[str, ...] = ()


@dataclass(slots=True)
class _Bin:
    """A PDO being filled."""

    slot: PdoSlot
    entries: list[PdoEntry] = field(default_factory=list)
    group: Group | None = None
    """The group it is filled for; None outside a layout."""

    def takes(self, entry: PdoEntry) -> bool:
        full = sum(known.bits for known in self.entries) + entry.bits > BITS_MAX
        return not full and len(self.entries) < self.slot.entries_max


def mode_plan(node_id: int, wish: PlanWish, *, demand_changes: bool = False) -> PdoPlan:
    """Plan the PDOs of one mode, for a drive with free mapping.

    TPDO1 to TPDO3 as :mod:`servobench.drivers.cia402.pdo_plans` lays them out by ``wish``; RPDO1: controlword
    and the set-point of the mode. ``demand_changes``: a TPDO4 with 6074h and 1013h shows when one acted.
    """
    plan = plan_pdos(standard(wish.stamp), node_id, wish).plan
    if not demand_changes:
        return plan
    transmit = PdoDirection.TRANSMIT
    entries = PdoEntry(*DEMAND, STANDARD_CODES[DEMAND]), PdoEntry(*wish.stamp, STANDARD_CODES[STAMP])
    change = PdoMap(transmit, 4, transmit.default_cob_id(4, node_id), entries, EVENT_DRIVEN)
    return replace(plan, tpdos=(*plan.tpdos, change))


def all_modes_plan(node_id: int, *, synchronous_command: bool = False) -> PdoPlan:
    """Plan for a drive that changes between the cyclic modes: one RPDO per set-point, each with the
    controlword, so one frame per cycle does in every mode."""
    modes = (
        Mode.CYCLIC_SYNCHRONOUS_TORQUE,
        Mode.CYCLIC_SYNCHRONOUS_POSITION,
        Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    )
    plans = [mode_plan(node_id, PlanWish(mode, synchronous_command)) for mode in modes]
    receive = PdoDirection.RECEIVE
    rpdos = tuple(
        replace(plan.rpdos[0], number=number, cob_id=receive.default_cob_id(number, node_id))
        for number, plan in enumerate(plans, start=1)
    )
    return replace(plans[0], rpdos=rpdos)


def plan_pdos(capability: PdoCapability, node_id: int, wish: PlanWish) -> PlanResult:
    """Plan the PDOs. Raises PlanImpossible, saying what cannot be carried.

    If the entries defined in the dictionary do not suffice, those allowed by sub-index 0 of a mapping are
    used: files define fewer than the drive has.
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
    planner = _Planner(capability, node_id, notes, wish.stamp)
    torque = _torque(capability, notes)
    laid_out = planner.laid_out(wish, torque)
    needed = [STATUS, VELOCITY, *([] if torque is None else [torque]), POSITION]
    sent = planner.wanted(needed, PdoDirection.TRANSMIT) if laid_out is None else laid_out
    if laid_out is None and wish.features.mode:
        planner.add_mode(sent)
    target = TARGETS.get(wish.mode)
    commanded = [CONTROL] if target is None else [CONTROL, (target.index, target.sub)]
    received = planner.wanted(commanded, PdoDirection.RECEIVE)
    if planner.lacks:
        raise PlanImpossible(
            f"the drive's PDOs cannot carry what {wish.mode.title} needs",
            "; ".join(planner.lacks),
            "use another mode, or another drive",
        )
    tpdos = planner.transmit(sent, wish)
    rpdos = planner.receive(received, wish)
    plan = PdoPlan(tpdos, rpdos)
    notes += limits_of(features_of(plan, wish.stamp), wish)
    return PlanResult(plan, tuple(notes))


def _torque(capability: PdoCapability, notes: list[str]) -> Key | None:
    """Return the object to take as torque; None if none can be mapped."""
    able = (key for key in (TORQUE, CURRENT) if capability.can_carry(key, PdoDirection.TRANSMIT))
    first = next(able, None)
    if first is None:
        notes.append("neither 6077h nor 6078h can be mapped: readings carry no torque")
    elif first == CURRENT:
        notes.append("6077h cannot be mapped: torque is taken from the current 6078h")
    return first


def _serves(slot: PdoSlot, group: Group) -> bool:
    """Return True if identifier, transmission type and event timer of a PDO suit a group."""
    numbered = slot.number <= 4 or slot.identifier is not None
    switchable = slot.cob_id is None or slot.valid or slot.cob_id_writable
    held, wanted = slot.transmission_type, group.transmission_type
    typed = slot.type_writable or held in (None, wanted)
    return numbered and switchable and typed and (not group.event_timer_ms or slot.event_timer_writable)


def _first_fit(entry: PdoEntry, bins: list[_Bin], free: list[PdoSlot], group: Group | None = None) -> bool:
    """Put an entry into the first PDO with room, or the first free one that serves; False if none is."""
    taking = next((made for made in bins if made.takes(entry)), None)
    if taking is None:
        slot = next((slot for slot in free if group is None or _serves(slot, group)), None)
        if slot is None:
            return False
        free.remove(slot)
        taking = _Bin(slot, group=group)
        bins.append(taking)
    taking.entries.append(entry)
    return True


class _Planner:
    def __init__(self, capability: PdoCapability, node_id: int, notes: list[str], stamp: Key) -> None:
        self.lacks: list[str] = []
        self._stamp = stamp
        self._capability = capability
        self._node_id = node_id
        self._notes = notes

    # ---- layouts ------------------------------------------------------------------------------------------

    def laid_out(self, wish: PlanWish, torque: Key | None) -> list[_Bin] | None:
        """Return PDOs for the best layout that fits the flexible ones; None if none fits."""
        able = wish.features._replace(
            stamp=wish.features.stamp and self._flexible(self._stamp),
            demand=wish.features.demand and wish.torque_mode and self._flexible(DEMAND),
            mode=wish.features.mode and self._flexible(MODE),
        )
        for coherent in (True, False) if wish.coherent else (False,):
            for features in choices(able, wish.position_every_cycles):
                bins = self._lay_out(layout(features, torque, wish, coherent=coherent))
                if bins is not None:
                    return bins
        return None

    def _flexible(self, key: Key) -> bool:
        return self._capability.flexible_object(key, PdoDirection.TRANSMIT) is not None

    def _lay_out(self, groups: Sequence[Group]) -> list[_Bin] | None:
        """Place a layout in the flexible TPDOs; a group may take several, but a speed keeps its stamp."""
        free = self._free(PdoDirection.TRANSMIT)
        bins: list[_Bin] = []
        for group in groups:
            filled: list[_Bin] = []
            for key in group.keys:
                able = self._capability.flexible_object(key, PdoDirection.TRANSMIT)
                if able is None or not _first_fit(PdoEntry(*key, able.code), filled, free, group):
                    return None
            if self._stamp in group.keys and len(filled) > 1:
                return None
            bins += filled
        return bins

    def _free(self, direction: PdoDirection) -> list[PdoSlot]:
        """Return PDOs with writable mapping; those that need not be moved or switched on come first."""
        free = [slot for slot in self._capability.of(direction) if slot.mapping_writable and slot.entries_max]
        return sorted(free, key=lambda slot: (slot.number > 4, slot.number))

    # ---- PDOs of any kind ---------------------------------------------------------------------------------

    def wanted(self, keys: Sequence[Key], direction: PdoDirection) -> list[_Bin]:
        """Return PDOs that carry the objects; :attr:`lacks` lists those that none can carry.

        If the flexible PDOs have no room for all, what fixed ones carry is left to those.
        """
        flexible = {key: made for key in keys if (made := self._capability.flexible_object(key, direction))}
        bins, lacks = self._cover(keys, flexible, direction)
        if lacks:
            fixed = {key for slot in self._fixed(direction) for key in slot.keys}
            spared = {key: made for key, made in flexible.items() if key not in fixed}
            other_bins, other_lacks = self._cover(keys, spared, direction)
            if not other_lacks:
                bins, lacks = other_bins, other_lacks
        self.lacks += [self._lack(key, direction) for key in lacks]
        return sorted(bins, key=lambda made: made.slot.number)

    def add_mode(self, bins: list[_Bin]) -> None:
        """Put 6061h into a flexible TPDO with room left; else use one that carries it anyway."""
        able = self._capability.flexible_object(MODE, PdoDirection.TRANSMIT)
        flexible = [made for made in bins if made.slot.mapping_writable]
        carried = any((entry.index, entry.sub) == MODE for made in bins for entry in made.entries)
        if carried or (able and _first_fit(PdoEntry(*MODE, able.code), flexible, [])):
            return
        if slot := self._fixed_slot(MODE, [MODE], PdoDirection.TRANSMIT):
            bins.append(_Bin(slot, self._entries(slot)))

    def _cover(
        self, keys: Sequence[Key], flexible: Mapping[Key, MappedObject], direction: PdoDirection
    ) -> tuple[list[_Bin], list[Key]]:
        """Return PDOs for the objects, ``flexible`` ones in mappable PDOs; and the objects left over."""
        bins = self._pack(flexible, direction)
        lacks = []
        carried = {(entry.index, entry.sub) for made in bins for entry in made.entries}
        for key in (key for key in keys if key not in carried):
            if any(key in made.slot.keys for made in bins if not made.slot.mapping_writable):
                continue
            slot = self._fixed_slot(key, keys, direction)
            if slot is None:
                lacks.append(key)
            else:
                bins.append(_Bin(slot, self._entries(slot)))
        return bins, lacks

    def _fixed(self, direction: PdoDirection) -> list[PdoSlot]:
        return [slot for slot in self._capability.of(direction) if not slot.mapping_writable]

    def _pack(self, flexible: Mapping[Key, MappedObject], direction: PdoDirection) -> list[_Bin]:
        """Place as many objects as find room, in order."""
        free = self._free(direction)
        bins: list[_Bin] = []
        for key, able in flexible.items():
            _first_fit(PdoEntry(*key, able.code), bins, free)
        return bins

    def _fixed_slot(self, key: Key, keys: Sequence[Key], direction: PdoDirection) -> PdoSlot | None:
        """Return the fixed PDO that carries the object and most of the others."""
        able = [slot for slot in self._fixed(direction) if key in slot.keys and self._readable(slot, keys)]
        return max(
            able,
            key=lambda slot: (len(slot.keys & set(keys)), self._stamp in slot.keys, -slot.number),
            default=None,
        )

    def _readable(self, slot: PdoSlot, keys: Sequence[Key]) -> bool:
        """Return True if all entries are whole octets, and the needed ones have a known type."""
        octets = all(word & 0xFF and not word & 0x07 for word in slot.mapping)
        needed = [key for key in keys if key in slot.keys]
        return octets and all(self._code(key, slot) for key in needed)

    def _code(self, key: Key, slot: PdoSlot) -> str:
        """Return the ``struct`` character of an object in a fixed PDO; empty if it has none."""
        word = next(word for word in slot.mapping if key_of(word) == key)
        entry = self._capability.objects.get(key)
        return entry.code if entry is not None and entry.bits == word & 0xFF else ""

    def _entries(self, slot: PdoSlot) -> list[PdoEntry]:
        entries = []
        for word in slot.mapping:
            key = key_of(word)
            code = self._code(key, slot) or {8: "B", 16: "H", 32: "I"}.get(
                word & 0xFF, f"{(word & 0xFF) // 8}s"
            )
            entries.append(PdoEntry(*key, code))
        return entries

    def _lack(self, key: Key, direction: PdoDirection) -> str:
        """Say why no PDO can carry an object."""
        name = object_name(*key)
        entry = self._capability.objects.get(key)
        slots = self._capability.of(direction)
        kind = f"{direction.letter}PDO"
        if not slots:
            return f"{name}: there is no {kind}"
        if entry is None:
            return f"{name} is not in the dictionary"
        if not any(slot.mapping_writable for slot in slots):
            return f"{name}: the {kind}s have fixed mappings without it"
        if not entry.code:
            return f"{name} has {entry.bits} bits, which is no whole number of octets that is known here"
        may = entry.transmittable if direction is PdoDirection.TRANSMIT else entry.receivable
        if entry.mappable and may:
            return f"{name}: the {kind}s have no room left for it"
        return f"{name} cannot be mapped into a {kind}"

    # ---- communication parameters -------------------------------------------------------------------------

    def transmit(self, bins: Iterable[_Bin], wish: PlanWish) -> tuple[PdoMap, ...]:
        maps = []
        for each in bins:
            if each.group is not None:
                maps.append(self._map(each, each.group.transmission_type))
                continue
            keys = {(entry.index, entry.sub) for entry in each.entries}
            alone = POSITION in keys and not keys & {STATUS, VELOCITY}
            apart = not keys & {STATUS, VELOCITY, POSITION, TORQUE, CURRENT}  # the mode alone
            kind = wish.position_every_cycles if alone else EVENT_DRIVEN if apart else EVERY_SYNC
            kind = self._type(each.slot, kind)
            if kind > SYNCHRONOUS_MAX and each.slot.inhibit_time:
                named = f"{each.slot.name} is not synchronous and has an inhibit time"
                self._notes.append(f"{named} of {each.slot.inhibit_time / 10:g} ms")
            maps.append(self._map(each, kind))
        return tuple(maps)

    def receive(self, bins: Iterable[_Bin], wish: PlanWish) -> tuple[PdoMap, ...]:
        kind = EVERY_SYNC if wish.synchronous_command else EVENT_DRIVEN
        return tuple(self._map(each, self._type(each.slot, kind)) for each in bins)

    def _type(self, slot: PdoSlot, wanted: int) -> int:
        held = slot.transmission_type
        if slot.type_writable or held is None or held == wanted:
            return wanted
        if wanted > SYNCHRONOUS_MAX and held > SYNCHRONOUS_MAX:
            return held
        self._notes.append(f"{slot.name} keeps its transmission type {held}, {wanted} was wanted")
        return held

    def _map(self, each: _Bin, kind: int) -> PdoMap:
        slot = each.slot
        cob_id = self._identifier(slot)
        if cob_id is None:
            summary = f"{slot.name} has no identifier, and the predefined ones are those of PDO 1 to 4"
            raise PlanImpossible(summary, "", "give a PDO plan by hand")
        if slot.cob_id is not None and not slot.valid and not slot.cob_id_writable:
            raise PlanImpossible(
                f"{slot.name} is switched off, and cannot be switched on", "1800h:1 is read-only"
            )
        inhibit = timer = 0
        if each.group is not None:
            inhibit = each.group.inhibit_time_100us if slot.inhibit_writable else 0
            timer = each.group.event_timer_ms
            if timer and not inhibit and STATUS in each.group.keys:
                self._notes.append(
                    f"{slot.name} has no inhibit time: a statusword that chatters fills the bus"
                )
        return PdoMap(slot.direction, slot.number, cob_id, tuple(each.entries), kind, inhibit, timer)

    def _identifier(self, slot: PdoSlot) -> int | None:
        """Return the fixed identifier, the predefined one, or the present one."""
        predefined = slot.direction.default_cob_id(slot.number, self._node_id) if slot.number <= 4 else None
        fixed = slot.identifier if not slot.cob_id_writable else None
        return fixed or predefined or slot.identifier

"""Many objects of a drive brought to given values, by what depends on what, and compared until all is held.

PDOs come first, by the rules of CiA 301 7.5.2.35 to 7.5.2.38: all that differ are switched off, then each
gets its parameters with the mapping's count at 0 meanwhile, and its COB-ID last. The others follow in the
order given, each behind what the standard wants first:

    1005h, 1012h    bits 0 to 29 change while nothing is produced or consumed (7.5.2.5, 7.5.2.15)
    1014h, 1028h    bits 0 to 29 change while bit 31 is 1 (7.5.2.17, 7.5.2.31)
    1016h           no two consumers of one node: those that change are emptied first (7.5.2.19)
    1019h           changes while 1006h is 0 (7.5.2.22)
    1201h to 12FFh  change while bit 31 of the COB-IDs is 1 (7.5.2.33, 7.5.2.34)

A bound may refuse the value that its successor allows, and a write may change other objects: whatever still
differs is written again as long as that helps.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from servobench.drivers.canopen.cob_ids import NOT_VALID
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import (
    MANUFACTURER,
    MAPPING_OFFSET,
    PDO_PARAMETERS,
    SDO_SERVER,
    Cia301,
)
from servobench.drivers.canopen.write_list import ListedWrite, Product
from servobench.drivers.errors import TransferAborted
from servobench.hil.restoring.journal import ObjectKey

_ROUNDS_MAX: Final = 6
"""Bounds that hold each other take two or three; two objects that change each other would go on for ever."""
_PRODUCES: Final = 1 << 30
_EMCY_CONSUMERS: Final = 0x1028
_SDO_PARAMETERS: Final = range(SDO_SERVER, SDO_SERVER + 0x100)
_COB_ID_SUBS: Final = (1, 2)
_CYCLE: Final = ObjectKey(Cia301.CYCLE_PERIOD, 0)
_COUNTER: Final = ObjectKey(Cia301.SYNC_COUNTER_OVERFLOW, 0)
Values = Mapping[ObjectKey, bytes]
Same = Callable[[ObjectKey, bytes, bytes], bool]
"""Tells if two values of an object are one."""


@dataclass(slots=True)
class WrittenSettings:
    """Result of writing many objects."""

    written: set[ObjectKey] = field(default_factory=set)
    """Objects that held another value."""
    refusals: dict[ObjectKey, str] = field(default_factory=dict)
    """The drive's words for the last write of an object that it refused."""
    held: dict[ObjectKey, bytes | None] = field(default_factory=dict)
    """What objects hold at the end instead of the value wanted; None: they cannot be read."""


def write_settings(
    network: CanopenNetwork,
    node: int,
    wanted: Values,
    same: Same = lambda _key, held, value: held == value,
    check: Callable[[], None] = lambda: None,
) -> WrittenSettings:
    """Bring objects to the values ``wanted``, others than PDO parameters in its order; the drive is disabled,
    and pre-operational. ``check``: called before each write; may raise.

    A refusal leaves the rest in order. Raises NoAnswer or BusDown.
    """
    return _Writer(network, node, dict(wanted), same, check).write()


def download_order(values: Values) -> Iterator[tuple[ObjectKey, bytes]]:
    """Yield the writes by which a manager who does not read brings a device that is pre-operational to
    ``values``: PDOs as above, then the others in their order, each behind what the standard wants first.
    """
    pdos = sorted({pdo for key in values if (pdo := pdo_of(key.index)) is not None})
    cob_ids = {key: values[key] for pdo in pdos if (key := ObjectKey(pdo, 1)) in values}
    for key, cob_id in cob_ids.items():
        yield key, _with_bits(cob_id, NOT_VALID)
    for pdo in pdos:
        count = ObjectKey(pdo + MAPPING_OFFSET, 0)
        used = int.from_bytes(values.get(count, b""), "little")
        entries = {each: values[each] for each in sorted(values) if each.index == count.index and each.sub}
        if count in values:
            yield count, bytes(len(values[count]))
            yield from (each for each in entries.items() if each[0].sub <= used or any(each[1]))
            yield count, values[count]
        yield from ((key, values[key]) for key in sorted(values) if key.index == pdo and key.sub != 1)
    yield from cob_ids.items()
    others = {key: value for key, value in values.items() if pdo_of(key.index) is None}
    if _COUNTER in others and _CYCLE in others:
        others[_CYCLE] = others.pop(_CYCLE)
        yield _CYCLE, bytes(len(others[_CYCLE]))
    for key, value in others.items():
        if key.index == Cia301.CONSUMER_HEARTBEAT_TIME:
            yield key, bytes(len(value))
        elif freed := _freed(key, value):
            yield key, freed
    yield from others.items()


def _freed(key: ObjectKey, cob_id: bytes) -> bytes:
    """Return a COB-ID that stands for nothing; empty for what is none."""
    if _is_switched_off_by_bit_31(key):
        return _with_bits(cob_id, NOT_VALID)
    clear = _produced_by(key.index)
    return _with_bits(cob_id, 0, clear) if clear else b""


def _produced_by(index: int) -> int:
    """Return the bits of a COB-ID with which the device produces or consumes; 0 for all others."""
    both = _PRODUCES | NOT_VALID if index == Cia301.TIME_COB_ID else 0
    return _PRODUCES if index == Cia301.SYNC_COB_ID else both


def _with_bits(cob_id: bytes, bits: int, clear: int = 0) -> bytes:
    return (int.from_bytes(cob_id, "little") & ~clear | bits).to_bytes(len(cob_id), "little")


def writes_to(
    keys: Collection[ObjectKey], product: Product | None, why: str, when: str
) -> Iterator[ListedWrite]:
    """Yield the writes to ``keys``, and to the objects that :func:`write_settings` changes beside them for a
    while. ``product``: the drive; ValueError for its maker's objects without."""
    subs = dict[int, list[int]]()
    for key in sorted(_with_helpers(keys)):
        subs.setdefault(key.index, []).append(key.sub)
    for index, own in subs.items():
        of_whom = product if index in MANUFACTURER else None
        yield ListedWrite(range(index, index + 1), tuple(own), f"{index:04X}h", why, when, of_whom)


def _with_helpers(keys: Collection[ObjectKey]) -> set[ObjectKey]:
    pdos = {pdo for key in keys if (pdo := pdo_of(key.index)) is not None}
    helping = {each for pdo in pdos for each in (ObjectKey(pdo, 1), ObjectKey(pdo + MAPPING_OFFSET, 0))}
    return {*keys, *helping} | ({_CYCLE} if _COUNTER in keys else set())


def pdo_of(index: int) -> int | None:
    """The communication parameter of the PDO that an object belongs to; None for any other object."""
    return index & ~MAPPING_OFFSET if index in PDO_PARAMETERS else None


class _Writer:
    """One call of :func:`write_settings`."""

    def __init__(
        self,
        network: CanopenNetwork,
        node: int,
        wanted: dict[ObjectKey, bytes],
        same: Same,
        check: Callable[[], None],
    ) -> None:
        self._objects = RemoteObjects(network, node)
        self._wanted = wanted
        self._same = same
        self._check = check
        self._result = WrittenSettings()

    def write(self) -> WrittenSettings:
        result, before = self._result, dict[ObjectKey, bytes | None]()
        for _ in range(_ROUNDS_MAX):
            result.held = self._differing()
            if not result.held or result.held == before:
                break
            before = dict(result.held)
            self._write_pdos({pdo for key in before if (pdo := pdo_of(key.index)) is not None})
            self._write_others(before)
        else:
            result.held = self._differing()
        return result

    def _differing(self) -> dict[ObjectKey, bytes | None]:
        differing = {}
        for key, value in self._wanted.items():
            held = self._held(key)
            if held is None or not self._same(key, held, value):
                differing[key] = held
        return differing

    # ---- PDOs -----------------------------------------------------------------------------------------

    def _write_pdos(self, differing: set[int]) -> None:
        """Only PDOs that differ are touched: one with a fixed mapping was never changed."""
        alive: dict[ObjectKey, bytes] = {}
        for pdo in sorted(differing):
            cob_id = self._objects.read_if_there(pdo, 1)
            if cob_id is not None and not cob_id & NOT_VALID:
                alive[ObjectKey(pdo, 1)] = cob_id.to_bytes(4, "little")
                self._attempt(ObjectKey(pdo, 1), (cob_id | NOT_VALID).to_bytes(4, "little"))
        for pdo in sorted(differing):
            own = {key: value for key, value in self._wanted.items() if pdo_of(key.index) == pdo}
            self._write_pdo(pdo, own)
        for pdo in sorted(differing):
            key = ObjectKey(pdo, 1)
            cob_id_held = self._wanted.get(key, alive.get(key))
            if cob_id_held is not None:
                self._put(key, cob_id_held)

    def _write_pdo(self, pdo: int, own: Values) -> None:
        """Write a PDO that is switched off, but for its COB-ID."""
        mapping = {key: value for key, value in own.items() if key.index != pdo}
        if mapping:
            count = ObjectKey(pdo + MAPPING_OFFSET, 0)
            size = own.get(count) or self._held(count) or b"\0"
            self._attempt(count, b"\0")
            for key in sorted(key for key in mapping if key.sub):
                self._put(key, mapping[key])
            self._put(count, size)
        for key in sorted(key for key in own if key.index == pdo and key.sub != 1):
            self._put(key, own[key])

    # ---- all else -------------------------------------------------------------------------------------

    def _write_others(self, differing: Mapping[ObjectKey, bytes | None]) -> None:
        keys = [key for key in differing if pdo_of(key.index) is None]
        cycle = self._stop_cycle() if _COUNTER in keys else None
        if cycle is not None:
            self._wanted.setdefault(_CYCLE, cycle)
            keys = [key for key in keys if key != _CYCLE] + [_CYCLE]
        consumers = [key for key in keys if key.index == Cia301.CONSUMER_HEARTBEAT_TIME]
        if len(consumers) > 1:
            for key in consumers:
                self._put(key, bytes(len(self._wanted[key])))
        for key in keys:
            self._free(key)
        for key in keys:
            self._put(key, self._wanted[key])

    def _stop_cycle(self) -> bytes | None:
        """Set 1006h to 0; return what it held, None if it was 0 or is not there."""
        held = self._held(_CYCLE)
        if held is None or not any(held):
            return None
        self._attempt(_CYCLE, bytes(len(held)))
        return held

    def _free(self, key: ObjectKey) -> None:
        """Switch off what a COB-ID stands for, if its other bits change."""
        clear = _produced_by(key.index)
        sets = NOT_VALID if _is_switched_off_by_bit_31(key) else 0
        held = self._held(key) if clear or sets else None
        if held is None:
            return
        cob_id = int.from_bytes(held, "little")
        freed = cob_id & ~clear | sets
        if freed != cob_id:
            self._attempt(key, freed.to_bytes(len(held), "little"))

    # ---- one object -----------------------------------------------------------------------------------

    def _held(self, key: ObjectKey) -> bytes | None:
        try:
            return self._objects.network.upload(self._objects.node_id, key.index, key.sub)
        except TransferAborted:
            return None

    def _put(self, key: ObjectKey, value: bytes) -> None:
        held = self._held(key)
        if held is None or not self._same(key, held, value):
            self._result.written.add(key)
            self._attempt(key, value)

    def _attempt(self, key: ObjectKey, value: bytes) -> None:
        """Write; a refusal shows in the comparison at the end."""
        self._check()
        try:
            self._objects.network.download(self._objects.node_id, key.index, key.sub, value)
        except TransferAborted as error:
            self._result.refusals[key] = error.evidence
        else:
            self._result.refusals.pop(key, None)


def _is_switched_off_by_bit_31(key: ObjectKey) -> bool:
    if key.index in _SDO_PARAMETERS:
        return key.index > SDO_SERVER and key.sub in _COB_ID_SUBS
    return key.index == Cia301.EMCY_COB_ID or (key.index == _EMCY_CONSUMERS and key.sub > 0)

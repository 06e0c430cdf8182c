"""Sections into objects: variables, arrays, records, and the short forms of them (CiA 306-1 clause 4.6).

Objects of a file as the object dictionary of python canopen.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, cast

import canopen.objectdictionary as od

from servobench.drivers.canopen.cob_ids import EXTENDED, NO_RTR, NOT_VALID
from servobench.drivers.canopen.objects301 import FIRST_OBJECT, DataType
from servobench.drivers.sheets.eds import types
from servobench.drivers.sheets.eds.entries import Entry, EntryReader, Place, Scalar, Value, read_value
from servobench.drivers.sheets.eds.information import Commissioning, DeviceInformation
from servobench.drivers.sheets.eds.numbers import Formula, integer
from servobench.drivers.sheets.eds.sections import (
    COMMISSIONING,
    EdsSection,
    Option,
    Sections,
    object_of,
    section_name,
    table_of,
)
from servobench.drivers.sheets.eds.text import NoDataSheet, RepairLog

_SUBS_MAX = 254
"""A sub-index is an UNSIGNED8, and FFh is no entry but describes the object's structure (CiA 301)."""
ENTRIES_MAX = 100_000
"""Far more than a drive of eight axes has; one line with CompactSubObj makes 254."""


@dataclass(slots=True)
class EdsObject:
    """An object and its entries by sub-index; a variable has the one entry 0."""

    index: int
    name: str
    object_type: int
    """VARIABLE, DOMAIN_OBJECT, ARRAY or RECORD."""
    entries: dict[int, Entry] = field(default_factory=dict)
    storage: str | None = None

    @property
    def is_variable(self) -> bool:
        return self.object_type in (types.VARIABLE, types.DOMAIN_OBJECT)


def build_objects(sections: Sections, node_id: int | None, log: RepairLog) -> dict[int, EdsObject]:
    """Build every object that the sections define, by index."""
    builder = _Builder(sections, node_id, log)
    heads: dict[int, EdsSection | None] = {}
    for name, section in sections.items():
        named = object_of(name)
        if named is None or named.index < FIRST_OBJECT:
            continue
        if named.sub is None:
            heads[named.index] = section
        else:
            heads.setdefault(named.index, None)
            builder.subs.setdefault(named.index, {})[named.sub] = section
    objects: dict[int, EdsObject] = {}
    entries = 0
    for index in sorted(heads):
        made = builder.build(index, heads[index])
        if made is not None:
            objects[index] = made
            entries += len(made.entries)
        if entries > ENTRIES_MAX:
            raise NoDataSheet(f"more than {ENTRIES_MAX} entries, the last of {index:04X}h")
    builder.note_stray_tables(objects)
    return objects


class _Builder:
    def __init__(self, sections: Sections, node_id: int | None, log: RepairLog) -> None:
        self.subs: dict[int, dict[int, EdsSection]] = {}
        self._sections = sections
        self._configured = COMMISSIONING in sections
        """True for a DCF: its tables of values hold the configured values, those of an EDS the defaults."""
        self._log = log
        self._read = EntryReader(sections, node_id)

    def build(self, index: int, head: EdsSection | None) -> EdsObject | None:
        subs = self.subs.get(index, {})
        if head is None:
            head = self._made_up_head(index, subs)
        elif not head.options and not subs:
            return self._empty(index, head)
        kind = self._object_type(index, head, subs)
        if kind in (types.DEFTYPE, types.DEFSTRUCT):
            return None
        if kind == types.NULL_OBJECT:
            head.mend("the object is of type NULL", "left out")
            return None
        built = EdsObject(index, self._read.name(head), kind, storage=head.text("StorageLocation") or None)
        compact = self._compact_count(head, built)
        if compact:
            self._expand(built, head, compact)
        if built.is_variable:
            built.entries[0] = self._read.entry(head, index, None)
            return built
        for sub in sorted(subs):
            built.entries[sub] = self._read.entry(subs[sub], index, sub)
        if not built.entries and not self._without_subs(built, head):
            return None
        if not built.is_variable:
            self._check_count(built, head, compact)
            self._add_sub_0(built, head)
        built.entries = dict(sorted(built.entries.items()))
        return built

    # ---- what kind of object ------------------------------------------------------------------------------

    def _made_up_head(self, index: int, subs: dict[int, EdsSection]) -> EdsSection:
        first = subs[min(subs)]
        head = EdsSection(section_name(index), first.line, self._log)
        kind = types.standard_object_type(index)
        array = kind == types.ARRAY
        for name, value in (
            ("ParameterName", f"Object {index:04X}h"),
            ("ObjectType", "0x8" if array else "0x9"),
        ):
            head.options[name.lower()] = Option(name, value, first.line)
        taken = "an array" if array else "a record"
        head.mend("its sub-objects are there, but not the object", f"taken for {taken}")
        return head

    def _empty(self, index: int, head: EdsSection) -> EdsObject | None:
        """A section without a single option: the object is named, but not defined."""
        data_type = types.standard_type(index, None)
        if data_type is None:
            head.mend("the section is empty", "left out")
            return None
        name = types.type_name(data_type)
        head.mend("the section is empty", f"taken for a variable of {name}, as in the standard")
        entry = Entry(index, 0, f"Object {head.name}", data_type)
        return EdsObject(index, entry.name, types.VARIABLE, {0: entry})

    def _object_type(self, index: int, head: EdsSection, subs: dict[int, EdsSection]) -> int:
        option = head.option("ObjectType")
        kind = None
        if option is not None:
            named = types.OBJECT_TYPES.get(option.value.strip().upper())
            if named is not None:
                head.mend(f"ObjectType is {option.value!r}", f"read as {named}", option.line)
            kind = named if named is not None else head.number("ObjectType")
        if kind is None or kind not in types.OBJECT_TYPES.values():
            return self._supposed_type(index, head, subs, kind)
        if kind in (types.VARIABLE, types.DOMAIN_OBJECT) and subs:
            if set(subs) == {0} and head.option("DataType"):
                head.mend("a variable with a sub-object 0", "the sub-object is left out")
                subs.clear()
                return kind
            head.mend("a variable with sub-objects", "taken for a record")
            return types.RECORD
        return kind

    def _supposed_type(
        self, index: int, head: EdsSection, subs: dict[int, EdsSection], kind: int | None
    ) -> int:
        """CiA 306-1: without ObjectType it is a variable; sub-objects, or the standard, say more."""
        if subs:
            supposed = types.ARRAY if types.standard_object_type(index) == types.ARRAY else types.RECORD
        elif head.text("CompactSubObj") not in ("", "0"):
            supposed = types.ARRAY
        else:
            supposed = types.VARIABLE
        if kind is not None or subs:
            fault = "ObjectType is missing" if kind is None else f"ObjectType {kind} is unknown"
            name = {types.VARIABLE: "a variable", types.ARRAY: "an array"}.get(supposed, "a record")
            head.mend(fault, f"taken for {name}")
        return supposed

    # ---- short forms --------------------------------------------------------------------------------------

    def _compact_count(self, head: EdsSection, made: EdsObject) -> int:
        """CompactSubObj: return the number of identical entries; 0 if the object is not compact."""
        if not head.text("CompactSubObj"):
            return 0
        count = head.number("CompactSubObj") or 0
        if not 0 <= count <= _SUBS_MAX:
            head.mend(f"CompactSubObj is {count}", f"{_SUBS_MAX} taken")
            count = min(max(count, 0), _SUBS_MAX)
        if count and made.is_variable:
            head.mend("a variable with CompactSubObj", "taken for an array")
            made.object_type = types.ARRAY
        return count

    def _expand(self, made: EdsObject, head: EdsSection, count: int) -> None:
        """Add entries 1 to ``count`` like the head; differing names and values have separate tables."""
        template = self._read.entry(head, made.index, 1)
        made.entries[0] = Entry(made.index, 0, "Number of entries", DataType.UNSIGNED8, "ro")
        made.entries[0].default = Value(count, text=str(count))
        for sub in range(1, count + 1):
            made.entries[sub] = replace(
                template, sub=sub, name=f"{made.name}{sub}", extras=dict(template.extras)
            )
        for kind in ("name", "value", "denotation"):
            table = self._sections.get(f"{made.index:04X}{kind.capitalize()}")
            if table is not None:
                self._apply_table(made, table, kind, template.data_type)

    def _apply_table(self, made: EdsObject, table: EdsSection, kind: str, data_type: int) -> None:
        listed = 0
        for option in table.options.values():
            spelled = integer(option.name)
            if spelled is None:
                continue
            listed += 1
            entry = made.entries.get(spelled.value)
            if entry is None or not spelled.value:
                table.mend(f"entry {option.name} is beyond the object", "left out", option.line)
            elif kind == "name":
                entry.name = option.value or entry.name
            elif kind == "denotation":
                entry.denotation = option.value
            elif option.value:
                place = Place(table, made.index, spelled.value, data_type)
                value = read_value(option, place)
                if self._configured:
                    entry.configured = value
                else:
                    entry.default = value
        self._check_table_count(table, listed)

    def _check_table_count(self, table: EdsSection, listed: int) -> None:
        option = table.option("NrOfEntries")
        spelled = integer(option.value) if option is not None else None
        if option is None:
            table.mend("NrOfEntries is missing", f"the {listed} entries that are there count")
        elif spelled is None or spelled.value != listed:
            fault = f"NrOfEntries is {option.value}, {listed} are there"
            table.mend(fault, "those that are there count", option.line)

    # ---- counts and sub-index 0 ---------------------------------------------------------------------------

    def _without_subs(self, made: EdsObject, head: EdsSection) -> bool:
        """An array or record of which no entry is defined; False if it is to be left out."""
        data_type = integer(head.text("DataType") or "0")
        typed = data_type is not None and data_type.value in types.KNOWN_TYPES
        spelled = integer(head.text("SubNumber") or "0")
        count = min((spelled.value if spelled is not None else 0) - 1, _SUBS_MAX)
        kind = "an array" if made.object_type == types.ARRAY else "a record"
        if typed and count > 0:
            head.mend(f"{kind} without sub-objects", f"given {count} like its head")
            self._expand(made, head, count)
            return True
        if typed:
            head.mend(f"{kind} without sub-objects", "taken for a variable")
            made.object_type = types.VARIABLE
            made.entries[0] = self._read.entry(head, made.index, None)
            return True
        head.mend(f"{kind} of which no sub-object is defined", "left out")
        return False

    def _check_count(self, made: EdsObject, head: EdsSection, compact: int) -> None:
        option = head.options.get("subnumber")
        if option is None or (compact and not option.value):
            return
        count = head.number("SubNumber")
        there = len(made.entries)
        # A compact object has none that stand in the file; some tools count those it stands for.
        if count is not None and count != there and not (compact and count in (0, compact)):
            fault = f"SubNumber is {count}, {there} sub-objects are there"
            head.mend(fault, "those that are there count", option.line)

    def _add_sub_0(self, made: EdsObject, head: EdsSection) -> None:
        if 0 in made.entries:
            return
        highest = max(made.entries)
        entry = Entry(made.index, 0, "Highest sub-index", DataType.UNSIGNED8, "ro")
        entry.default = Value(highest, text=str(highest))
        made.entries[0] = entry
        head.mend("sub-object 0 is missing", f"made, UNSIGNED8 = {highest}")

    def note_stray_tables(self, objects: dict[int, EdsObject]) -> None:
        """Tables of names or values that belong to no compact object."""
        for name, section in self._sections.items():
            table = table_of(name)
            if table is None or table[1] == "objectlinks":
                continue
            head = self._sections.get(section_name(table[0]))
            compact = head is not None and head.text("CompactSubObj") not in ("", "0")
            if table[0] not in objects or not compact:
                section.mend("no compact object has this table", "left out")


_FLAGS = NOT_VALID | NO_RTR | EXTENDED


def to_canopen(
    objects: Mapping[int, EdsObject],
    dummies: Iterable[int],
    device: DeviceInformation,
    commissioning: Commissioning | None,
    node_id: int | None,
) -> od.ObjectDictionary:
    """Build the dictionary; ``node_id`` replaces $NODEID; without it, a value that needs it is None."""
    dictionary = od.ObjectDictionary()  # type: ignore[no-untyped-call]
    dictionary.node_id = node_id
    if commissioning is not None and commissioning.bit_rate_kbit_s:
        dictionary.bitrate = commissioning.bit_rate_kbit_s * 1000
    _describe(dictionary, device)
    for number in dummies:
        dummy = od.ODVariable(f"Dummy{number:04d}", number, 0)
        dummy.data_type, dummy.access_type = number, "const"
        dictionary.add_object(dummy)
    configured_for = commissioning.node_id if commissioning is not None else None
    for index in sorted(objects):
        dictionary.add_object(_object(objects[index], node_id, configured_for))
    return dictionary


def _describe(dictionary: od.ObjectDictionary, device: DeviceInformation) -> None:
    information: Any = dictionary.device_information
    information.vendor_name, information.vendor_number = device.vendor_name, device.vendor_number
    information.product_name, information.product_number = device.product_name, device.product_number
    information.revision_number, information.order_code = device.revision_number, device.order_code
    information.nr_of_RXPDO, information.nr_of_TXPDO = device.receive_pdos, device.transmit_pdos
    information.granularity = device.granularity
    information.LSS_supported = device.lss_supported
    information.simple_boot_up_slave = device.simple_boot_up_slave
    information.allowed_baudrates.update(rate * 1000 for rate in device.bit_rates_kbit_s)


def _object(
    defined: EdsObject, node_id: int | None, configured_for: int | None
) -> od.ODVariable | od.ODArray | od.ODRecord:
    if defined.is_variable:
        return _variable(defined.entries[0], node_id, configured_for)
    kind = od.ODArray if defined.object_type == types.ARRAY else od.ODRecord
    parent: Any = kind(defined.name, defined.index)
    parent.storage_location = defined.storage
    for entry in defined.entries.values():
        parent.add_member(_variable(entry, node_id, configured_for))
    return cast(od.ODArray | od.ODRecord, parent)


def _variable(entry: Entry, node_id: int | None, configured_for: int | None) -> od.ODVariable:
    variable: Any = od.ODVariable(entry.name, entry.index, entry.sub)
    variable.data_type, variable.access_type = entry.data_type, entry.access
    variable.pdo_mappable, variable.storage_location = entry.mappable, entry.storage
    variable.min, variable.max = _limit(entry.low), _limit(entry.high)
    variable.default = entry.default.at(node_id)
    variable.value = entry.configured.at(node_id)
    followed = _followed(entry, configured_for)
    variable.relative = followed is not None
    if followed is not None and variable.value is not None and node_id is not None:
        variable.value = followed.at(node_id)
    if entry.default.text:
        variable.default_raw = entry.default.text
    if entry.configured.text:
        variable.value_raw = entry.configured.text
    variable.unit = entry.extras.get("Unit", "")
    variable.description = entry.extras.get("Description", "")
    with suppress(ValueError):
        variable.factor = float(entry.extras.get("Factor", "1"))
    return cast(od.ODVariable, variable)


def _followed(entry: Entry, configured_for: int | None) -> Formula | None:
    """Return the formula of a value: that of the parameter value if there is one, else the default's.

    Tools write the parameter values of a DCF as plain numbers. One that is the default's identifier on the
    node of the DCF, be it with other flags (bits 29 to 31), goes on following the node-ID.
    """
    configured, default = entry.configured, entry.default.formula
    if configured.formula is not None:
        return configured.formula if configured.formula.factor == 1 else None
    if default is None or default.factor != 1 or configured.value is None:
        return default if default is not None and default.factor == 1 else None
    if configured_for is None or not isinstance(configured.value, int):
        return None
    base = configured.value - configured_for
    return Formula(1, base) if not (base ^ default.base) & ~_FLAGS else None


def _limit(value: Scalar | None) -> int | float | None:
    return value if isinstance(value, int | float) else None

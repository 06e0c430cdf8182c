"""A vendor's EDS or DCF laid over the dictionary of a simulated device (CiA 306-1).

    in the file, known to the device      behaviour of the device; access, limits and default of the file,
                                          its own default where the file gives none
    in the file, not known                plain typed storage with access, range and length checks
    known, not in the file                not on the bus; the application still sees its own value
    2000h..5FFFh                          the file's: the same index means something else there, unless it is
                                          the device's own data sheet

A variable of the device profile whose type is not the file's is the file's plain storage too. 1000h and
1001h are mandatory (CiA 301, 7.5.2) and stay even if the file forgets them; 1018h was not in the first
versions of the standard. Its numbers, and 1008h, come from [DeviceInfo] where the objects have none.
"""

from collections.abc import Mapping
from typing import Any

import canopen.objectdictionary as od

from servobench.drivers.canopen.objects301 import (
    BITS,
    FIRST_OBJECT,
    MANUFACTURER,
    PDO_PARAMETERS,
    REAL_BITS,
    SIGNED_BITS,
    Cia301,
    DataType,
)
from servobench.drivers.sheets.dictionary import held_by, told_identity
from servobench.virtual_bus.device.object_dictionary import (
    Access,
    DictionaryObject,
    ObjectCode,
    ObjectDictionary,
    Variable,
)
from servobench.virtual_bus.device.sdo_abort import encode

BASE_NODE_ID = 1
"""The node-ID to load the file with; it is taken off the defaults again that depend on it."""

_MANDATORY = frozenset({Cia301.DEVICE_TYPE, Cia301.ERROR_REGISTER})
_PROFILE = range(0x6000, 0x10000)


def overlay(dictionary: ObjectDictionary, vendor: od.ObjectDictionary) -> None:
    """Make ``dictionary`` what ``vendor``, loaded for BASE_NODE_ID, says."""
    entries: Mapping[int, Any] = {index: entry for index, entry in vendor.items() if index >= FIRST_OBJECT}
    makers = range(0) if _is_of(vendor, dictionary) else MANUFACTURER
    for own in list(dictionary):
        if own.index in makers or (own.index not in entries and own.index not in _MANDATORY):
            dictionary.conceal(own.index)
    for index, entry in entries.items():
        theirs = _object(index, entry)
        if theirs.members:
            if index in dictionary:
                _merge(dictionary.object(index), theirs, _silent(entry))
            dictionary.put(theirs)
    _identify(dictionary, vendor)


def _is_of(vendor: od.ObjectDictionary, dictionary: ObjectDictionary) -> bool:
    """The file is the device's own data sheet: what it has of 2000h to 5FFFh the device knows."""
    told, name = told_identity(vendor), vendor.device_information.product_name or ""
    return (
        _held(dictionary, Cia301.DEVICE_NAME) == name.encode("latin-1", errors="replace")
        and _held(dictionary, Cia301.IDENTITY, 1) in (told.vendor or (0,))
        and _held(dictionary, Cia301.IDENTITY, 2) in (told.product or (0,))
    )


def _held(dictionary: ObjectDictionary, index: int, subindex: int = 0) -> Any:
    variable = dictionary.get(index, subindex)
    return None if variable is None else variable.default


def _identify(dictionary: ObjectDictionary, vendor: od.ObjectDictionary) -> None:
    """1018h:1 to 3 and 1008h by all that the file says of the device: the simulated drive's own would lie."""
    for subindex, numbers in enumerate(told_identity(vendor), start=1):
        variable = dictionary.get(Cia301.IDENTITY, subindex)
        if variable is not None:
            variable.default = variable.value = next(iter(numbers), 0)
    name, product = dictionary.get(Cia301.DEVICE_NAME), vendor.device_information.product_name
    name_entry = vendor.get(Cia301.DEVICE_NAME)
    if name is not None and product and name_entry is not None and 0 in _silent(name_entry):
        name.default = name.value = product.encode("latin-1", errors="replace")


def _silent(entry: Any) -> frozenset[int]:
    """Sub-indices to which the file gives no value: there the device's own stays, PDO parameters apart."""
    if entry.index in PDO_PARAMETERS:  # what is mapped by default stands in the file, or nothing is
        return frozenset()
    members = {0: entry} if isinstance(entry, od.ODVariable) else entry.subindices
    return frozenset(
        sub for sub, member in members.items() if member.default is None and member.value is None
    )


def _merge(own: DictionaryObject, made: DictionaryObject, silent: frozenset[int]) -> None:
    """Put the device's own variables, adapted, in the place of the file's."""
    for subindex, wanted in made.members.items():
        variable = own.members.get(subindex)
        if variable is None:
            continue
        if own.index in _PROFILE and variable.data_type is not wanted.data_type:
            wanted.stored = variable.stored
            continue
        _adapt(variable, wanted, subindex not in silent)
        made.members[subindex] = variable


def _adapt(variable: Variable, wanted: Variable, valued: bool) -> None:
    variable.name = wanted.name
    variable.access = wanted.access
    variable.mappable = wanted.mappable
    if variable.data_type is not wanted.data_type:
        return
    _narrow(variable, wanted)
    if not valued:
        return
    # What the simulated motor measures or cannot do is not the file's to say.
    if variable.index in _PROFILE and (not wanted.writable or variable.refusal(wanted.default) is not None):
        return
    variable.default = variable.value = wanted.default
    variable.node_relative = wanted.node_relative


def _narrow(variable: Variable, wanted: Variable) -> None:
    """The range that both the device and the file allow; the device's own if they have none in common."""
    low = max((bound for bound in (variable.low, wanted.low) if bound is not None), default=None)
    high = min((bound for bound in (variable.high, wanted.high) if bound is not None), default=None)
    if low is not None and high is not None and low > high:
        return
    variable.low, variable.high = low, high
    if variable.writable and isinstance(variable.default, int) and not variable.in_range(variable.default):
        bound = high if high is not None and variable.default > high else low
        variable.default = variable.value = int(bound or 0)


def _object(index: int, entry: Any) -> DictionaryObject:
    if isinstance(entry, od.ODVariable):
        domain = entry.data_type == DataType.DOMAIN
        built = DictionaryObject(index, entry.name, ObjectCode.DOMAIN if domain else ObjectCode.VAR)
        members = {0: entry}
    else:
        code = ObjectCode.ARRAY if isinstance(entry, od.ODArray) else ObjectCode.RECORD
        built = DictionaryObject(index, entry.name, code)
        members = dict(entry.subindices)
    for subindex, member in sorted(members.items()):
        built.members[subindex] = _variable(index, subindex, member)
    return built


def _variable(index: int, subindex: int, member: Any) -> Variable:
    try:
        data_type = DataType(member.data_type)
    except ValueError:
        # A type of the vendor's own: bytes without a fixed length.
        data_type = DataType.DOMAIN
    default = _default(data_type, member)
    # $NODEID stands for a COB-ID; the node-ID is added again at each reset.
    relative = bool(getattr(member, "relative", False)) and isinstance(default, int)
    limited = data_type in BITS
    return Variable(
        index,
        subindex,
        member.name,
        data_type,
        _access(member.access_type),
        default - BASE_NODE_ID if relative else default,
        mappable=bool(member.pdo_mappable),
        low=member.min if limited else None,
        high=member.max if limited else None,
        node_relative=relative,
    )


def _access(text: str) -> Access:
    try:
        return Access(text.strip().lower())
    except ValueError:
        return Access.READ_WRITE


def _default(data_type: DataType, member: Any) -> Any:
    """The file's value, a DCF's ParameterValue first; None where it does not fit its type."""
    value = held_by(member)
    if data_type not in BITS:
        if isinstance(value, str):
            wide = data_type is DataType.UNICODE_STRING
            return value.encode("utf-16-le" if wide else "latin-1", errors="replace")
        return bytes(value) if isinstance(value, bytes) else None
    if data_type in REAL_BITS:
        return float(value) if isinstance(value, int | float) else None
    if not isinstance(value, int):
        return None
    bits = BITS[data_type]
    if data_type in SIGNED_BITS and 1 << (bits - 1) <= value < 1 << bits:
        # Vendors write FFFFFFFFh for -1.
        value -= 1 << bits
    try:
        encode(data_type, value)
    except OverflowError:
        return None
    return value

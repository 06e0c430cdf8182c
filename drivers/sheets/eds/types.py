"""Data types and object types: their names, and the standards' values where a file is silent.

CiA 301 clause 7.5.2, CiA 402-2.
"""

import re

from servobench.drivers.canopen.objects301 import (
    SIGNED_BITS,
    UNSIGNED_BITS,
    Cia301,
    DataType,
    is_communication,
    is_mapping,
)

TEXT_TYPES = (DataType.VISIBLE_STRING, DataType.UNICODE_STRING)
BYTE_TYPES = (DataType.OCTET_STRING, DataType.DOMAIN)

KNOWN_TYPES: frozenset[int] = frozenset(DataType)

NULL_OBJECT, DOMAIN_OBJECT, DEFTYPE, DEFSTRUCT, VARIABLE, ARRAY, RECORD = 0, 2, 5, 6, 7, 8, 9
OBJECT_TYPES = {
    "NULL": NULL_OBJECT,
    "DOMAIN": DOMAIN_OBJECT,
    "DEFTYPE": DEFTYPE,
    "DEFSTRUCT": DEFSTRUCT,
    "VAR": VARIABLE,
    "VARIABLE": VARIABLE,
    "ARRAY": ARRAY,
    "ARR": ARRAY,
    "RECORD": RECORD,
    "REC": RECORD,
}

_SHORT_NAMES = {"BOOL": 0x01, "STRING": 0x09, "VISSTRING": 0x09, "FLOAT": 0x08, "DOUBLE": 0x11, "REAL": 0x08}


def type_by_name(text: str) -> int | None:
    """Parse ``UNSIGNED16``, ``Integer 16``, ``U16``, ``uint16_t``, ``VISIBLE_STRING``; None for anything
    else."""
    bare = re.sub(r"[\s_]", "", text).upper().removesuffix("T")
    match = re.fullmatch(r"(U|UINT|UNSIGNED|UI|I|S|INT|INTEGER|SINT|SIGNED)(\d{1,2})", bare)
    if match is not None:
        table = UNSIGNED_BITS if match[1][0] == "U" else SIGNED_BITS
        return next((code for code, bits in table.items() if bits == int(match[2]) and bits > 1), None)
    named: dict[str, int] = {kind.name.replace("_", ""): kind for kind in DataType}
    return named.get(bare) or _SHORT_NAMES.get(bare)


def type_name(data_type: int) -> str:
    """Return its name in CiA 301, or its number."""
    return DataType(data_type).name if data_type in KNOWN_TYPES else f"data type {data_type:04X}h"


_I8, _I16, _I32, _U8, _U16, _U32, _TEXT = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x09

_VARIABLES = {
    _U8: "1001 100D 1019 607E",
    _U16: "100C 1015 1017 603F 6040 6041 6066 6068 606D 606E 606F 6070 6072 6073",
    _U32: "1000 1002 1005 1006 1007 1012 1013 1014 1020 6065 6067 6075 6076 6079 607F 6080 6081 6082 6083 "
    "6084 6085 6087 609A 60A8 60A9 60AA 60AB 60C5 60C6 60FD 6502",
    _TEXT: "1008 1009 100A 6403 6404 6505",
    _I8: "6060 6061 6098",
    _I16: "6007 6042 6043 6044 605A 605B 605C 605D 605E 6071 6074 6077 6078 6086 6088 60B2 60C0",
    _I32: "6062 6063 6064 6069 606B 606C 607A 607C 60B0 60B1 60F4 60FA 60FC 60FF",
}
"""Indices by data type."""

_TYPE_OF_VARIABLE = {
    int(index, 16): code for code, indices in _VARIABLES.items() for index in indices.split()
}
_ARRAYS_OF = {
    **dict.fromkeys((0x1003, 0x1010, 0x1011, 0x1016, 0x1018, 0x608F, 0x6090, 0x6091, 0x6092, 0x6096), _U32),
    **dict.fromkeys((0x6099,), _U32),
    **dict.fromkeys((0x607B, 0x607D), _I32),
    Cia301.ERROR_BEHAVIOUR: _U8,
}
_COMMUNICATION = {1: _U32, 2: _U8, 3: _U16, 4: _U8, 5: _U16, 6: _U8}

COB_ID_OBJECTS = frozenset({Cia301.SYNC_COB_ID, Cia301.TIME_COB_ID, Cia301.EMCY_COB_ID})


def standard_type(index: int, sub: int | None) -> int | None:
    """Return the data type of an object, ``sub`` None, or of a sub-object; None if the standards do not
    define it."""
    if sub is None:
        return _TYPE_OF_VARIABLE.get(index)
    if index in _ARRAYS_OF or is_mapping(index) or is_communication(index):
        if sub == 0:
            return _U8
        if is_communication(index):
            return _COMMUNICATION.get(sub)
        return _U32 if is_mapping(index) else _ARRAYS_OF[index]
    if index == 0x60C2:
        return {0: _U8, 1: _U8, 2: _I8}.get(sub)
    return None


def standard_object_type(index: int) -> int | None:
    """Return VARIABLE, ARRAY, RECORD or DOMAIN by the standards."""
    if index in _TYPE_OF_VARIABLE:
        return VARIABLE
    if index == Cia301.STORE_EDS:
        return DOMAIN_OBJECT
    if index == Cia301.IDENTITY or index == 0x60C2 or is_mapping(index) or is_communication(index):
        return RECORD
    return ARRAY if index in _ARRAYS_OF else None

"""Data types and object types, by number and by the names that stand in their place."""

import re

from drivers.canopen.data_types import SIGNED_BITS, UNSIGNED_BITS, DataType

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
    """``UNSIGNED16``, ``Integer 16``, ``U16``, ``uint16_t``, ``VISIBLE_STRING``; None for what is no name."""
    bare = re.sub(r"[\s_]", "", text).upper().removesuffix("T")
    match = re.fullmatch(r"(U|UINT|UNSIGNED|UI|I|S|INT|INTEGER|SINT|SIGNED)(\d{1,2})", bare)
    if match is not None:
        table = UNSIGNED_BITS if match[1][0] == "U" else SIGNED_BITS
        return next((code for code, bits in table.items() if bits == int(match[2]) and bits > 1), None)
    named: dict[str, int] = {kind.name.replace("_", ""): kind for kind in DataType}
    return named.get(bare) or _SHORT_NAMES.get(bare)


def type_name(data_type: int) -> str:
    """Its name in CiA 301, or its number."""
    return DataType(data_type).name if data_type in KNOWN_TYPES else f"data type {data_type:04X}h"

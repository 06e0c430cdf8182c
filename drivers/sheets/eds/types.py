"""Data types and object types, by number and by the names that stand in their place."""

import re

BOOLEAN, REAL32, REAL64 = 0x01, 0x08, 0x11
INTEGER8, UNSIGNED8, UNSIGNED16, UNSIGNED32 = 0x02, 0x05, 0x06, 0x07
VISIBLE_STRING, OCTET_STRING, UNICODE_STRING, DOMAIN = 0x09, 0x0A, 0x0B, 0x0F

SIGNED_BITS = {0x02: 8, 0x03: 16, 0x04: 32, 0x10: 24, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}
UNSIGNED_BITS = {0x01: 1, 0x05: 8, 0x06: 16, 0x07: 32, 0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64}
REAL_BITS = {REAL32: 32, REAL64: 64}
TIME_BITS = {0x0C: 48, 0x0D: 48}
"""TIME_OF_DAY and TIME_DIFFERENCE."""

BITS = SIGNED_BITS | UNSIGNED_BITS | REAL_BITS | TIME_BITS
"""Length of the types that have one (CiA 301 table 44)."""

TEXT_TYPES = (VISIBLE_STRING, UNICODE_STRING)
BYTE_TYPES = (OCTET_STRING, DOMAIN)

KNOWN_TYPES = frozenset(BITS) | frozenset(TEXT_TYPES) | frozenset(BYTE_TYPES)

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

TYPE_NAMES = {
    0x01: "BOOLEAN",
    0x02: "INTEGER8",
    0x03: "INTEGER16",
    0x04: "INTEGER32",
    0x05: "UNSIGNED8",
    0x06: "UNSIGNED16",
    0x07: "UNSIGNED32",
    0x08: "REAL32",
    0x09: "VISIBLE_STRING",
    0x0A: "OCTET_STRING",
    0x0B: "UNICODE_STRING",
    0x0C: "TIME_OF_DAY",
    0x0D: "TIME_DIFFERENCE",
    0x0F: "DOMAIN",
    0x10: "INTEGER24",
    0x11: "REAL64",
    0x12: "INTEGER40",
    0x13: "INTEGER48",
    0x14: "INTEGER56",
    0x15: "INTEGER64",
    0x16: "UNSIGNED24",
    0x18: "UNSIGNED40",
    0x19: "UNSIGNED48",
    0x1A: "UNSIGNED56",
    0x1B: "UNSIGNED64",
}
_SHORT_NAMES = {"BOOL": 0x01, "STRING": 0x09, "VISSTRING": 0x09, "FLOAT": 0x08, "DOUBLE": 0x11, "REAL": 0x08}


def type_by_name(text: str) -> int | None:
    """``UNSIGNED16``, ``Integer 16``, ``U16``, ``uint16_t``, ``VISIBLE_STRING``; None for what is no name."""
    bare = re.sub(r"[\s_]", "", text).upper().removesuffix("T")
    match = re.fullmatch(r"(U|UINT|UNSIGNED|UI|I|S|INT|INTEGER|SINT|SIGNED)(\d{1,2})", bare)
    if match is not None:
        table = UNSIGNED_BITS if match[1][0] == "U" else SIGNED_BITS
        return next((code for code, bits in table.items() if bits == int(match[2]) and bits > 1), None)
    named = {re.sub("_", "", name): code for code, name in TYPE_NAMES.items()}
    return named.get(bare) or _SHORT_NAMES.get(bare)


def type_name(data_type: int) -> str:
    """Its name in CiA 301, or its number."""
    return TYPE_NAMES.get(data_type, f"data type {data_type:04X}h")

"""What objects are called where no data sheet says it: CiA 301 clause 7.5.2, CiA 402-2."""

from functools import cache
from typing import Final

from drivers.cia402.objects402 import Object
from drivers.sheets.eds.types import VARIABLE, standard_object_type, standard_type

_COMMUNICATION: Final = {
    0x1000: "Device type",
    0x1001: "Error register",
    0x1002: "Manufacturer status register",
    0x1003: "Pre-defined error field",
    0x1005: "COB-ID SYNC message",
    0x1006: "Communication cycle period",
    0x1007: "Synchronous window length",
    0x1008: "Manufacturer device name",
    0x1009: "Manufacturer hardware version",
    0x100A: "Manufacturer software version",
    0x100C: "Guard time",
    0x100D: "Life time factor",
    0x1010: "Store parameters",
    0x1011: "Restore default parameters",
    0x1012: "COB-ID time stamp object",
    0x1013: "High resolution time stamp",
    0x1014: "COB-ID EMCY",
    0x1015: "Inhibit time EMCY",
    0x1016: "Consumer heartbeat time",
    0x1017: "Producer heartbeat time",
    0x1018: "Identity object",
    0x1019: "Synchronous counter overflow value",
    0x1021: "Store EDS",
    0x1022: "Store format",
    0x1029: "Error behaviour",
}
_IDENTITY: Final = {1: "Vendor-ID", 2: "Product code", 3: "Revision number", 4: "Serial number"}
_PDO: Final = {
    1: "COB-ID",
    2: "transmission type",
    3: "inhibit time",
    5: "event timer",
    6: "SYNC start value",
}
_WORDS_OF_BITS: Final = frozenset(
    {0x1000, 0x1001, 0x1002, 0x1003, 0x1005, 0x1012, 0x1014, 0x1016, 0x1018}
    | {Object.CONTROLWORD, Object.STATUSWORD, Object.ERROR_CODE, Object.DIGITAL_INPUTS}
    | {Object.SI_UNIT_POSITION, Object.SI_UNIT_VELOCITY, Object.SI_UNIT_ACCELERATION, Object.SI_UNIT_JERK}
    | {Object.SUPPORTED_DRIVE_MODES}
)


_COUNTED: Final = frozenset({0x1003, 0x1016, 0x1018})
"""Sub-index 0 of these is a count."""


@cache
def standard_name(index: int, sub: int) -> str:
    """``Target torque``, ``TPDO1 mapping, object 2``; empty if no standard has it."""
    if index == 0x1018 and sub in _IDENTITY:
        return _IDENTITY[sub]
    for base, letter in ((0x1400, "R"), (0x1800, "T")):
        if base <= index < base + 0x200:
            return f"{letter}PDO{index - base + 1} {_PDO.get(sub, 'communication parameter')}"
        if base + 0x200 <= index < base + 0x400:
            part = f", object {sub}" if sub else ", number of objects"
            return f"{letter}PDO{index - base - 0x1FF} mapping{part}"
    name = _COMMUNICATION.get(index)
    if name is None:
        name = Object(index).title if index in Object.__members__.values() else ""
    return f"{name}, {sub}" if name and sub else name


@cache
def type_by_standard(index: int, sub: int) -> int | None:
    """The data type of an object by CiA 301 and CiA 402; None if they do not say."""
    simple = sub == 0 and standard_object_type(index) == VARIABLE
    return standard_type(index, None if simple else sub)


@cache
def is_word_of_bits(index: int, sub: int) -> bool:
    """Shown in hexadecimal: an identifier, a unit word, a word of bits."""
    if 0x1400 <= index < 0x1C00:
        return sub > 0 if index & 0x200 else sub == 1
    return index in _WORDS_OF_BITS and (sub > 0 or index not in _COUNTED)

"""What objects are called where no data sheet says it: CiA 301 clause 7.5.2, CiA 402-2."""

from functools import cache
from typing import Final

from drivers.canopen.objects301 import MANDATORY, PDO_PARAMETERS, TPDO_COMMUNICATION, Cia301, is_mapping
from drivers.cia402.objects402 import Object
from drivers.sheets.eds.types import COB_ID_OBJECTS, VARIABLE, standard_object_type, standard_type

_TITLES: Final = {int(entry): entry.title for entry in (*Cia301, *Object)}
_IDENTITY: Final = {1: "Vendor-ID", 2: "Product code", 3: "Revision number", 4: "Serial number"}
_PDO: Final = {
    1: "COB-ID",
    2: "transmission type",
    3: "inhibit time",
    5: "event timer",
    6: "SYNC start value",
}
_COUNTED: Final = frozenset({Cia301.ERROR_HISTORY, Cia301.CONSUMER_HEARTBEAT_TIME, Cia301.IDENTITY})
"""Sub-index 0 of these is a count."""
_WORDS_OF_BITS: Final[frozenset[int]] = frozenset(
    {*MANDATORY, *_COUNTED, *COB_ID_OBJECTS, Cia301.STATUS_REGISTER}
    | {Object.CONTROLWORD, Object.STATUSWORD, Object.ERROR_CODE, Object.DIGITAL_INPUTS}
    | {Object.SI_UNIT_POSITION, Object.SI_UNIT_VELOCITY, Object.SI_UNIT_ACCELERATION, Object.SI_UNIT_JERK}
    | {Object.SUPPORTED_DRIVE_MODES}
)


@cache
def standard_name(index: int, sub: int) -> str:
    """``Target torque``, ``TPDO1 mapping, object 2``; empty if no standard has it."""
    if index == Cia301.IDENTITY and sub in _IDENTITY:
        return _IDENTITY[sub]
    if index in PDO_PARAMETERS:
        pdo = f"{'R' if index < TPDO_COMMUNICATION else 'T'}PDO{(index & 0x1FF) + 1}"
        part = f"object {sub}" if sub else "number of objects"
        return f"{pdo} " + (
            f"mapping, {part}" if is_mapping(index) else _PDO.get(sub, "communication parameter")
        )
    name = _TITLES.get(index, "")
    return f"{name}, {sub}" if name and sub else name


@cache
def type_by_standard(index: int, sub: int) -> int | None:
    """The data type of an object by CiA 301 and CiA 402; None if they do not say."""
    simple = sub == 0 and standard_object_type(index) == VARIABLE
    return standard_type(index, None if simple else sub)


@cache
def is_word_of_bits(index: int, sub: int) -> bool:
    """Shown in hexadecimal: an identifier, a unit word, a word of bits."""
    if index in PDO_PARAMETERS:
        return sub > 0 if is_mapping(index) else sub == 1
    return index in _WORDS_OF_BITS and (sub > 0 or index not in _COUNTED)

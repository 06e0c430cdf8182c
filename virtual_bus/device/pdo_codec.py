"""PDO mappings compiled: from mapping words to octets and back (core/pdo_image.c)."""

from collections.abc import Sequence
from typing import Final

from servobench.drivers.canopen.objects301 import REAL_BITS, SIGNED_BITS
from servobench.virtual_bus.core.native import GAP, REAL, SIGNED, UNSIGNED, PdoCodec
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary, Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort

PDO_BITS_MAX: Final = 64

DUMMY_BITS: Final = {0x01: 1, 0x02: 8, 0x03: 16, 0x04: 32, 0x05: 8, 0x06: 16, 0x07: 32}
"""Data types that an RPDO may map as place-holders: by their own index (CiA 301, 7.4.7.3)."""


class Field:
    """One mapped object, or a gap (``variable`` None)."""

    __slots__ = ("bits", "variable")

    def __init__(self, variable: Variable | None, bits: int) -> None:
        self.variable = variable
        self.bits = bits


def resolve(dictionary: ObjectDictionary, word: int, *, transmit: bool) -> Field:
    """The field that a mapping word names.

    Error: SdoAbort 06020000h where there is no such object, 06090011h where it has no such sub-index,
    06040041h where it cannot be mapped in this direction or with this length.
    """
    index, subindex, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
    if index in DUMMY_BITS:
        if transmit or subindex or bits != DUMMY_BITS[index]:
            raise SdoAbort(AbortCode.NOT_MAPPABLE)
        return Field(None, bits)
    variable = dictionary.get(index, subindex)
    if variable is None:
        raise SdoAbort(AbortCode.NO_SUBINDEX if index in dictionary else AbortCode.NO_OBJECT)
    mappable = variable.mappable_in_tpdo if transmit else variable.mappable_in_rpdo
    if not mappable or variable.bits != bits:
        raise SdoAbort(AbortCode.NOT_MAPPABLE)
    return Field(variable, bits)


def resolve_all(dictionary: ObjectDictionary, words: Sequence[int], *, transmit: bool) -> list[Field]:
    """All fields of a PDO. Error: SdoAbort 06040042h beyond 64 bits, beside those of :func:`resolve`."""
    fields = [resolve(dictionary, word, transmit=transmit) for word in words]
    if sum(field.bits for field in fields) > PDO_BITS_MAX:
        raise SdoAbort(AbortCode.PDO_LENGTH)
    return fields


def compiled(fields: Sequence[Field]) -> PdoCodec:
    """What samples the fields' variables, looks for changes of them, and unpacks octets into values."""
    asked = any(field.variable is not None and field.variable.provider is not None for field in fields)
    return PdoCodec([(field.variable, field.bits, _kind(field.variable)) for field in fields], asked)


def _kind(variable: Variable | None) -> int:
    if variable is None:
        return GAP
    if variable.data_type in REAL_BITS:
        return REAL
    return SIGNED if variable.data_type in SIGNED_BITS else UNSIGNED

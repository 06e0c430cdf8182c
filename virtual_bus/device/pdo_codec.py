"""PDO mappings compiled: from mapping words to a packer and an unpacker (CiA 301, 7.4.8, 7.5.2.36).

Where every object sits on byte borders and is of a type that :mod:`struct` knows, one Struct does
it; otherwise the PDO is handled as one integer of up to 64 bits, little-endian, the first object
lowest.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Any, Final

from servobench.drivers.canopen.data_types import REAL_BITS, SIGNED_BITS, STRUCT_CODES
from servobench.virtual_bus.device.encoding import decode, encode
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


def byte_length(fields: Sequence[Field]) -> int:
    """Bytes of the PDO."""
    return (sum(field.bits for field in fields) + 7) // 8


def compile_packer(fields: Sequence[Field]) -> Callable[[], bytes]:
    """A function that samples the variables of a TPDO into its bytes."""
    variables = [field.variable for field in fields if field.variable is not None]
    layout = _struct_layout(fields)
    if layout is None:
        return lambda: _pack_bits(fields)
    pack = layout.pack
    if all(variable.provider is None for variable in variables):
        return lambda: pack(*[variable.value for variable in variables])
    return lambda: pack(*[v.value if v.provider is None else v.provider() for v in variables])


def compile_unpacker(fields: Sequence[Field]) -> Callable[[bytes], Sequence[Any]]:
    """A function that takes an RPDO's bytes (at least its length) into one value for each variable."""
    layout = _struct_layout(fields)
    return layout.unpack_from if layout is not None else lambda data: _unpack_bits(fields, data)


def _struct_layout(fields: Sequence[Field]) -> struct.Struct | None:
    codes = "<"
    for field in fields:
        if field.variable is None:
            if field.bits % 8:
                return None
            codes += f"{field.bits // 8}x"
        elif field.variable.data_type in STRUCT_CODES:
            codes += STRUCT_CODES[field.variable.data_type]
        else:
            return None
    return struct.Struct(codes)


def _pack_bits(fields: Sequence[Field]) -> bytes:
    image, shift = 0, 0
    for field in fields:
        if field.variable is not None:
            raw = int.from_bytes(encode(field.variable.data_type, field.variable.read()), "little")
            image |= (raw & ((1 << field.bits) - 1)) << shift
        shift += field.bits
    return image.to_bytes(byte_length(fields), "little")


def _unpack_bits(fields: Sequence[Field], data: bytes) -> list[Any]:
    image, values = int.from_bytes(data, "little"), []
    for field in fields:
        raw = image & ((1 << field.bits) - 1)
        image >>= field.bits
        if field.variable is not None:
            values.append(_from_bits(field.variable, raw, field.bits))
    return values


def _from_bits(variable: Variable, raw: int, bits: int) -> Any:
    if variable.data_type in REAL_BITS:
        return decode(variable.data_type, raw.to_bytes(bits // 8, "little"))
    if variable.data_type in SIGNED_BITS and raw >> (bits - 1):
        return raw - (1 << bits)
    return raw

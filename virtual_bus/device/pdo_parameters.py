"""Common part of RPDO and TPDO: communication and mapping parameters and the rules of changing them.

CiA 301, 7.5.2.33..7.5.2.38. A PDO is remapped by: COB-ID bit 31 = 1; mapping count = 0; the mapping
words; mapping count = n; COB-ID bit 31 = 0. Any other order is refused and changes nothing.

PDO mappings compiled: from mapping words to octets and back (core/pdo_image.c).
"""

from collections.abc import Sequence
from typing import Final

from servobench.drivers.canopen import cob_ids
from servobench.drivers.canopen.objects301 import PDO_ENTRIES_MAX, REAL_BITS, SIGNED_BITS
from servobench.drivers.wire.frame_port import EXTENDED_ID_MAX
from servobench.virtual_bus.core.native import GAP, REAL, SIGNED, UNSIGNED, PdoCodec
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary, Variable
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort
from servobench.virtual_bus.device.station import Station

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


class PdoParameters:
    """One PDO's parameters, with the checks hooked into the dictionary."""

    reserved_types: range
    transmit: bool

    def __init__(self, station: Station, communication_index: int, mapping_index: int) -> None:
        self.station = station
        self._communication = station.dictionary.object(communication_index).members
        self._mapping = station.dictionary.object(mapping_index).members
        hook = station.dictionary.hook
        hook(communication_index, 1, check=self._check_cob_id, on_write=self._on_write)
        hook(communication_index, 2, check=self._check_transmission_type, on_write=self._on_write)
        hook(communication_index, 5, on_write=self._on_write)
        hook(mapping_index, 0, check=self._check_count, on_write=self._on_write)
        for subindex in range(1, max(self._mapping) + 1):
            hook(mapping_index, subindex, check=self._check_word)

    def _on_write(self, _value: int) -> None:
        self.configure()

    def configure(self) -> None:
        """Take the parameters from the dictionary; overridden."""
        raise NotImplementedError

    def parameter(self, subindex: int) -> int:
        """A communication parameter; 0 where the PDO has none such."""
        variable = self._communication.get(subindex)
        return 0 if variable is None else int(variable.value)

    @property
    def exists(self) -> bool:
        """Bit 31 of the COB-ID is 0."""
        return not self.parameter(1) & cob_ids.NOT_VALID

    @property
    def can_id(self) -> int:
        """CAN-ID of the COB-ID."""
        return self.parameter(1) & cob_ids.CAN_ID

    def fields(self) -> list[Field]:
        """Return the present mapping; its words were checked when written.

        A stored mapping of objects that are no longer there maps nothing.
        """
        try:
            return self._resolve(self._mapping[0].value)
        except SdoAbort:
            return []

    def _words(self, count: int) -> Sequence[int]:
        return [self._mapping[subindex].value for subindex in range(1, count + 1)]

    def _resolve(self, count: int) -> list[Field]:
        return resolve_all(self.station.dictionary, self._words(count), transmit=self.transmit)

    def _check_cob_id(self, value: int) -> AbortCode | None:
        # 11-bit identifiers only: 7.5.2.33 wants 06090030h for bit 29.
        if value & cob_ids.EXTENDED:
            return AbortCode.INVALID_VALUE
        if value & cob_ids.NOT_VALID:
            return None
        # Bits 0..29 stay while the PDO exists and goes on to exist; bit 30 may not be changed either.
        if self.exists and value != self.parameter(1):
            return AbortCode.INVALID_VALUE
        if cob_ids.restricted(value & cob_ids.CAN_ID) or value & EXTENDED_ID_MAX & ~cob_ids.CAN_ID:
            return AbortCode.INVALID_VALUE
        return None

    def _check_transmission_type(self, value: int) -> AbortCode | None:
        return AbortCode.INVALID_VALUE if value in self.reserved_types else None

    def refused_while_it_exists(self, _value: int) -> AbortCode | None:
        """Check of a parameter that may be changed only while bit 31 is 1."""
        return AbortCode.DEVICE_STATE if self.exists else None

    def _check_count(self, value: int) -> AbortCode | None:
        if self.exists:
            return AbortCode.DEVICE_STATE
        # FEh and FFh would be multiplex PDOs, which this device has not.
        if value > PDO_ENTRIES_MAX:
            return AbortCode.INVALID_VALUE
        if value >= len(self._mapping):
            return AbortCode.PDO_LENGTH
        try:
            self._resolve(value)
        except SdoAbort as abort:
            return abort.code
        return None

    def _check_word(self, value: int) -> AbortCode | None:
        if self.exists or self._mapping[0].value:
            return AbortCode.DEVICE_STATE
        if not value:
            return None
        try:
            resolve(self.station.dictionary, value, transmit=self.transmit)
        except SdoAbort as abort:
            return abort.code
        return None

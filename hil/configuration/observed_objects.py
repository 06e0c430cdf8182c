"""``observe``: objects that a drive sends with the SYNCs, for the recording alone."""

import re
from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import BeforeValidator, Field, field_validator

from servobench.drivers.canopen.data_types import STRUCT_CODES, DataType
from servobench.drivers.canopen.pdo import PdoEntry
from servobench.drivers.canopen.sdo import object_name
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.observed import NUMBERS
from servobench.drivers.sheets.eds.types import standard_type, type_by_name
from servobench.hil.configuration.config_files import Section

_OBJECT: Final = re.compile(r"([0-9A-Fa-f]{4})(?::([0-9]{1,3}))?")
_OF_THE_LOOP: Final = frozenset(
    {
        Object.STATUSWORD,
        Object.POSITION_ACTUAL_VALUE,
        Object.VELOCITY_ACTUAL_VALUE,
        Object.TORQUE_ACTUAL_VALUE,
        Object.TORQUE_DEMAND,
    }
)
TypeName = Literal[
    "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "real32", "real64"
]


class _Standard(NamedTuple):
    """The CiA 402-2 definition of an object."""

    name: str = ""
    factor: float = 1.0
    unit: str = ""


_STANDARDS: Final[dict[int, _Standard]] = {
    Object.CURRENT_ACTUAL_VALUE: _Standard("current", 0.1, "% of rated"),
    Object.DC_LINK_CIRCUIT_VOLTAGE: _Standard("DC link voltage", 1e-3, "V"),
}
ENTRIES_MAX: Final = 8 * len(NUMBERS)
"""As many as the PDOs hold, at a byte each."""


class ObservedObject(Section):
    """One observed object; ``"6078"`` is short for ``{ object = "6078" }``."""

    object: str = Field(description='its index in hexadecimal, and a sub-index: "6078", "2101:1"')
    type: TypeName | None = None
    """Data type; default: that of the standard, which has none for makers' objects."""
    name: str | None = Field(default=None, min_length=1, max_length=40)
    """Name in tables and pictures; default: the standard's, or the object itself."""
    scale: float | None = None
    """Factor of its number; default 1, for 6078h and 6079h the one that gives per cent and volts."""
    unit: str | None = Field(default=None, max_length=20)
    """Unit of the product."""

    @field_validator("object")
    @classmethod
    def _is_object(cls, text: str) -> str:
        match = _OBJECT.fullmatch(text)
        if match is None or int(match[2] or 0) > 0xFF:
            raise ValueError('an object ("6078"), or with its sub-index ("2101:1")')
        return text.upper()

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        index, _, sub = self.object.partition(":")
        return int(index, 16), int(sub or 0)

    @property
    def code(self) -> str | None:
        """``struct`` character; None: unknown."""
        index, sub = self.key
        kind = type_by_name(self.type) if self.type else standard_type(index, sub or None)
        return None if kind is None else STRUCT_CODES.get(DataType(kind))

    @property
    def entry(self) -> PdoEntry:
        """The PDO entry."""
        assert self.code is not None
        return PdoEntry(*self.key, self.code)

    @property
    def title(self) -> str:
        """The name shown."""
        index, sub = self.key
        return self.name or self._standard.name or object_name(index, sub)

    @property
    def factor(self) -> float:
        """Factor of its number."""
        return self.scale if self.scale is not None else self._standard.factor

    @property
    def told_unit(self) -> str:
        """Unit of the product; empty: unknown."""
        if self.unit is not None:
            return self.unit
        return self._standard.unit if self.scale is None else ""

    @property
    def _standard(self) -> _Standard:
        return _STANDARDS.get(self.key[0], _Standard())


def _long(value: Any) -> Any:
    return {"object": value} if isinstance(value, str) else value


Observe = Annotated[
    tuple[Annotated[ObservedObject, BeforeValidator(_long)], ...], Field(strict=False, max_length=ENTRIES_MAX)
]


def observed_faults(key: str, observed: tuple[ObservedObject, ...]) -> Iterator[tuple[str, object, str, str]]:
    """Yield objects that cannot be sent by PDO, or are sent anyway; ``key``: that of the list."""
    objects, titles = Counter(each.key for each in observed), Counter(each.title for each in observed)
    for place, each in enumerate(observed):
        here = f"{key}[{place}]"
        if each.key[0] in _OF_THE_LOOP:
            yield f"{here}.object", each.object, "an object that the loop does not read anyway", ""
        elif each.code is None:
            remedy = 'type = "int16", "uint32", ... as the maker\'s manual has it'
            yield f"{here}.type", each.type or "nothing", "the data type of a maker's object", remedy
        if objects[each.key] > 1:
            yield f"{here}.object", each.object, "each object once", ""
        elif titles[each.title] > 1:
            yield f"{here}.name", each.title, "a name of its own", ""

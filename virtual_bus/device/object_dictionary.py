"""The object dictionary of a simulated device: a typed table in memory with hooks (CiA 301, 7.4).

A variable's ``value`` is what the device holds: an int for integers, booleans and times, a float for
reals, bytes for strings and domains. The device sets ``value`` freely; only the bus goes through
access, length and range checks. A write from the bus, by SDO or by RPDO, is

    access, length, range  ->  check(value)  ->  value stored  ->  on_write(value)

where an RPDO stores all its variables before the first ``on_write``.
"""

from collections.abc import Callable, Iterator
from enum import Enum, IntEnum
from typing import Any, Final

from servobench.drivers.canopen.objects301 import BITS, DataType
from servobench.virtual_bus.device.sdo_abort import AbortCode, SdoAbort, decode, encode


class Access(Enum):
    """Access over the bus, spelled as in an EDS (CiA 306-1)."""

    CONST = "const"
    READ_ONLY = "ro"
    WRITE_ONLY = "wo"
    READ_WRITE = "rw"
    READ_WRITE_TPDO = "rwr"
    """Readable and writable; mappable into TPDOs only."""
    READ_WRITE_RPDO = "rww"
    """Readable and writable; mappable into RPDOs only."""


class ObjectCode(IntEnum):
    """Object codes (CiA 301, table 42)."""

    DOMAIN = 2
    VAR = 7
    ARRAY = 8
    RECORD = 9


_WRITABLE: Final = frozenset(Access) - {Access.CONST, Access.READ_ONLY}
_TPDO: Final = frozenset(Access) - {Access.WRITE_ONLY, Access.READ_WRITE_RPDO}
_RPDO: Final = _WRITABLE - {Access.READ_WRITE_TPDO}

Check = Callable[[Any], AbortCode | None]
"""May refuse a value before it is stored."""

Hook = Callable[[Any], None]
"""Acts on a value after it was stored."""

Provider = Callable[[], Any]
"""Computes a value when it is read."""


class Variable:
    """One sub-index."""

    def __init__(
        self,
        index: int,
        subindex: int,
        name: str,
        data_type: DataType,
        access: Access = Access.READ_WRITE,
        default: Any = None,
        *,
        mappable: bool = False,
        low: float | None = None,
        high: float | None = None,
        node_relative: bool = False,
        stored: bool = True,
        check: Check | None = None,
        on_write: Hook | None = None,
        provider: Provider | None = None,
    ) -> None:
        """``default``: raw value, by default 0 or b"". ``low``, ``high``: limits of what the bus may write,
        inclusive. ``node_relative``: the default is a base to which the node-ID is added.
        ``stored``: whether 1010h stores it, if it can be read and written; not a command or set-point."""
        self.index = index
        self.subindex = subindex
        self.name = name
        self.data_type = data_type
        self.access = access
        self.default: Any = default if default is not None else (0 if data_type in BITS else b"")
        self.mappable = mappable
        self.low = low
        self.high = high
        self.node_relative = node_relative
        self.stored = stored
        self.check = check
        self.on_write = on_write
        self.provider = provider
        self.power_on: Any = None
        """Stored parameter that replaces the default at power-on and reset; None: the default."""
        self.value: Any = self.default

    def __repr__(self) -> str:
        return f"Variable({self.index:04X}h:{self.subindex} {self.name!r} = {self.value!r})"

    @property
    def bits(self) -> int | None:
        """Length in a PDO; None for strings and domains."""
        return BITS.get(self.data_type)

    @property
    def writable(self) -> bool:
        """True if the bus may write it."""
        return self.access in _WRITABLE

    @property
    def readable(self) -> bool:
        """True if the bus may read it."""
        return self.access is not Access.WRITE_ONLY

    @property
    def mappable_in_tpdo(self) -> bool:
        """True if a TPDO may carry it."""
        return self.mappable and self.access in _TPDO and self.bits is not None

    @property
    def mappable_in_rpdo(self) -> bool:
        """True if an RPDO may carry it."""
        return self.mappable and self.access in _RPDO and self.bits is not None

    def read(self) -> Any:
        """The present value, from the provider if there is one."""
        return self.value if self.provider is None else self.provider()

    def in_range(self, value: Any) -> bool:
        """Return True if ``low`` and ``high`` allow ``value``."""
        return (self.high is None or value <= self.high) and (self.low is None or value >= self.low)

    def refusal(self, value: Any) -> AbortCode | None:
        """Why the bus may not write ``value``; None if it may."""
        if self.high is not None and value > self.high:
            return AbortCode.TOO_HIGH
        if self.low is not None and value < self.low:
            return AbortCode.TOO_LOW
        return None if self.check is None else self.check(value)

    def show_instead(self, shown: int) -> None:
        """Show another value to the bus than the one used in the device. A write from the bus ends the
        difference."""
        held, on_write = self.default, self.on_write

        def read() -> int:
            return shown if self.value == held else int(self.value)

        def written(new: int) -> None:
            if new == shown:
                self.value = held
            if on_write is not None:
                on_write(int(self.value))

        self.provider, self.on_write = read, written

    def restore(self, node_id: int) -> None:
        """Back to the power-on value; no hook is called."""
        if self.power_on is not None:
            self.value = self.power_on
        elif self.node_relative:
            self.value = self.default + node_id
        else:
            self.value = self.default


class DictionaryObject:
    """One index: a variable, or an array or record of them."""

    __slots__ = ("code", "index", "members", "name")

    def __init__(self, index: int, name: str, code: ObjectCode) -> None:
        self.index = index
        self.name = name
        self.code = code
        self.members: dict[int, Variable] = {}

    def add(
        self,
        subindex: int,
        name: str,
        data_type: DataType,
        access: Access = Access.READ_WRITE,
        **options: Any,
    ) -> Variable:
        """Add a sub-index; ``options`` as in :class:`Variable`. Sub-index 0, the count, follows by itself."""
        assert subindex not in self.members or subindex == 0, f"{self.index:04X}h:{subindex} is there already"
        variable = Variable(self.index, subindex, name, data_type, access, **options)
        self.members[subindex] = variable
        if subindex and self.code is not ObjectCode.VAR:
            self._count_to(subindex)
        return variable

    def _count_to(self, subindex: int) -> None:
        count = self.members.get(0)
        if count is None:
            count = Variable(
                self.index,
                0,
                "Highest sub-index supported",
                DataType.UNSIGNED8,
                Access.CONST,
                default=subindex,
            )
            self.members = {0: count, **self.members}
        elif count.access is Access.CONST:
            count.default = count.value = max(count.default, subindex)


class ObjectDictionary:
    """All objects of a device, by index and sub-index."""

    def __init__(self) -> None:
        self._objects: dict[int, DictionaryObject] = {}
        self._concealed: dict[int, DictionaryObject] = {}

    def add(
        self, index: int, name: str, data_type: DataType, access: Access = Access.READ_WRITE, **options: Any
    ) -> Variable:
        """Add a plain variable (sub-index 0); ``options`` as in :class:`Variable`."""
        code = ObjectCode.DOMAIN if data_type is DataType.DOMAIN else ObjectCode.VAR
        return self._add_object(index, name, code).add(0, name, data_type, access, **options)

    def add_record(self, index: int, name: str) -> DictionaryObject:
        """Add an empty record; fill it with :meth:`DictionaryObject.add` from sub-index 1."""
        return self._add_object(index, name, ObjectCode.RECORD)

    def add_array(self, index: int, name: str) -> DictionaryObject:
        """Add an empty array; fill it with :meth:`DictionaryObject.add` from sub-index 1."""
        return self._add_object(index, name, ObjectCode.ARRAY)

    def _add_object(self, index: int, name: str, code: ObjectCode) -> DictionaryObject:
        assert index not in self._objects, f"{index:04X}h is there already"
        self._objects[index] = DictionaryObject(index, name, code)
        return self._objects[index]

    def __iter__(self) -> Iterator[DictionaryObject]:
        """Objects by rising index."""
        return iter([self._objects[index] for index in sorted(self._objects)])

    def __contains__(self, index: object) -> bool:
        return index in self._objects

    def object(self, index: int) -> DictionaryObject:
        """The object at ``index``. Error: KeyError."""
        return self._objects[index]

    def get(self, index: int, subindex: int = 0) -> Variable | None:
        """The variable, or None."""
        entry = self._objects.get(index)
        return None if entry is None else entry.members.get(subindex)

    def hook(
        self,
        index: int,
        subindex: int = 0,
        *,
        check: Check | None = None,
        on_write: Hook | None = None,
        provider: Provider | None = None,
    ) -> None:
        """Put what is given into the variable, if the device has it: without it the feature is off."""
        variable = self.get(index, subindex)
        if variable is not None:
            variable.check = check or variable.check
            variable.on_write = on_write or variable.on_write
            variable.provider = provider or variable.provider

    def variable(self, index: int, subindex: int = 0) -> Variable:
        """The variable, for the device itself: a concealed one too. Error: KeyError."""
        return (self._concealed.get(index) or self._objects[index]).members[subindex]

    def known(self, index: int, subindex: int = 0) -> Variable | None:
        """Return :meth:`variable`, or None."""
        entry = self._concealed.get(index) or self._objects.get(index)
        return None if entry is None else entry.members.get(subindex)

    def conceal(self, index: int) -> None:
        """Take an object off the bus; the application goes on to work with it."""
        self._concealed[index] = self._objects.pop(index)

    def put(self, entry: DictionaryObject) -> None:
        """Add an object that was made elsewhere, in the place of one with its index."""
        self._objects[entry.index] = entry

    def find(self, index: int, subindex: int) -> Variable:
        """The variable that the bus asks for. Error: SdoAbort 06020000h, 06090011h."""
        entry = self._objects.get(index)
        if entry is None:
            raise SdoAbort(AbortCode.NO_OBJECT)
        variable = entry.members.get(subindex)
        if variable is None:
            raise SdoAbort(AbortCode.NO_SUBINDEX)
        return variable

    def find_writable(self, index: int, subindex: int) -> Variable:
        """The variable that the bus wants to write. Error: SdoAbort 06010002h beside those of ``find``."""
        variable = self.find(index, subindex)
        if not variable.writable:
            raise SdoAbort(AbortCode.READ_ONLY)
        return variable

    def upload(self, index: int, subindex: int) -> bytes:
        """Return the value of an SDO upload. Error: SdoAbort 06010001h in addition to those of ``find``."""
        variable = self.find(index, subindex)
        if not variable.readable:
            raise SdoAbort(AbortCode.WRITE_ONLY)
        return encode(variable.data_type, variable.read())

    def download(self, index: int, subindex: int, data: bytes) -> None:
        """An SDO download: check, store, ``on_write``. Error: SdoAbort, and then nothing was stored."""
        variable = self.find_writable(index, subindex)
        value = decode(variable.data_type, data)
        refusal = variable.refusal(value)
        if refusal is not None:
            raise SdoAbort(refusal)
        variable.value = value
        if variable.on_write is not None:
            variable.on_write(value)

    def restore(self, first: int, last: int, node_id: int) -> None:
        """The indices ``first``..``last`` back to their power-on values; no hook is called."""
        for entry in (*self._concealed.values(), *self._objects.values()):
            if first <= entry.index <= last:
                for variable in entry.members.values():
                    variable.restore(node_id)

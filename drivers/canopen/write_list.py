"""The objects that a master may write by SDO, each with its reason: an unlisted one is never sent.

An object of 2000h to 5FFFh belongs to the maker of a device (CiA 301 7.4.1): under one index one make has a
brake's reaction time, another its serial number. Such an object is listed for one product alone, and may be
written once 1018h and 1008h have said that the node is that product.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, NamedTuple

from servobench.drivers.canopen.objects301 import MANUFACTURER, object_name
from servobench.drivers.errors import BadInput


class UnlistedWrite(BadInput):
    """A write to an object that no list allows: an error of ours. Nothing was sent."""


class Product(NamedTuple):
    """Product identity of a node, as it reports it."""

    vendor: int
    """1018h:1."""
    code: int
    """1018h:2."""
    device_name: str
    """1008h."""

    def __str__(self) -> str:
        return f"{self.device_name} (vendor {self.vendor:08X}h, product {self.code:08X}h)"


@dataclass(frozen=True, slots=True)
class ListedWrite:
    """Objects that are written for one reason. Raises ValueError for a maker's object without its product."""

    indices: range
    subs: tuple[int, ...]
    """In ascending order."""
    name: str
    """Its title in the profile: ``Target torque``."""
    why: str
    when: str
    product: Product | None = None
    """The only product on which it is written; None: any, as it is an object of the standard."""

    def __post_init__(self) -> None:
        of_a_maker = self.indices.start < MANUFACTURER.stop and self.indices.stop > MANUFACTURER.start
        if of_a_maker and self.product is None:
            raise ValueError(f"{self.objects} belongs to the maker of a drive: name the product")

    @property
    def objects(self) -> str:
        """``6060h:00``, ``1016h:01-7F`` or ``1400h-15FFh:01,02,03,05``."""
        first, last = self.indices[0], self.indices[-1]
        index = f"{first:04X}h" if first == last else f"{first:04X}h-{last:04X}h"
        low, high = self.subs[0], self.subs[-1]
        in_a_row = high - low == len(self.subs) - 1 > 0
        subs = f"{low:02X}-{high:02X}" if in_a_row else ",".join(f"{sub:02X}" for sub in self.subs)
        return f"{index}:{subs}"

    def covers(self, index: int, sub: int) -> bool:
        """Return True if the object is one of these."""
        return index in self.indices and sub in self.subs


@dataclass(frozen=True, slots=True)
class WriteList:
    """Every write that one purpose needs; ``|`` joins two."""

    name: str
    """Owner of the list, for the message of a refusal: ``hil run``."""
    writes: tuple[ListedWrite, ...] = ()

    def __or__(self, other: "WriteList") -> "WriteList":
        more = (each for each in other.writes if each not in self.writes)
        return WriteList(self.name, (*self.writes, *more))

    def __iter__(self) -> Iterator[ListedWrite]:
        """Iterate by index and sub-index."""
        return iter(sorted(self.writes, key=lambda each: (each.indices.start, each.subs)))

    def __contains__(self, key: tuple[int, int]) -> bool:
        """Return True if index and sub-index may be written on a drive of any make."""
        return self.allows(*key)

    def allows(self, index: int, sub: int, product: Product | None = None) -> bool:
        """Return True if the object may be written on a node that is ``product``; None: unknown."""
        return any(each.covers(index, sub) and each.product in (None, product) for each in self.writes)

    def named(self, name: str) -> "WriteList":
        """Return the same objects for another purpose."""
        return WriteList(name, self.writes)


NOTHING: Final = WriteList("a master without a list of writes")
"""For a master that only reads and listens."""


class WriteGate:
    """Checks every SDO write of one master."""

    def __init__(self, allowed: WriteList) -> None:
        self.allowed = allowed
        self.products: dict[int, Product] = {}
        """Identity by node; until it is known no object of a maker is written to the node."""

    def check(self, node_id: int, index: int, sub: int) -> None:
        """Raise UnlistedWrite unless the object of the node may be written."""
        product, allowed = self.products.get(node_id), self.allowed
        if allowed.allows(index, sub, product):
            return
        held = f"{object_name(index, sub)} of node {node_id}"
        makers = next((each.product for each in allowed if each.covers(index, sub)), None)
        raise UnlistedWrite(
            allowed.name,
            "SDO write",
            held if makers is None else f"{held}, which is {product or 'a drive not yet asked who it is'}",
            "an object on its list" if makers is None else f"this object of {makers} alone",
            "nothing was sent; hil docs writes has the list of each command",
        )

    @contextmanager
    def only(self, allowed: WriteList) -> Iterator[None]:
        """Inside, allow no other writes than ``allowed``."""
        before, self.allowed = self.allowed, allowed
        try:
            yield
        finally:
            self.allowed = before

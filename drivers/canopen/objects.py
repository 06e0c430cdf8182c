"""A node's objects by SDO, as integers and text.

Finds the greatest value that a device accepts when it refuses the one wanted as too great.
"""

import math
from struct import Struct
from struct import error as struct_error
from typing import Final, NamedTuple

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.errors import PeerFault, TransferAborted, printable

_STRUCTS = {code: Struct(f"<{code}") for code in "bBhHiIqQ"}


class SettingRefused(PeerFault):
    """A device holds another value than the one written."""


class RemoteObjects:
    """Typed access to the object dictionary of one node. Every call pumps the network.

    Each method raises TransferAborted if the node refuses, NoAnswer if it is silent. ``code`` is a
    ``struct`` character: b B h H i I for INTEGER8 UNSIGNED8 ... UNSIGNED32.
    """

    def __init__(self, network: CanopenNetwork, node_id: int) -> None:
        self.network = network
        self.node_id = node_id

    def read(self, index: int, sub: int = 0, code: str = "I") -> int:
        """Read an integer object. Extra octets beyond the type are tolerated."""
        data = self.network.upload(self.node_id, index, sub)
        width = _STRUCTS[code].size
        if not data:
            raise SettingRefused(f"node {self.node_id} sent no data for {object_name(index, sub)}")
        return int.from_bytes(data[:width], "little", signed=code.islower())

    def read_if_there(self, index: int, sub: int = 0, code: str = "I") -> int | None:
        """Read an integer object; None if the node lacks it, or does not let it be read."""
        try:
            return self.read(index, sub, code)
        except TransferAborted:
            return None

    def read_text(self, index: int, sub: int = 0) -> str:
        """Read a VISIBLE_STRING, printable; empty if the node has none. Octets beyond Latin-1 do not
        occur."""
        try:
            data = self.network.upload(self.node_id, index, sub)
        except TransferAborted:
            return ""
        return printable(data.split(b"\0", 1)[0].decode("latin-1").strip())

    def write(self, index: int, sub: int, code: str, value: int) -> None:
        """Write an integer object and wait for the confirmation. Raises ValueError if it does not fit."""
        try:
            data = _STRUCTS[code].pack(value)
        except struct_error as error:
            raise ValueError(f"{object_name(index, sub)}: {value} does not fit {code!r}") from error
        self.network.download(self.node_id, index, sub, data)

    def write_verified(self, index: int, sub: int, code: str, value: int) -> None:
        """Write an integer object and read it back; raises SettingRefused if the node holds another value."""
        self.write(index, sub, code, value)
        held = self.read(index, sub, code)
        if held != value:
            raise SettingRefused(
                f"node {self.node_id} holds {held} in {object_name(index, sub)}", f"{value} was written to it"
            )


_TOO_LOW: Final = 0x06090032
_TOO_GREAT: Final = frozenset({0x06090030, 0x06090031})
"""Value range exceeded, value too high (CiA 301 table 22)."""
_TRIES: Final = 24
"""Steps of the bisection: exact up to some 60 000, and within a hundred-thousandth of 2^32."""


class Granted(NamedTuple):
    """The value that a device holds instead of the one wanted."""

    held: int | None
    """None: it does not have the object."""
    notes: list[str]
    """Remarks on what it refused."""


def write_greatest(
    objects: RemoteObjects,
    index: int,
    code: str,
    wanted: int,
    text: str,
    *,
    most: int | None = None,
    sub: int = 0,
) -> Granted:
    """Write ``wanted`` or, if that is refused as too great, the greatest value below it that the device
    accepts; read it back.

    ``most``: the limit in its data sheet. Without one the limit is found by bisection, in at most 24 writes.
    Raises NoAnswer.
    """
    name = object_name(index, sub)
    before = objects.read_if_there(index, sub, code)
    if before is None:
        return Granted(None, [f"{name} is missing: {text} left to the drive"])

    def refusal(value: int) -> TransferAborted | None:
        try:
            objects.write(index, sub, code, value)
        except TransferAborted as error:
            return error
        return None

    tried = wanted if most is None else min(wanted, most)
    first = None if tried == before else refusal(tried)
    if first is not None and first.code not in _TOO_GREAT:
        return Granted(before, [f"{name} refused {tried} ({text}): {first.evidence}"])
    low, high = before if before < tried else 0, tried
    for _ in range(_TRIES if first is not None else 0):
        if high - low <= 1:
            break
        middle = min(max(low + 1, round(math.sqrt(max(low, 1) * high))), high - 1)
        error = refusal(middle)
        if error is None or error.code == _TOO_LOW:
            low = middle
        elif error.code in _TOO_GREAT:
            high = middle
        else:
            break
    held = objects.read(index, sub, code)
    if held == wanted:
        return Granted(held, [])
    why = first.evidence if first is not None else "by its data sheet" if held == tried else "not taken"
    return Granted(held, [f"{name} holds {held}, {wanted} was asked for ({text}): {why}"])

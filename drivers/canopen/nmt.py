"""A master's knowledge of a node: NMT state, heartbeat, emergencies (CiA 301 7.2.8, 7.2.7)."""

from collections.abc import Iterable
from struct import Struct
from typing import NamedTuple

from servobench.drivers.canopen.error_codes import error_text, fault_text, register_text
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import Duration, Instant

_EMERGENCY = Struct("<HB5s")
EMERGENCIES_KEPT = 10_000
"""Enough for one every 10 ms in a run of 100 s; some 2 MB."""
_TOGGLE = 0x80
"""Toggle bit of an answer to node guarding."""


class Emergency(NamedTuple):
    """An EMCY object, CiA 301 7.2.7."""

    node_id: int
    code: int
    """Error code; 0x0000 says that all errors are gone."""
    register: int
    """0x1001."""
    manufacturer: bytes
    at: Instant

    @property
    def text(self) -> str:
        """The standard's text for the code."""
        return error_text(self.code)

    def told(self, vendor: int = 0, device_name: str = "") -> str:
        """Describe the EMCY, in its maker's words if known."""
        kinds = f"register {self.register:02X}h ({register_text(self.register)})"
        detail = f"{kinds}, manufacturer {self.manufacturer.hex()}"
        return f"EMCY {self.code:04X}h ({fault_text(self.code, vendor, device_name)}), {detail}"

    def __str__(self) -> str:
        return self.told()


class EmergencySeries(NamedTuple):
    """EMCYs of one code and node."""

    first: Emergency
    last: Emergency
    times: int


def condensed(emergencies: Iterable[Emergency]) -> list[EmergencySeries]:
    """Merge EMCYs of one code and node into series, in the order of their last occurrence."""
    repeated: dict[tuple[int, int], EmergencySeries] = {}
    for each in emergencies:
        key = each.node_id, each.code
        before = repeated.pop(key, EmergencySeries(each, each, 0))
        repeated[key] = before._replace(last=each, times=before.times + 1)
    return list(repeated.values())


def parse_emergency(node_id: int, data: bytes, at: Instant) -> Emergency | None:
    """Parse a frame's data as an EMCY; None if it is not eight bytes long, as the standard demands."""
    if len(data) != _EMERGENCY.size:
        return None
    code, register, manufacturer = _EMERGENCY.unpack(data)
    return Emergency(node_id, code, register, manufacturer, at)


class NodeStatus:
    """One node as seen by its heartbeats."""

    __slots__ = (
        "_toggle", "boot_ups", "guarded", "heartbeat_at", "lost_at", "node_id", "state", "timeout_ns",
        "watched_since",
    )  # fmt: skip

    def __init__(self, node_id: int) -> None:
        self.node_id = node_id
        self.state: NmtState | None = None
        """None before the first heartbeat, or after a byte that is no state of the standard."""
        self.heartbeat_at: Instant | None = None
        self.boot_ups = 0
        self.timeout_ns = Duration(0)
        """Longest silence allowed; 0: the node is not watched."""
        self.watched_since = Instant(0)
        self.lost_at: Instant | None = None
        """When the silence became too long; None while the node is heard."""
        self.guarded = False
        """True if node guarding is used: answers count as heartbeats, and their toggle bits alternate."""
        self._toggle = -1

    def watch(self, timeout_ns: Duration, now: Instant) -> None:
        """Allow no silence longer than ``timeout_ns`` from now on; 0 ends the watch."""
        self.timeout_ns, self.watched_since, self.lost_at = timeout_ns, now, None

    def heard(self, data: bytes, at: Instant) -> None:
        """Take in a frame with this node's error control identifier."""
        if len(data) != 1:
            return
        if self.guarded and data[0]:
            toggle = data[0] & _TOGGLE
            repeated, self._toggle = toggle == self._toggle, toggle
            if repeated:  # CiA 301 7.2.8.3.2.1: as if it had not come
                return
        else:
            self._toggle = -1
        try:
            self.state = NmtState(data[0] & 0x7F)
        except ValueError:
            self.state = None
        if self.state is NmtState.INITIALISING:
            self.boot_ups += 1
            # A booting node enters PRE-OPERATIONAL by itself right after this frame (CiA 301 7.3.2.2).
            self.state = NmtState.PRE_OPERATIONAL
        self.heartbeat_at, self.lost_at = at, None

    def expires_at(self) -> Instant | None:
        """Return when the silence becomes too long; None if not watched, or lost already."""
        if not self.timeout_ns or self.lost_at is not None:
            return None
        last = self.watched_since if self.heartbeat_at is None else max(self.heartbeat_at, self.watched_since)
        return Instant(last + self.timeout_ns)

"""What every part of a fault plan is checked by."""

from typing import Any

from drivers.canopen.nmt_states import NODE_ID_MAX
from drivers.errors import BadInput
from drivers.timebase import NS_PER_S, Duration

DELAY_MAX = Duration(10 * NS_PER_S)
"""No field bus holds a frame longer; what is held takes memory."""


def require(holds: bool, key: str, value: Any, expected: str) -> None:
    """Raise :class:`BadInput` about ``key`` unless ``holds``."""
    if not holds:
        raise BadInput("fault plan", key, value, expected)


def require_probability(key: str, value: float) -> None:
    """A probability from 0 to 1."""
    require(0.0 <= value <= 1.0, key, value, "a probability from 0 to 1")


def require_nodes(nodes: tuple[int, ...]) -> None:
    """Node ids, CiA 301 7.2.8.1."""
    for node in nodes:
        require(1 <= node <= NODE_ID_MAX, "nodes", node, f"a node id from 1 to {NODE_ID_MAX}")


def require_window(from_ns: Duration, until_ns: Duration | None) -> None:
    """From a time that is not negative to a later one."""
    require(from_ns >= 0, "from_s", from_ns / NS_PER_S, "a time >= 0")
    if until_ns is not None:
        expected = f"a time after from_s = {from_ns / NS_PER_S:g}"
        require(until_ns > from_ns, "until_s", until_ns / NS_PER_S, expected)

"""Node ids as they are typed: ``1``, ``1,2,5``, ``1-3``, ``unconfigured``."""

from collections.abc import Sequence

from drivers.canopen.nmt_states import NODE_ID_MAX, UNCONFIGURED
from drivers.errors import MISSING, BadInput


def node_ids(texts: Sequence[str], option: str = "--node") -> list[int]:
    """The node ids of all ``texts``, in order. Raises BadInput for one that is no id, or that comes twice."""
    found: list[int] = []
    for text in texts:
        for part in text.split(","):
            found.extend(_range(part.strip(), option))
    if not found:
        raise BadInput(option, "", MISSING, f"a node id 1..{NODE_ID_MAX}, e.g. {option} 1 or {option} 1-3")
    for node in found:
        if found.count(node) > 1:
            raise BadInput(option, "", node, "each node id once")
    return found


def drive_ids(texts: Sequence[str], option: str = "--node") -> list[int]:
    """As :func:`node_ids`, of devices that have one."""
    found = node_ids(texts, option)
    if UNCONFIGURED in found:
        raise BadInput(
            option, "", "unconfigured", f"a node id 1..{NODE_ID_MAX}", "hil scan --assign gives one"
        )
    return found


def _number(digits: str) -> int:
    """One of many digits is too large, whatever it is."""
    return int(digits) if len(digits) < 10 else NODE_ID_MAX + 1


def _range(text: str, option: str) -> range:
    if text in ("unconfigured", str(UNCONFIGURED)):
        return range(UNCONFIGURED, UNCONFIGURED + 1)
    first, dash, last = text.partition("-")
    if not first.isdecimal() or (dash and not last.isdecimal()):
        raise BadInput(option, "", text, f"a node id 1..{NODE_ID_MAX}, a list 1,2 or a range 1-3")
    low, high = _number(first), _number(last if dash else first)
    if not 1 <= low <= high <= NODE_ID_MAX:
        raise BadInput(option, "", text, f"node ids within 1..{NODE_ID_MAX}, the smaller first")
    return range(low, high + 1)

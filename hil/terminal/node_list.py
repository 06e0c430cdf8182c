"""Node ids as typed: ``1``, ``1,2,5``, ``1-3``, ``unconfigured:3``; and serial numbers."""

from collections.abc import Sequence

from servobench.drivers.canopen.nmt_states import NODE_ID_MAX, UNCONFIGURED
from servobench.drivers.errors import MISSING, BadInput

SERIAL_MAX = 0xFFFF_FFFF
SERIAL_DIGITS_MAX = 12
"""32 bits are ten digits, and as many with 0x."""


def node_ids(texts: Sequence[str], option: str = "--node") -> list[int]:
    """Parse the node ids of all ``texts``, in order. Raises BadInput for an invalid or repeated one."""
    nodes: list[int] = []
    for text in texts:
        for part in text.split(","):
            nodes.extend(_range(part.strip(), option))
    if not nodes:
        raise BadInput(option, "", MISSING, f"a node id 1..{NODE_ID_MAX}, e.g. {option} 1 or {option} 1-3")
    for node in nodes:
        if node != UNCONFIGURED and nodes.count(node) > 1:
            raise BadInput(option, "", node, "each node id once")
    return nodes


def drive_ids(texts: Sequence[str]) -> list[int]:
    """Parse node ids of devices that have one; see :func:`node_ids`."""
    nodes = node_ids(texts)
    if UNCONFIGURED in nodes:
        expected = f"a node id 1..{NODE_ID_MAX}"
        raise BadInput("--node", "", "unconfigured", expected, "hil scan --assign gives one")
    return nodes


def _number(digits: str) -> int:
    """Parse a number; one with too many digits becomes too large."""
    return int(digits) if len(digits) < 10 else NODE_ID_MAX + 1


def serial_numbers(texts: Sequence[str], count: int) -> list[int]:
    """Return a serial number for each of ``count`` devices; from a single one the others count up. Empty:
    none.

    Raises BadInput for an invalid or repeated one, and for too few or too many.
    """
    typed = [_serial(part.strip()) for text in texts for part in text.split(",")]
    if len(typed) == 1:
        typed = [_serial(str(typed[0] + place)) for place in range(count)]
    if typed and (len(typed) != count or len(set(typed)) != count):
        expected = f"a serial number for each of {count} nodes, each once; or one"
        raise BadInput("--serial", "", ",".join(texts), expected)
    return typed


def _serial(text: str) -> int:
    base = 16 if text.lower().startswith("0x") else 10
    try:
        number = int(text, base) if len(text) <= SERIAL_DIGITS_MAX else -1
    except ValueError:
        number = -1
    if not 0 <= number <= SERIAL_MAX:
        raise BadInput("--serial", "", text, f"serial numbers 0..{SERIAL_MAX}, decimal or with 0x")
    return number


def _range(text: str, option: str) -> Sequence[int]:
    name, colon, many = text.partition(":")
    if name in ("unconfigured", str(UNCONFIGURED)):
        if colon and not (many.isdecimal() and 1 <= _number(many) <= NODE_ID_MAX):
            raise BadInput(option, "", text, f"how many nodes without id, 1..{NODE_ID_MAX}: unconfigured:3")
        return [UNCONFIGURED] * (_number(many) if colon else 1)
    first, dash, last = text.partition("-")
    if not first.isdecimal() or (dash and not last.isdecimal()):
        raise BadInput(option, "", text, f"a node id 1..{NODE_ID_MAX}, a list 1,2 or a range 1-3")
    low, high = _number(first), _number(last if dash else first)
    if not 1 <= low <= high <= NODE_ID_MAX:
        raise BadInput(option, "", text, f"node ids within 1..{NODE_ID_MAX}, the smaller first")
    return range(low, high + 1)

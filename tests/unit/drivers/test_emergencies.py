"""EMCYs that come again and again, as one."""

from servobench.drivers.canopen.nmt import Emergency, condensed
from servobench.drivers.timebase import Instant


def emcy(node: int, code: int, at: int, manufacturer: int = 0) -> Emergency:
    return Emergency(node, code, 1, bytes([manufacturer] * 5), Instant(at))


def test_those_of_a_code_and_a_node_are_one_in_the_order_of_the_last() -> None:
    sent = [emcy(1, 0x2310, 1), emcy(2, 0x2310, 2), emcy(1, 0x8130, 3), emcy(1, 0x2310, 4, manufacturer=7)]
    other, fault, warning = condensed(sent)
    assert (other.first, other.last, other.times) == (sent[1], sent[1], 1)
    assert (fault.first, fault.times) == (sent[2], 1)
    assert (warning.first, warning.last, warning.times) == (sent[0], sent[3], 2)
    assert condensed([]) == []

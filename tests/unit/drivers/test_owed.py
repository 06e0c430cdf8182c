"""The account of what is due blames nobody for loss and delay, and misses nothing on a bus without them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.canopen.sdo import ANSWER_LATE_MAX, Owed, OwedAnswers
from servobench.drivers.timebase import Instant
from tests.draws import examples_of

DUE_MAX = 8


@examples_of(100)
@given(st.lists(st.booleans()))
def test_without_loss_every_surplus_is_seen(foreign: list[bool]) -> None:
    owed = Owed(DUE_MAX)
    for too_many in foreign:
        owed.expect()
        assert owed.came() == 0
        if too_many:
            assert owed.came() == 1
    assert owed.surplus == sum(foreign)


@examples_of(100)
@given(st.lists(st.integers(0, DUE_MAX - 1)))
def test_what_is_late_by_less_than_the_most_is_never_blamed(delays: list[int]) -> None:
    owed = Owed(DUE_MAX)
    arrivals = [asked + delay for asked, delay in enumerate(delays)]
    for now in range(len(delays) + DUE_MAX):
        if now < len(delays):
            owed.expect()
        assert owed.came(arrivals.count(now)) == 0


def test_loss_hides_no_more_than_the_most() -> None:
    owed = Owed(DUE_MAX)
    owed.expect(1000)
    assert owed.came(DUE_MAX) == 0
    assert owed.came() == 1


# ---- answers by SDO -----------------------------------------------------------------------------------

READ_6041, READ_607C = bytes.fromhex("4041600000000000"), bytes.fromhex("407C600000000000")
HAS_6041, HAS_607C = bytes.fromhex("4B41600037020000"), bytes.fromhex("437C600000000000")
SEGMENT, HAS_SEGMENT = bytes.fromhex("6000000000000000"), bytes.fromhex("0061626364656667")
ABORTS = bytes.fromhex("8041600000000206")
BLOCK, A_BLOCK = bytes.fromhex("A008100001000000"), bytes.fromhex("0161626364656667")


@pytest.mark.parametrize(
    ("request_", "answer", "due"),
    [
        (READ_6041, HAS_6041, True),
        (READ_6041, HAS_607C, False),
        (READ_6041, HAS_SEGMENT, False),
        (READ_6041, ABORTS, True),
        (READ_607C, ABORTS, True),
        (SEGMENT, HAS_SEGMENT, True),
        (SEGMENT, HAS_6041, False),
        (SEGMENT, ABORTS, True),
        (BLOCK, A_BLOCK, True),
        (ABORTS, HAS_6041, False),
    ],
)
def test_an_answer_is_due_to_a_request_of_its_object(request_: bytes, answer: bytes, due: bool) -> None:
    owed = OwedAnswers(Instant(-2 * ANSWER_LATE_MAX))
    owed.expect(Instant(0), request_)
    assert owed.came(Instant(1), answer) is due
    assert owed.surplus == (not due)


def test_each_request_has_one_answer_in_whatever_order_until_it_is_too_late() -> None:
    owed = OwedAnswers(Instant(-2 * ANSWER_LATE_MAX))
    for request in (READ_6041, READ_607C, READ_6041):
        owed.expect(Instant(0), request)
    late = Instant(ANSWER_LATE_MAX)
    assert [owed.came(at, HAS_6041) for at in (Instant(1), Instant(2), Instant(3))] == [True, True, False]
    assert owed.came(late, HAS_607C)
    owed.expect(late, READ_607C)
    assert not owed.came(Instant(2 * ANSWER_LATE_MAX + 1), HAS_607C)


def test_one_answer_may_be_anothers_who_asked_before_until_the_first_of_ours() -> None:
    assert [OwedAnswers(Instant(0)).came(Instant(at), HAS_607C) for at in (1, ANSWER_LATE_MAX + 1)] == [
        True,
        False,
    ]
    owed = OwedAnswers(Instant(0))
    owed.expect(Instant(1), READ_6041)
    assert owed.came(Instant(2), HAS_6041)
    assert not owed.came(Instant(3), HAS_607C)

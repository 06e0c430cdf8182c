"""The account of what is due blames nobody for loss and delay, and misses nothing on a bus without them."""

from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.owed import Owed

DUE_MAX = 8


@given(st.lists(st.booleans()))
def test_without_loss_every_surplus_is_seen(foreign: list[bool]) -> None:
    owed = Owed(DUE_MAX)
    for too_many in foreign:
        owed.expect()
        assert owed.came() == 0
        if too_many:
            assert owed.came() == 1
    assert owed.surplus == sum(foreign)


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

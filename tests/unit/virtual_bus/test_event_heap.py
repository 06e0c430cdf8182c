"""The heap of a timeline against the standard library's."""

from heapq import heappop, heappush

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.timebase import Instant
from virtual_bus.event_heap import Action, HeapEntry, pop, push


@settings(derandomize=True, deadline=None, max_examples=300)
@given(st.lists(st.one_of(st.none(), st.integers(0, 20))))
def test_entries_come_by_instant_and_then_in_the_order_of_entry(steps: list[int | None]) -> None:
    """``steps``: an instant to enter, or None to take the first."""
    heap, reference, taken, expected = list[HeapEntry](), list[tuple[int, int]](), [], []
    for order, when in enumerate(steps):
        if when is not None:
            push(heap, HeapEntry(Instant(when), order, Action()))
            heappush(reference, (when, order))
        elif heap:
            entry = pop(heap)
            taken.append((entry.when, entry.order))
            expected.append(heappop(reference))
    while heap:
        entry = pop(heap)
        taken.append((entry.when, entry.order))
        expected.append(heappop(reference))
    assert taken == expected
    assert not reference


def test_the_plain_action_is_wanted_and_does_nothing() -> None:
    action = Action()
    action.happen(Instant(1))
    assert action.wanted

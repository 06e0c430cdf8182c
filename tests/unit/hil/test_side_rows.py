"""Events in rows of fixed size."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.timebase import Instant
from hil.rows.side_rows import (
    EVENT,
    EVENT_DTYPE,
    FRAME,
    FRAME_DTYPE,
    LEVELS,
    TEXT_BYTES,
    BeginEvent,
    IdentityEvent,
    LoadEvent,
    RunEvent,
    StateEvent,
    TextEvent,
    event_row,
    events_of,
    frame_row,
)

instants = st.integers(-(2**62), 2**62).map(Instant)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\x1f"), max_size=60)
numbers = st.floats(allow_nan=False)
events = (
    st.builds(TextEvent, instants, st.sampled_from(LEVELS), texts)
    | st.builds(StateEvent, instants, texts, texts)
    | st.builds(BeginEvent, instants)
    | st.builds(LoadEvent, instants, texts, numbers, numbers)
    | st.builds(IdentityEvent, instants, texts, texts)
)


def through_a_row(event: RunEvent) -> RunEvent:
    (found,) = events_of(np.frombuffer(event_row(event), EVENT_DTYPE))
    return found


@settings(derandomize=True, deadline=None)
@given(events)
def test_an_event_survives_its_row(event: RunEvent) -> None:
    assert through_a_row(event) == event


def test_a_long_text_is_cut_at_a_whole_character() -> None:
    found = through_a_row(TextEvent(Instant(0), "INFO", "a" + "ü" * TEXT_BYTES))
    assert isinstance(found, TextEvent)
    assert found.text == "a" + "ü" * ((TEXT_BYTES - 1) // 2)


@settings(derandomize=True, deadline=None)
@given(instants, st.integers(0, 2**32 - 1), st.integers(0, 255), st.binary(max_size=8))
def test_a_frame_row_is_as_the_struct_packs_it(at: Instant, can_id: int, sent: int, data: bytes) -> None:
    assert frame_row(at, can_id, sent, data) == FRAME.pack(at, can_id, len(data), sent, data)


def test_structs_and_dtypes_have_the_same_size() -> None:
    assert (EVENT.size, FRAME.size) == (EVENT_DTYPE.itemsize, FRAME_DTYPE.itemsize)

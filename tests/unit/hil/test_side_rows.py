"""Events in rows of fixed size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import Instant
from servobench.hil.rows.side_rows import (
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
from tests.draws import examples_of

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


@examples_of(100)
@given(events)
def test_an_event_survives_its_row(event: RunEvent) -> None:
    found = through_a_row(event)
    assert (type(found), found) == (type(event), event), (
        "two of a kind of tuple are equal whatever their class"
    )


@pytest.mark.parametrize(
    ("event", "kind", "level", "text"),
    [
        (TextEvent(Instant(5), "INFO", ""), 0, 0, b""),
        (TextEvent(Instant(5), "CRITICAL", "ü"), 0, 3, b"\xc3\xbc"),
        (StateEvent(Instant(5), "phase", "running"), 1, 0, b"phase\x1frunning"),
        (BeginEvent(Instant(5)), 2, 0, b""),
        (LoadEvent(Instant(5), "axis1", 0.1, -2.0), 3, 0, b"axis1\x1f0.1\x1f-2.0"),
        (IdentityEvent(Instant(5), "axis1", "a drive"), 4, 0, b"axis1\x1fa drive"),
    ],
)
def test_a_row_has_instant_kind_level_and_its_text(
    event: RunEvent, kind: int, level: int, text: bytes
) -> None:
    (row,) = np.frombuffer(event_row(event), EVENT_DTYPE)
    assert (row["at"], row["kind"], row["level"], row["length"]) == (5, kind, level, len(text))
    assert row["text"].tobytes() == text.ljust(TEXT_BYTES, b"\0")


@pytest.mark.parametrize("length", [TEXT_BYTES - 1, TEXT_BYTES, TEXT_BYTES + 1])
def test_a_text_may_fill_its_row(length: int) -> None:
    assert through_a_row(TextEvent(Instant(0), "WARN", "x" * length)) == TextEvent(
        Instant(0), "WARN", "x" * min(length, 500)
    )


def test_a_long_text_is_cut_at_a_whole_character() -> None:
    found = through_a_row(TextEvent(Instant(0), "INFO", "a" + "ü" * TEXT_BYTES))
    assert isinstance(found, TextEvent)
    assert found.text == "a" + "ü" * ((TEXT_BYTES - 1) // 2)


@examples_of(100)
@given(instants, st.integers(0, 2**32 - 1), st.integers(0, 255), st.binary(max_size=8))
def test_a_frame_row_is_as_the_struct_packs_it(at: Instant, can_id: int, sent: int, data: bytes) -> None:
    assert frame_row(at, can_id, sent, data) == FRAME.pack(at, can_id, len(data), sent, data)


def test_structs_and_dtypes_have_the_same_size() -> None:
    assert (EVENT.size, FRAME.size) == (EVENT_DTYPE.itemsize, FRAME_DTYPE.itemsize)

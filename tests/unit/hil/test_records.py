"""Packed rows: nothing of a CycleRecord is lost, on any machine the same bytes."""

from collections.abc import Callable, Iterator
from enum import Enum
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.exchange import Command, PositionCommand, Reading, SpeedCommand
from servobench.drivers.record import AnyRecord, Record, names_of, replaced, values_of
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.cycle_record import NAMES, NOTHING, ROW, CycleRecord, row_of
from servobench.hil.loop.samples import CommandFate, Dropout, DropoutCause, Sample, Sending, StateEstimate
from servobench.hil.rows.records import ROW_DTYPE
from tests.draws import examples_of
from tests.unit.hil.row_tools import cycle_record, record_of
from tests.unit.hil.synthetic_run import synthetic_records

instants = st.integers(-(2**62), 2**62).map(Instant)
sequences = st.integers(0, 2**40)
numbers = st.floats(allow_nan=False)
readings = st.builds(
    Reading,
    numbers,
    st.none() | st.integers(-(2**62), 2**62),
    instants,
    numbers,
    instants,
    numbers,
    instants,
    st.integers(0, 0xFFFF),
    instants,
)
errors = st.integers(0, 2**40)
samples = st.builds(Sample, st.just(7), readings, instants, errors, st.booleans())
due = st.shared(instants, key="due")
dropouts = st.builds(Dropout, st.just(7), due, st.sampled_from(DropoutCause), st.booleans())
records = st.builds(
    cycle_record,
    sequence=st.just(7),
    axis=st.integers(0, 0xFFFF),
    due_at=due,
    woke_at=st.none() | instants,
    sync_handed_at=st.none() | instants,
    sync_on_bus_at=st.none() | instants,
    observation=samples | dropouts,
    delay=st.none() | st.integers(-(2**40), 2**40).map(Duration),
    estimate=st.none() | st.builds(StateEstimate, numbers, numbers, numbers, instants, sequences),
    reference_rad_s=numbers,
    load_torque_nm=numbers,
    command=st.none() | st.builds(Command, st.just(7), numbers, instants, instants),
    sending=st.none()
    | st.builds(
        Sending,
        st.integers(-(2**31), 2**31),
        instants,
        st.none() | instants,
        st.sampled_from(CommandFate),
        st.none() | instants,
        st.none() | instants,
    ),
    clock_offset_ns=st.none() | st.integers(-(2**62), 2**62),
    clock_error_ns=st.none() | errors,
)


@examples_of(100)
@given(records)
def test_a_record_survives_packing(record: CycleRecord) -> None:
    (row,) = np.frombuffer(row_of(record), ROW_DTYPE)
    assert record_of(row) == record


WHOLE = cycle_record(
    sequence=7,
    axis=0,
    due_at=Instant(1),
    woke_at=Instant(2),
    sync_handed_at=Instant(3),
    sync_on_bus_at=Instant(4),
    observation=Sample(
        7,
        Reading(1.0, 5, Instant(6), 2.0, Instant(7), 3.0, Instant(8), 9, Instant(10)),
        Instant(11),
        12,
        certain=True,
    ),
    delay=Duration(13),
    estimate=StateEstimate(4.0, 5.0, 6.0, Instant(14), 15),
    reference_rad_s=7.0,
    load_torque_nm=8.0,
    command=Command(7, 9.0, Instant(16), Instant(17)),
    sending=Sending(18, Instant(19), Instant(20), CommandFate.ACTING, Instant(21), Instant(22)),
    clock_offset_ns=23,
    clock_error_ns=24,
    compute_ns=25,
    channels=(1.0, 2.0),
    reference_rad=3.0,
    reference_nm=4.0,
)
"""With all that a record can have."""
TOLD_ONCE = {"observation.sequence", "command.sequence"}
"""They are the record's own."""


def changed(record: AnyRecord) -> Iterator[tuple[str, AnyRecord]]:
    """The record with each of its fields changed in turn, and those of its parts, by their names."""
    for name, value in zip(names_of(record), values_of(record), strict=True):
        assert value is not None, f"give WHOLE a value of {name}"
        if isinstance(value, Record):
            for below, other in changed(value):
                yield f"{name}.{below}", replaced(record, **{name: other})
        else:
            yield name, replaced(record, **{name: _another(value)})


def _another(value: Any) -> object:
    if isinstance(value, Enum):
        return next(other for other in type(value) if other is not value)
    if isinstance(value, bool):
        return not value
    return (*value, 5.0) if isinstance(value, tuple) else value + 1


@pytest.mark.parametrize("kind", [Command, SpeedCommand, PositionCommand])
def test_a_row_tells_every_field_of_its_record(kind: Callable[..., Command]) -> None:
    """A field that a record has and no column is named here."""
    whole = replaced(WHOLE, command=kind(7, 9.0, Instant(16), Instant(17)))
    row = row_of(whole)
    assert len(row) == ROW.size, f"row_of writes {len(row) // 8} columns, COLUMNS has {len(NAMES)}"
    untold = {name for name, record in changed(whole) if row_of(record) == row}
    assert untold == TOLD_ONCE, f"no column tells {untold - TOLD_ONCE}: write one in cycle_record.py"


def test_layout_has_no_padding_and_each_field_is_aligned() -> None:
    assert ROW.size == ROW_DTYPE.itemsize
    assert ROW_DTYPE.names == NAMES
    for name, (dtype, offset, *_) in (ROW_DTYPE.fields or {}).items():
        assert offset % dtype.itemsize == 0, name


def test_a_dropout_has_no_reading() -> None:
    record = next(r for r in synthetic_records(2000) if isinstance(r.observation, Dropout))
    (row,) = np.frombuffer(row_of(record), ROW_DTYPE)
    assert np.isnan(row["velocity_rad_s"])
    assert int(row["received_at"]) == NOTHING
    assert int(row["fate"]) == 1

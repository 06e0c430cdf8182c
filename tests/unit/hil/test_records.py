"""Packed rows: nothing of a CycleRecord is lost, on any machine the same bytes."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.exchange import Command, Reading
from drivers.timebase import Duration, Instant
from hil.loop.samples import (
    CommandFate,
    CycleRecord,
    Dropout,
    DropoutCause,
    Sample,
    Sending,
    StateEstimate,
)
from hil.rows.records import LAYOUT, NOTHING, ROW, ROW_DTYPE, row_of
from tests.unit.hil.row_tools import record_of
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
    CycleRecord,
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


@settings(derandomize=True, deadline=None)
@given(records)
def test_a_record_survives_packing(record: CycleRecord) -> None:
    (row,) = np.frombuffer(row_of(record), ROW_DTYPE)
    assert record_of(row) == record


def test_layout_has_no_padding_and_each_field_is_aligned() -> None:
    assert ROW.size == ROW_DTYPE.itemsize
    assert ROW_DTYPE.names == tuple(name for name, _ in LAYOUT)
    for name, (dtype, offset, *_) in (ROW_DTYPE.fields or {}).items():
        assert offset % dtype.itemsize == 0, name


def test_a_dropout_has_no_reading() -> None:
    record = next(r for r in synthetic_records(2000) if isinstance(r.observation, Dropout))
    (row,) = np.frombuffer(row_of(record), ROW_DTYPE)
    assert np.isnan(row["velocity_rad_s"])
    assert int(row["received_at"]) == NOTHING
    assert int(row["fate"]) == 1

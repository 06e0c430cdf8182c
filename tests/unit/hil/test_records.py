"""Packed rows: nothing of a CycleRecord is lost, on any machine the same bytes."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.exchange import Command, Reading
from drivers.timebase import Duration, Instant
from hil.recording.records import LAYOUT, ROW, ROW_DTYPE, record_of, row_fields
from hil.samples import CycleRecord, Dropout, DropoutCause, Sample, StateEstimate
from tests.unit.hil.synthetic_run import synthetic_records

instants = st.integers(-(2**62), 2**62).map(Instant)
sequences = st.integers(0, 2**40)
numbers = st.floats(allow_nan=False)
readings = st.builds(
    Reading,
    sequences,
    numbers,
    numbers,
    numbers,
    st.integers(0, 0xFFFF),
    st.none() | st.integers(-(2**62), 2**62),
    instants,
)
samples = st.builds(Sample, sequences, readings, instants, st.integers(0, 2**40))
dropouts = st.builds(Dropout, sequences, instants, st.sampled_from(DropoutCause))
records = st.builds(
    CycleRecord,
    sequence=sequences,
    axis=st.integers(0, 0xFFFF),
    due_at=instants,
    woke_at=instants,
    sync_sent_at=instants,
    observation=samples | dropouts,
    delay=st.integers(-1, 2**40).map(Duration),
    estimate=st.builds(StateEstimate, numbers, numbers, numbers, instants, sequences),
    reference_rad_s=numbers,
    load_torque_nm=numbers,
    command=st.builds(Command, sequences, numbers, instants, instants),
    command_sent_at=instants,
)


@settings(derandomize=True, deadline=None)
@given(records)
def test_a_record_survives_packing(record: CycleRecord) -> None:
    (row,) = np.frombuffer(ROW.pack(*row_fields(record)), ROW_DTYPE)
    assert record_of(row) == record


def test_layout_has_no_padding_and_each_field_is_aligned() -> None:
    assert ROW.size == ROW_DTYPE.itemsize
    assert ROW_DTYPE.names == tuple(name for name, _ in LAYOUT)
    for name, (dtype, offset, *_) in (ROW_DTYPE.fields or {}).items():
        assert offset % dtype.itemsize == 0, name


def test_a_dropout_has_no_reading() -> None:
    record = next(r for r in synthetic_records(2000) if isinstance(r.observation, Dropout))
    (row,) = np.frombuffer(ROW.pack(*row_fields(record)), ROW_DTYPE)
    assert np.isnan(row["velocity_rad_s"])
    assert int(row["received_at"]) == -1
    assert int(row["fate"]) == 1

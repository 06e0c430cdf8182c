"""Records are compared, shown and changed by their fields."""

import inspect

import pytest

from servobench.drivers.exchange import Command, DemandChange, Readback, Reading, SpeedCommand
from servobench.drivers.record import Record, names_of, replaced, values_of
from servobench.drivers.timebase import Instant
from servobench.hil.loop.samples import Dropout, DropoutCause, Sample, Sending, StateEstimate
from tests.unit.hil.row_tools import cycle_record

KINDS = (
    *(Reading, Readback, DemandChange, Command, SpeedCommand),
    *(Sample, Dropout, StateEstimate, Sending),
)
COMMAND = Command(3, 1.5, Instant(10), Instant(20))


def test_equal_by_every_field() -> None:
    assert Command(3, 1.5, Instant(10), Instant(20)) == COMMAND
    assert hash(Command(3, 1.5, Instant(10), Instant(20))) == hash(COMMAND)
    for name, value in (("sequence", 4), ("torque_nm", 2.0), ("effective_at", 11), ("expires_at", 21)):
        assert replaced(COMMAND, **{name: value}) != COMMAND


def test_another_class_with_the_same_values_is_another_value() -> None:
    readback = Readback(1, Instant(0), 0)
    assert values_of(readback) == (1, 0, 0, False)
    assert readback != (1, 0, 0, False)
    assert readback != DemandChange(1, 0, Instant(0))
    speed = SpeedCommand(3, 1.5, Instant(10), Instant(20))
    assert speed != COMMAND
    assert speed == SpeedCommand(3, 1.5, Instant(10), Instant(20))


def test_a_changed_copy_leaves_the_rest_and_the_original() -> None:
    changed = replaced(COMMAND, torque_nm=-1.5)
    assert values_of(changed) == (3, -1.5, 10, 20)
    assert COMMAND.torque_nm == 1.5


def test_no_field_that_is_not_there_is_changed() -> None:
    with pytest.raises(TypeError):
        replaced(COMMAND, torque=1.0)


def test_it_shows_its_fields() -> None:
    assert repr(COMMAND) == "Command(sequence=3, torque_nm=1.5, effective_at=10, expires_at=20)"
    speed = SpeedCommand(3, 1.5, Instant(10), Instant(20))
    assert repr(speed) == "SpeedCommand(sequence=3, speed_rad_s=1.5, effective_at=10, expires_at=20)"


@pytest.mark.parametrize("kind", KINDS)
def test_every_record_names_its_fields_in_the_order_of_its_constructor(kind: type[Record]) -> None:
    parameters = list(inspect.signature(kind).parameters)
    assert parameters == list(kind.__match_args__)


def test_a_record_of_declared_fields_has_them_as_values() -> None:
    record = cycle_record(
        **dict.fromkeys(("due_at", "woke_at", "sync_handed_at", "sync_on_bus_at"), Instant(5)),
        **dict.fromkeys(("sequence", "axis", "delay"), 3),
        **dict.fromkeys(("reference_rad_s", "load_torque_nm"), 2.0),
        **dict.fromkeys(("estimate", "command", "sending", "clock_offset_ns", "clock_error_ns")),
        observation=Dropout(3, Instant(5), DropoutCause.LOST, certain=True),
    )
    assert names_of(record)[:3] == ("sequence", "axis", "due_at")
    other = replaced(record, compute_ns=7)
    assert (record.compute_ns, other.compute_ns) == (None, 7)
    assert other != record
    assert replaced(other, compute_ns=None) == record
    assert "compute_ns=7" in repr(other)

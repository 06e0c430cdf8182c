"""Records are compared, shown and changed by their fields."""

import inspect

import pytest

from servobench.drivers.exchange import Command, DemandChange, Readback, Reading, SpeedCommand
from servobench.drivers.record import Record, replaced, values_of
from servobench.drivers.timebase import Instant
from servobench.hil.loop.samples import CycleRecord, Dropout, Sample, Sending, StateEstimate

KINDS = (
    *(Reading, Readback, DemandChange, Command, SpeedCommand),
    *(Sample, Dropout, StateEstimate, Sending, CycleRecord),
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

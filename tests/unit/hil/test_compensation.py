"""The two compensators."""

import random

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.control.compensation import Arrival, Stamp
from servobench.hil.loop.protocol import Context
from servobench.hil.loop.samples import AT_REST, Sample
from tests.unit.hil.cycles import in_cycle
from tests.unit.hil.loop_fakes import reading_at

PERIOD = Duration(NS_PER_MS)


def sample(sequence: int, speed: float | None = None, late_ms: float = 0.0) -> Sample:
    at = at_ms(sequence + late_ms)
    value = float(sequence) if speed is None else speed
    return Sample(sequence, reading_at(at, velocity_rad_s=value), at, 0, True)


def at_ms(milliseconds: float) -> Instant:
    return Instant(round(milliseconds * NS_PER_MS))


def acting_at(milliseconds: float) -> Context:
    return in_cycle(acts_at=at_ms(milliseconds))


def test_before_the_first_sample_the_drive_is_at_rest() -> None:
    assert Arrival().estimate(acting_at(5)) == AT_REST
    assert Stamp(Duration(NS_PER_MS), PERIOD).estimate(acting_at(5)) == AT_REST


def test_arrival_holds_through_a_dropout_and_never_goes_back() -> None:
    compensator = Arrival()
    for number in (1, 4, 2):
        compensator.receive(sample(number))
    assert compensator.estimate(acting_at(9)).sequence == 4
    assert compensator.estimate(acting_at(10)).valid_at == at_ms(4)


def test_stamp_uses_the_sample_of_exactly_the_agreed_age() -> None:
    compensator = Stamp(Duration(3 * NS_PER_MS), PERIOD)
    for number in range(1, 8):
        compensator.receive(sample(number))
        age_ms = number - compensator.estimate(acting_at(number)).sequence
        assert age_ms == 3 if number > 3 else compensator.estimate(acting_at(number)) == AT_REST


def test_stamp_gives_the_same_whatever_the_delays_were_if_they_kept_the_limit() -> None:
    choices = random.Random(7)
    arrivals = sorted((number + choices.uniform(0.0, 2.9), number) for number in range(1, 200))
    compensator, punctual = Stamp(Duration(3 * NS_PER_MS), PERIOD), Stamp(Duration(3 * NS_PER_MS), PERIOD)
    pending = list(arrivals)
    for cycle in range(1, 200):
        punctual.receive(sample(cycle))
        while pending and pending[0][0] <= cycle:
            compensator.receive(sample(pending.pop(0)[1]))
        assert compensator.estimate(acting_at(cycle)) == punctual.estimate(acting_at(cycle))


def test_stamp_holds_the_older_sample_where_one_is_missing() -> None:
    compensator = Stamp(Duration(2 * NS_PER_MS), PERIOD)
    for number in (1, 2, 4):
        compensator.receive(sample(number))
    assert [compensator.estimate(acting_at(t)).sequence for t in (3, 4, 5, 6)] == [1, 2, 2, 4]


def test_stamp_takes_a_sample_of_a_late_sync_for_no_other() -> None:
    compensator = Stamp(Duration(2 * NS_PER_MS), PERIOD)
    for number, late_ms in ((1, 0.0), (2, 0.3), (3, 0.0)):
        compensator.receive(sample(number, late_ms=late_ms))
    assert [compensator.estimate(acting_at(t)).sequence for t in (3.1, 4, 5)] == [1, 2, 3]

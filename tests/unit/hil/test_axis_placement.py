"""Which SYNC a reading without a time stamp answers."""

import pytest

from drivers.exchange import Reading
from drivers.timebase import NS_PER_US, Duration, Instant
from hil.axis import Axis, Tick
from hil.samples import CycleRecord, Sample
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, FakeDrive, make_axis

CYCLES = 40


class Rig:
    """One axis; each reading comes at a chosen time after its SYNC and tells its number as speed."""

    def __init__(self) -> None:
        self.records: list[CycleRecord] = []
        self.drive = FakeDrive(lambda _sequence: None)
        self.axis: Axis = make_axis(self.drive, self.records)

    def calibrate(self, delay_us: int) -> None:
        self._receive(0, 0, delay_us)
        self.axis.calibrate(Instant(0))

    def run(self, delays_us: list[int | None]) -> list[int]:
        """Cycles with these delays; for each reading that was used, its number minus the SYNC it got."""
        arrivals = sorted(
            (
                (number * PERIOD + delay * NS_PER_US, number)
                for number, delay in enumerate(delays_us, 1)
                if delay
            )
        )
        for sequence in range(1, CYCLES + 1):
            due = Instant(sequence * PERIOD)
            while arrivals and arrivals[0][0] < due:
                at, number = arrivals.pop(0)
                self._receive(number, at, 0)
                self.axis.collect()
            tick = Tick(sequence, due, due, due, sequence * 1e-3)
            self.axis.begin(tick)
            self.axis.decide(tick, due)
            self.axis.settle()
        self.axis.settle_all()
        used = [record.observation for record in self.records if isinstance(record.observation, Sample)]
        return [int(sample.reading.velocity_rad_s) - sample.sequence for sample in used]

    def _receive(self, number: int, at_ns: int, delay_us: int) -> None:
        at = Instant(at_ns + delay_us * NS_PER_US)
        self.drive.readings.append(Reading(number, 0.0, float(number), 0.0, 0x0627, None, at))


@pytest.mark.parametrize("delay_us", [300, 900, 1400, 1600])
def test_a_reading_is_placed_by_the_delay_learnt_in_calibration(delay_us: int) -> None:
    rig = Rig()
    rig.calibrate(delay_us)
    assert rig.axis.meter.typical_delay == delay_us * NS_PER_US - SYNC_LATENCY
    jitter_us = (0, 200, -200, 400, -250)
    placed = rig.run([delay_us + jitter_us[number % 5] for number in range(CYCLES)])
    assert len(placed) >= CYCLES - 3
    assert set(placed) == {0}


def test_a_lost_reading_shifts_no_other() -> None:
    rig = Rig()
    rig.calibrate(1400)
    placed = rig.run([None if number % 4 == 2 else 1400 for number in range(CYCLES)])
    assert len(placed) >= CYCLES * 3 // 4 - 3
    assert set(placed) == {0}


def test_what_arrives_before_any_sync_is_of_no_cycle() -> None:
    rig = Rig()
    rig.axis.begin(Tick(1, Instant(PERIOD), Instant(PERIOD), Instant(PERIOD), 0.0))
    rig._receive(1, Duration(PERIOD // 2), 0)
    rig.axis.collect()
    assert rig.axis.meter.unmatched == 1

"""What an exercise records of its cycles, and what is fitted to it, counted by hand."""

import math

import numpy as np
import pytest

from servobench.drivers.exchange import Command, Reading
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.commissioning.exercise import Recording, recording_of
from servobench.hil.commissioning.identify import Array, Mechanics, identify_mechanics, plain_ratio, ratio_of
from servobench.hil.commissioning.plots import torque_by_angle
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.samples import CommandFate, Dropout, DropoutCause, Observation, Sample, Sending
from tests.unit.hil.row_tools import cycle_record
from tests.unit.hil.test_commissioning_figures import T_0, T_C, B, J, record

FIRST = Instant(5 * NS_PER_MS)


def cycle(
    number: int,
    cause: DropoutCause | None = None,
    torque_nm: float = math.nan,
    command_nm: float | None = None,
    sent: bool = True,
    sampled_us: int | None = None,
    on_bus: bool = True,
) -> CycleRecord:
    """Cycle ``number``, 0 the first; 2 us on is its SYNC on the bus, 250 us its reading."""
    due = Instant(FIRST + number * NS_PER_MS)
    on_bus_at = Instant(due + 2_000)
    came = Instant(due + 252_000)
    sampled_at = on_bus_at if sampled_us is None else Instant(FIRST + sampled_us * 1000)
    reading = Reading(float(number), None, came, 10.0 + number, came, torque_nm, came, 0, came)
    observation: Observation = Sample(number + 1, reading, sampled_at, 0, True)
    if cause is not None:
        observation = Dropout(number + 1, due, cause, True)
    command = None if command_nm is None else Command(number + 1, command_nm, due, due)
    sending = (
        Sending(0, due, None, CommandFate.NOT_MEASURED, None, None) if sent and command is not None else None
    )
    return cycle_record(
        due_at=due,
        sync_on_bus_at=on_bus_at if on_bus else None,
        observation=observation,
        command=command,
        sending=sending,
    )


def columns(recording: Recording) -> list[list[float]]:
    return [
        each.tolist() for each in (recording.time, recording.position, recording.velocity, recording.torque)
    ]


def test_nothing_is_recorded_of_no_cycle() -> None:
    recording = recording_of([])
    assert columns(recording) == [[], [], [], []]
    assert (recording.cycles, recording.lost, recording.losses_in_a_row) == (0, 0, ())
    assert recording.sync_to_reading_us.tolist() == []


def test_a_sample_has_its_instant_from_the_first_tick_on() -> None:
    recording = recording_of([cycle(0, torque_nm=0.5), cycle(1, torque_nm=-0.25)])
    time, position, velocity, torque = columns(recording)
    assert time == pytest.approx([2e-6, 1.002e-3])
    assert (position, velocity, torque) == ([10.0, 11.0], [0.0, 1.0], [0.5, -0.25])
    assert recording.sync_to_reading_us.tolist() == [250.0, 250.0]
    assert (recording.cycles, recording.lost, recording.losses_in_a_row) == (2, 0, ())


def test_a_drive_that_tells_no_torque_is_taken_at_the_command_before() -> None:
    """It acts from behind a SYNC to behind the next one; one that was not sent leaves the last in force."""
    recording = recording_of(
        [
            cycle(0, command_nm=0.1),
            cycle(1, command_nm=0.2),
            cycle(2, command_nm=0.3, sent=False),
            cycle(3),
            cycle(4, command_nm=0.5, torque_nm=9.0),
            cycle(5, DropoutCause.LOST, command_nm=0.6),
            cycle(6),
        ]
    )
    assert recording.torque.tolist() == [0.0, 0.1, 0.2, 0.2, 9.0, 0.6]


def test_readings_that_did_not_come_are_lost_and_others_only_missing() -> None:
    causes = [DropoutCause.LOST, DropoutCause.MISSED, None, DropoutCause.LATE, None, DropoutCause.LOST]
    recording = recording_of([cycle(number, cause) for number, cause in enumerate(causes)])
    assert (recording.cycles, recording.lost) == (6, 3)
    assert recording.losses_in_a_row == (2, 1)
    assert recording.velocity.tolist() == [2.0, 4.0]


def test_samples_are_in_the_order_of_their_instants() -> None:
    recording = recording_of([cycle(0), cycle(1, sampled_us=900, on_bus=False), cycle(2, sampled_us=500)])
    assert recording.velocity.tolist() == [0.0, 2.0, 1.0]
    assert recording.sync_to_reading_us.tolist() == [250.0, 250.0], "of SYNCs that came to the bus"


# ---- the fit ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("held_s", [0.0, 0.0003, -0.0002])
def test_a_torque_that_acts_later_by_so_much_is_told_by_the_shift(held_s: float) -> None:
    """The records' torque acted since the sample before: 0 is true."""
    found = identify_mechanics([record(1.0), record(-1.0)], 0.1, held_s=held_s, with_shift=True)
    assert found.torque_shift_s == pytest.approx(-held_s, abs=3e-6)
    assert found.viscous_friction_nm_s == pytest.approx(B, rel=2e-3)


def test_a_figure_that_is_not_asked_for_is_none() -> None:
    found = identify_mechanics([record(1.0), record(-1.0)], 0.1, with_viscous=False, with_offset=False)
    assert (found.viscous_friction_nm_s, found.offset_nm, found.viscous_error) == (0.0, 0.0, 0.0)
    assert found.torque_shift_s == 0.0
    assert found.inertia_error > 0.0
    assert found.coulomb_error > 0.0


def test_windows_begin_a_quarter_of_one_apart_and_end_with_the_record() -> None:
    """900 samples, 0 to 0.899 s: the last of 0.1 s begins at 0.775."""
    one = record(1.0)
    assert identify_mechanics([one], 0.1, with_offset=False).equations == 32
    assert identify_mechanics([one, one], 0.1, with_offset=False).equations == 64
    fast = identify_mechanics([one], 0.1, speed_min_rad_s=40.0, with_offset=False)
    assert fast.equations < 32


@pytest.mark.parametrize("unit_nm", [1e-3, 2e-3])
def test_what_no_residual_shows_is_added_in_units_of_the_torque(unit_nm: float) -> None:
    """0.012 of a unit at the ramps' torque, 0.02 at the top speed: effects of two known errors."""
    records = [record(1.0), record(-1.0)]
    plain = identify_mechanics(records, 0.1, held_s=0.0)
    stated = identify_mechanics(records, 0.1, held_s=0.0, torque_unit_nm=unit_nm)
    top = max(float(np.max(np.abs(np.diff(position)))) for _, position, _ in records) / 1e-3
    wrong = []
    for time, position, torque in records:
        speed = np.gradient(position, time)
        wrong.append((time, position, torque + 0.02 * unit_nm * np.sign(speed) * (speed / top) ** 2))
    curved = identify_mechanics(wrong, 0.1, held_s=0.0)
    change = abs(curved.viscous_friction_nm_s - plain.viscous_friction_nm_s)
    seen = math.sqrt(stated.viscous_error**2 - plain.viscous_error**2)
    assert seen == pytest.approx(2.0 * change, rel=0.15)
    assert stated.inertia_kg_m2 == plain.inertia_kg_m2


def test_the_residual_is_of_what_the_model_leaves() -> None:
    """Of white noise the mean over a window, 50 samples a half, has dt int(phi^2) / int(phi)^2."""
    exact = identify_mechanics([record(1.0), record(-1.0)], 0.1, held_s=0.0)
    assert exact.residual_nm < 1e-5
    random = np.random.default_rng(3)
    noisy = []
    for direction in (1.0, -1.0) * 8:
        time, position, torque = record(direction)
        noisy.append((time, position, torque + random.normal(0.0, 0.01, len(time))))
    found = identify_mechanics(noisy, 0.1, held_s=0.0)
    squared, plain = 65536.0 / 109395.0, 256.0 / 315.0
    assert found.residual_nm == pytest.approx(0.01 * math.sqrt(squared / plain**2 / 50.0), rel=0.1)


# ---- ratios ----------------------------------------------------------------------------------------------


def test_paths_each_way_count_in_full() -> None:
    """Twice as far one way as the other, and the velocity of the second is twice what it should be."""
    time: Array = np.linspace(0.0, 1.0, 1001)
    there, back = 2.0 * time, -1.0 * time
    found = ratio_of([(time, np.full(1001, 2.0), there), (time, np.full(1001, -2.0), back)])
    assert found.value == pytest.approx(4.0 / 3.0)
    even = ratio_of([(time, np.full(1001, 2.0), there)])
    assert even.value == pytest.approx(1.0)
    assert even.error == pytest.approx(0.0, abs=1e-9)


def test_the_error_of_a_ratio_is_that_of_leaving_out_each_block() -> None:
    """Two blocks of equal paths with ratios 1 and 1.2: the mean 1.1, and 0.1 beside it for either."""
    time: Array = np.linspace(0.0, 1.0, 101)
    velocity = np.where(time[:-1] < 0.5, 1.0, 1.2)
    velocity = np.append(velocity, 1.2)
    found = ratio_of([(time, velocity, time)], blocks=2)
    assert found.value == pytest.approx(1.1, abs=2e-3)
    assert found.error * found.value == pytest.approx(2.0 * 0.1, rel=0.02)


def test_no_velocity_is_a_ratio_of_none_whose_error_has_no_bound() -> None:
    time: Array = np.linspace(0.0, 1.0, 101)
    found = ratio_of([(time, np.zeros(101), time)])
    assert (found.value, found.error) == (0.0, math.inf)
    nowhere = ratio_of([(time, time, np.zeros(101))])
    assert math.isnan(nowhere.value)
    assert nowhere.error == math.inf


@pytest.mark.parametrize(
    ("ratio", "plain"),
    [
        (1.0199, 1.0), (1.0201, 1.0201), (0.9801, 1.0), (0.9799, 0.9799), (1.25, 1.25), (8e-6, 8e-6),
        (2.5e6, 2.5e6), (60.0 / 59.0 * 60.0, 60.0), (1.0 / 60.3, 1.0 / 60.0), (159.0, 1000.0 / math.tau),
        (6e8, 6e8), (1.1, 1.1),
    ],
)  # fmt: skip
def test_a_plain_ratio_is_within_two_percent(ratio: float, plain: float) -> None:
    assert plain_ratio(ratio) == pytest.approx(plain, rel=1e-12)


# ---- torque over the angle ---------------------------------------------------------------------------------


def turned(speed: float, count: int, torque: float) -> Recording:
    time: Array = 1e-3 * np.arange(float(count))
    nothing = np.zeros(count)
    return Recording(time, speed * time, nothing, np.full(count, torque), nothing, count, 0, ())


@pytest.mark.parametrize(("speed", "told"), [(1.0, False), (1.2, True), (55.0, True), (56.0, False)])
def test_a_speed_at_which_nine_samples_span_a_hundredth_to_half_a_radian_is_told(
    speed: float, told: bool
) -> None:
    known = Mechanics(J, B, T_C, T_0, 0.0, 0.0, 0.0, 0, 0.0)
    left = 0.003
    found = torque_by_angle([turned(speed, 8000, T_C + B * speed + T_0 + left)], known)
    seen = found.forward_nm[~np.isnan(found.forward_nm)]
    assert bool(len(seen)) is told
    assert seen == pytest.approx(np.full(len(seen), left), abs=1e-9)
    assert np.isnan(found.backward_nm).all()
    assert found.ripple_nm is None, "one way alone"


def test_bins_of_five_degrees_hold_five_samples_at_least() -> None:
    known = Mechanics(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0)
    width = math.tau / 72.0
    for samples, bins in ((5, 2), (4, 0)):
        made = turned(width / samples * 1e3, 2 * samples + 10, 0.5)
        found = torque_by_angle([made], known)
        assert found.angle_rad[:2] == pytest.approx([0.5 * width, 1.5 * width])
        assert np.sum(~np.isnan(found.forward_nm[:2])) == bins
    assert torque_by_angle([turned(20.0, 9, 0.5)], known).ripple_nm is None, "nine are too few for a speed"
    assert math.isnan(torque_by_angle([], known).error_nm)


def test_the_error_of_a_bin_is_that_of_its_mean() -> None:
    """White noise of 0.01 N m: over a root of the samples in a bin."""
    known = Mechanics(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0)
    random = np.random.default_rng(11)
    made = []
    for way in (1.0, -1.0):
        plain = turned(way * math.tau, 50_000, 0.0)
        noise = random.normal(0.0, 0.01, 50_000)
        made.append(
            Recording(plain.time, plain.position, plain.velocity, noise, plain.velocity, 50_000, 0, ())
        )
    found = torque_by_angle(made, known)
    assert found.error_nm == pytest.approx(0.01 / math.sqrt(50_000 / 72.0), rel=0.02)
    both = 0.5 * (found.forward_nm + found.backward_nm)
    assert found.ripple_nm == pytest.approx(0.5 * (both.max() - both.min()))

"""A made-up run: plausible records of a speed loop with dropouts, a burst and a load step, from a seed."""

import math
from collections.abc import Iterator

import numpy as np

from servobench.drivers.exchange import Command, Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration, Instant
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.samples import CommandFate, Dropout, DropoutCause, Sample, Sending, StateEstimate
from tests.unit.hil.row_tools import cycle_record

PERIOD = NS_PER_MS
DEADLINE = Duration(2 * NS_PER_MS)
STEP_RAD_S = 1500.0 * math.pi / 30.0
_INERTIA, _FRICTION = 0.0008, 0.00185
_GAIN, _INTEGRAL, _TORQUE_MAX = 0.06, 1.2, 5.0
_ENABLED = 0x1637


def synthetic_records(cycles: int, seed: int = 1, origin: int = 0, axis: int = 0) -> Iterator[CycleRecord]:
    """A speed step at 0.2 s, a load step at 1.0 s, 2 % loss each way, a burst from 1.4 to 1.42 s."""
    random = np.random.Generator(np.random.PCG64(seed))
    speed = position = integral = torque = seen = 0.0
    for cycle in range(cycles):
        due_at = Instant(origin + cycle * PERIOD)
        at_s = cycle * PERIOD * 1e-9
        reference = STEP_RAD_S if at_s >= 0.2 else 0.0
        load = 0.6 if at_s >= 1.0 else 0.0
        delay = int(random.uniform(300, 1000) * NS_PER_US)
        if random.random() < 0.004:
            delay += 3 * NS_PER_MS
        lost = random.random() < 0.04 or 1.4 <= at_s < 1.42
        came = Instant(due_at + delay)
        stamp = due_at % 2**32 // 1_000
        reading = Reading(speed, stamp, came, position, came, torque, came, _ENABLED, came)
        observation: Sample | Dropout
        if lost:
            observation = Dropout(cycle + 1, due_at, DropoutCause.LOST, True)
        elif delay > DEADLINE:
            observation = Dropout(cycle + 1, due_at, DropoutCause.LATE, True)
        else:
            observation = Sample(cycle + 1, reading, due_at, 65 * NS_PER_US, True)
            seen = speed
        error = reference - seen
        wanted = _GAIN * error + integral
        torque_command = max(-_TORQUE_MAX, min(_TORQUE_MAX, wanted))
        if torque_command == wanted:
            integral += _INTEGRAL * error * 1e-3
        handed_at = Instant(due_at + 700 * NS_PER_US)
        acts_by = Instant(due_at + PERIOD)
        sending = Sending(
            round(torque_command * 1000), handed_at, handed_at, CommandFate.ACTING, handed_at, acts_by
        )
        yield cycle_record(
            sequence=cycle + 1,
            axis=axis,
            due_at=due_at,
            woke_at=due_at,
            sync_handed_at=due_at,
            sync_on_bus_at=Instant(due_at + 47 * NS_PER_US),
            observation=observation,
            delay=None if lost else Duration(delay),
            estimate=StateEstimate(position, seen, torque, due_at, cycle + 1),
            reference_rad_s=reference,
            load_torque_nm=load,
            command=Command(cycle + 1, torque_command, due_at, Instant(due_at + PERIOD)),
            sending=sending,
            clock_offset_ns=123_456,
            clock_error_ns=1_200,
            compute_ns=15_000 + cycle % 7,
            channels=(load, 2.0 * load),
        )
        torque = torque_command
        speed += (torque - load - _FRICTION * speed) / _INERTIA * 1e-3
        position += speed * 1e-3

"""What moves a shaft beside its motor, as a recording shows it: an end stop, a load that drives it.

    end stop                           a load that drives
    speed ----\\                        speed        /
               |                             _______/       no torque this way
    0 .........|..........             0 ...../...........
               \\____                          from rest

Both are judged before inertia and friction are known, so neither needs them.
"""

import math
from typing import Final

import numpy as np

from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.commissioning.findings import StepFailed
from servobench.hil.commissioning.identify import Array

DRIVEN_TURNS: Final = 0.01
"""From rest; a shaft that is only twisted by its coupling, or takes up its play, turns less."""
_DRIVEN_S: Final = 0.04
"""From rest to the fastest; a rotor that its load swings by a coupling is there in a quarter of a period."""
_QUIET_SHARE: Final = 0.02
"""Of the rated torque: less is the noise of 6077h."""
_PUSH_SHARE: Final = 2e-4
"""Of the rated torque, on average from rest to the fastest: a shaft without friction turns by the first unit
of 6077h, a thousandth, in a fifth of that time."""
_NEAREST: Final = 0.003
"""Turns from where the shaft stood: nearer, a reversal is the flicker of its encoder."""
_LOOK_S: Final = 0.1
"""Before and behind a reversal: a load on a spring of 5 Hz has reversed in that time."""
_REBOUND: Final = 0.1
"""Least speed behind a stop over that before it: a rubber buffer gives back 0.3 and more."""
_SWING: Final = 0.5
"""Of the speed one way, that the other way: nothing brings a shaft back to a stop that it came from."""
_SUDDEN: Final = 3.0
"""The shaft was at half of its speed and above for so many times as long as the reversal takes, from half of
it to half of the speed behind it; a sine is so for twice as long."""
_OWN_SHARE: Final = 0.3
"""Of the impulse of torque that the run-up took for such a change of speed; a motor that reverses the shaft
by itself needs all of it."""
_SLOWEST: Final = 0.5
"""Of the fastest in the recording: slower reversals are the swing behind a motion."""


def refuse_outside(time: Array, position: Array, speed: Array, torque: Array, rated_nm: float) -> None:
    """Raise StepFailed that names what else moved the shaft: time in s, rad, rad/s, N m; (n,) each."""
    if len(time) < 10 or not np.any(speed) or np.isnan(torque).all():
        return
    hit = _stop_hit(time, position, speed, torque)
    if hit is not None:
        way = (position[hit] - position[0]) / math.tau
        came = float(np.max(np.abs(speed[max(0, hit - 50) : hit])))
        raise StepFailed(
            f"the shaft ran against something {abs(way):.3f} turns {'up' if way > 0.0 else 'down'} "
            "from where the motion began",
            f"it came with {came / RAD_S_PER_RPM:.3g} r/min and went back at once",
            "an end stop? move the shaft to the middle of its travel, and give limits.turns_max in the "
            "nameplate",
        )
    driven = _driven(time, position, speed, torque, rated_nm)
    if driven is not None:
        turns, gained = driven
        raise_driven(turns, f"{abs(gained) / RAD_S_PER_RPM:.3g} r/min from rest, and no torque told that way")


def raise_driven(turns: float, evidence: str) -> None:
    """Raise StepFailed for a shaft that turned by ``turns`` while the motor told no torque that way."""
    raise StepFailed(
        f"the shaft turned {'up' if turns > 0.0 else 'down'} by {abs(turns):.3f} turns by itself",
        evidence,
        "a load that hangs, an arm, or an offset of the current sensors: take the load off, or balance it",
    )


def _stop_hit(time: Array, position: Array, speed: Array, torque: Array) -> int | None:
    """Return the first sample behind a sudden reversal that no torque made; None if there is none."""
    period = float(np.median(np.diff(time)))
    look = max(3, round(_LOOK_S / period))
    least = _SLOWEST * float(np.max(np.abs(speed)))
    began = 0
    # A shaft that stands for a moment and goes on the same way does not reverse.
    moving = np.maximum.accumulate(np.where(speed != 0.0, np.arange(len(speed)), 0))
    for at in np.flatnonzero(np.sign(speed[moving[1:]]) * np.sign(speed[moving[:-1]]) < 0.0) + 1:
        before, behind = np.abs(speed[began:at]), np.abs(speed[at : at + look])
        fast, back = float(before[-look:].max(initial=0.0)), float(behind.max())
        far = abs(float(position[at] - position[began])) > _NEAREST * math.tau
        if far and fast >= least and back >= _REBOUND * fast:
            left = began + int(np.flatnonzero(before >= 0.5 * fast)[-1]) + 1
            slower = np.flatnonzero(np.abs(speed[began:left]) < 0.5 * fast)
            came = began + (int(slower[-1]) + 1 if len(slower) else 0)
            gone = at + int(np.argmax(behind >= 0.5 * back)) + 1
            top = int(np.argmax(before)) + 1
            by_torque = float(np.nansum(np.abs(torque[began : began + top]))) / float(before.max())
            needed = by_torque * 0.5 * (fast + back)
            pulled = abs(float(np.nansum(torque[left:gone])))
            sudden = left - came > _SUDDEN * (gone - left) and pulled <= _OWN_SHARE * needed
            if sudden and not _swings(position[at : at + look], speed[at : at + look]):
                return int(at)
        began = int(at)
    return None


def _swings(position: Array, speed: Array) -> bool:
    """Return True of a rotor behind a reversal that goes to and fro where it is: in the play of a coupling
    whose load has come to rest."""
    back = math.copysign(1.0, float(speed[int(np.argmax(np.abs(speed)))])) * speed
    near = float(np.ptp(position)) < _NEAREST * math.tau
    return near and -float(back.min()) >= _SWING * float(back.max())


def _driven(
    time: Array, position: Array, speed: Array, torque: Array, rated_nm: float
) -> tuple[float, float] | None:
    """Return turns and rad/s that the shaft gained from rest while no torque drove it; None if it did not."""
    if np.isnan(torque).any():
        return None
    way = np.sign(speed)
    # Which way a torque turns the shaft is not known at first; on the whole the motor drives it.
    along = math.copysign(1.0, float(torque @ speed)) * torque * way
    pushed = along > _QUIET_SHARE * rated_nm
    fastest = float(np.max(np.abs(speed)))
    edges = np.flatnonzero(pushed | (way == 0.0) | (np.concatenate([[0.0], way[:-1]]) != way))
    for low, high in zip(edges, [*edges[1:], len(speed)], strict=True):
        if high - low < 5:
            continue
        part = np.abs(speed[low:high])
        top = int(np.argmax(part))
        turns = float(position[low + top] - position[low]) / math.tau
        if time[low + top] - time[low] < _DRIVEN_S:
            continue
        if float(np.mean(along[low : low + top + 1])) > _PUSH_SHARE * rated_nm:
            continue
        if part[0] < 0.3 * part[top] and part[top] > 0.05 * fastest and abs(turns) > DRIVEN_TURNS:
            return turns, float(speed[low + top])
    return None

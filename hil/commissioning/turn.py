"""One turn of the motor in position units: by the encoder's index pulse, or by hand.

Homing on the index pulse (methods 33 and 34 of CiA 402-2) sets the position to the home offset at the pulse.
The second homing in a row finds the next pulse, one turn on: there the position jumps back by one turn.

    position      ____/|        /|
                 /     |  ____ / |      the height of the second jump
                /      |_/    /  |_
"""

import math
from typing import Final, NamedTuple

from servobench.drivers.cia402.drive_setup import write_optional
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode, State, Status, state_of, supported_mode_bit
from servobench.drivers.errors import PeerFault
from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.commissioning.session import Session
from servobench.hil.machine.stopping import Interrupted

INDEX_POSITIVE: Final = 34
"""Homing method: the next index pulse in the positive direction."""
_SPEEDS_TURNS_S: Final = (0.5, 2.0, 8.0)
"""In the drive's unit, which may be wrong: so the search begins slowly."""
_SEARCH_S: Final = 5.0
"""Two turns at the slowest speed take 4 s, and the next pulse is one away at most."""
_SEARCHES: Final = 4
"""The first finds a pulse, the second the next; two more for a shaft that ran on too far, or not far
enough."""
_SPEED_UP_S: Final = 0.25
"""Short beside a search. At the slowest speed a sixteenth of a turn, and a lag of 1e-4 turns in 10 ms."""
_OVERSHOOT_MAX: Final = 0.4
"""Share of an assumed turn: beyond half a turn it could be two."""
_STALE_NS: Final = 20_000_000
"""Time for which the statusword may still describe the previous homing."""
_SETTLED: Final = 36
"""Consecutive readings that show the end: the position may be reset some cycles after the statusword has
changed, and three times :data:`_HISTORY` is long enough to see that."""
_HISTORY: Final = 12
"""Readings from which the motion is extrapolated: over so many one count of the encoder is little of the
speed."""
_JUMP_TURNS: Final = 0.01
"""Less is an extrapolation error: the steepest start, 8 turns/s in 0.25 s, makes 2e-4 at 1 ms a cycle."""
_STILL_TURNS: Final = 0.01
"""A shaft that stays within it stands: at the slowest speed it would be through in 20 ms."""
_WORD: Final = 1 << 32
"""6064h is an INTEGER32, and wraps."""
_START: Final = 1 << 4
"""Bit of the controlword: homing starts as it rises."""

_FOUND: Final = Status.MODE_12
_FAILED: Final = Status.MODE_13


def can_home(session: Session) -> bool:
    """Return True if the drive has homing, as far as it says."""
    objects = session.objects
    if objects.read_if_there(Object.HOMING_METHOD, 0, "b") is None:
        return False
    modes = objects.read_if_there(Object.SUPPORTED_DRIVE_MODES)
    return not modes or bool(modes & supported_mode_bit(Mode.HOMING))


def index_turn(session: Session) -> tuple[float | None, str]:
    """Return the position units of one turn, and how they were found; None with the reason if they were
    not."""
    drive, objects = session.drive, session.objects
    if not can_home(session):
        return None, "the drive has no homing"
    for turns_s in _SPEEDS_TURNS_S:
        raw = max(1, round(turns_s * math.tau / session.velocity_rad_s))
        refused = write_optional(objects, Object.HOMING_METHOD, "b", INDEX_POSITIVE, "homing on the index")
        for sub in (1, 2):
            refused += write_optional(objects, Object.HOMING_SPEEDS, "I", raw, "homing speed", sub)
        refused += _ramp(session, turns_s)
        if refused:
            return None, "; ".join(refused)
        with session.stop.armed():
            try:
                drive.change_mode(Mode.HOMING, session.deadline(1.0))
                drive.enable(session.deadline(3.0))
                turn_rad = _by_searches(session)
                if turn_rad is not None:
                    return turn_rad / session.position_rad, f"index pulses at {turns_s:g} turns/s"
            except Interrupted:
                raise
            except PeerFault as error:
                return None, str(error)
            finally:
                session.calm()
    return None, "no index pulse came"


def _ramp(session: Session, turns_s: float) -> list[str]:
    """Make 609Ah reach the speed soon, but no sooner: the shaft brakes with it from the pulse on, and its lag
    by the next reading, a t^2/2, would count as part of the turn. Return notes on refusals."""
    if session.objects.read_if_there(Object.HOMING_ACCELERATION) is None:
        return []
    raw = round(turns_s * math.tau / _SPEED_UP_S / session.acceleration_rad_s2)
    raw = min(max(raw, 1), 0xFFFF_FFFF)
    return write_optional(session.objects, Object.HOMING_ACCELERATION, "I", raw, "homing acceleration")


class _Homing(NamedTuple):
    """One homing to its end, rad."""

    jump: float
    """Change of the position at the pulse."""
    overshoot: float
    """Distance that the shaft went on beyond it."""


def _by_searches(session: Session) -> float | None:
    """Return one turn, rad by the units in use; None if no two pulses a turn apart were found.

    A shaft that came to rest before the pulse that it had passed finds the same one again: that is no turn.
    One that ran on over further pulses finds one several turns on: only a short way behind the pulse before
    makes sure that it is the next.
    """
    last: _Homing | None = None
    for _ in range(_SEARCHES):
        homing = _search(session, _SEARCH_S)
        if homing is None:
            return None
        turn = abs(homing.jump)
        if last is not None and turn > 0.0 and last.overshoot < _OVERSHOOT_MAX * turn:
            return turn
        last = homing
    return None


class _Still:
    """Watches whether a shaft that turned stands before a pulse came."""

    def __init__(self) -> None:
        self._place_rad: float | None = None
        self._since = Instant(0)
        self._turned = False

    def look(self, reading: Reading) -> None:
        """Look at the next reading."""
        if (
            self._place_rad is not None
            and abs(reading.position_rad - self._place_rad) < _STILL_TURNS * math.tau
        ):
            return
        self._turned = self._place_rad is not None
        self._place_rad, self._since = reading.position_rad, reading.received_at

    def refuse(self, now: Instant) -> None:
        """Raise PeerFault if it stood for the last second."""
        if self._turned and now - self._since > NS_PER_S:
            raise PeerFault(
                "the shaft turned, and stood before an index pulse came", "", "an end stop, or a brake?"
            )


def _search(session: Session, limit_s: float) -> _Homing | None:
    """Home once; None if no pulse came in time."""
    control, network, drive = session.drive.control, session.network, session.drive
    history: list[Reading] = []
    jump = 0.0
    control.set_bits(_START, 0)
    session.wait(0.005)
    drive.take_readings()
    control.set_bits(_START, _START)
    started = session.clock_now
    deadline = session.deadline(limit_s)
    passed_rad: float | None = None
    settled = 0
    still = _Still()
    try:
        while network.clock.now() < deadline:
            network.pump(Instant(network.clock.now() + session.found.period))
            network.send_sync()
            session.check_stop()
            for reading in drive.take_readings():
                word = reading.statusword
                if state_of(word) is not State.OPERATION_ENABLED or word & _FAILED:
                    return None
                still.look(reading)
                step = _jump(history, reading)
                jump += step
                if passed_rad is not None:  # the statusword came before the position of the same instant
                    passed_rad -= step
                history.append(reading)
                del history[:-_HISTORY]
                fresh = reading.received_at - started > _STALE_NS
                if fresh and word & _FOUND and passed_rad is None:
                    passed_rad = reading.position_rad
                ended = fresh and word & _FOUND and word & Status.TARGET_REACHED
                settled = settled + 1 if ended else 0
                if settled > _SETTLED and passed_rad is not None:
                    return _Homing(jump, abs(reading.position_rad - passed_rad))
            if passed_rad is None:
                still.refuse(network.clock.now())
        return None
    finally:
        control.set_bits(_START, 0)


def _jump(history: list[Reading], reading: Reading) -> float:
    """Return how much lower the position is than extrapolated from the previous motion; 0 if it is as
    expected."""
    if len(history) < _HISTORY:
        return 0.0
    first, last = history[0], history[-1]
    passed_s = (_sampled_ns(last) - _sampled_ns(first)) / NS_PER_S
    speed = (last.position_rad - first.position_rad) / passed_s if passed_s > 0.0 else 0.0
    step_s = (_sampled_ns(reading) - _sampled_ns(last)) / NS_PER_S
    expected = last.position_rad + speed * step_s
    difference = expected - reading.position_rad
    if abs(difference) < _JUMP_TURNS * math.tau:
        return 0.0
    history.clear()
    return difference


def _sampled_ns(reading: Reading) -> int:
    """Return the sampling instant, ns from any origin: by the drive's stamp, as a busy host receives it
    late."""
    stamp_ns = reading.device_time_ns
    return reading.received_at if stamp_ns is None else stamp_ns


def hand_turn(session: Session) -> tuple[float | None, str]:
    """Have somebody turn the shaft by one turn, with the drive disabled."""
    dialog, objects = session.dialog, session.objects
    before = objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i")
    reply = dialog.line(
        "    Mark the shaft, turn it by hand by exactly one turn, and press Enter; s if it cannot.",
        session.idle,
    )
    after = objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i")
    if reply.lower().startswith("s") or after == before:
        return None, "the shaft was not turned by hand"
    apart = (after - before) % _WORD
    return float(min(apart, _WORD - apart)), "by hand"

"""Finds when a command acts: torque switched to and fro at a shifting instant of the cycle."""

from statistics import median
from typing import Final, NamedTuple

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.commissioning.excitation import StepLag
from servobench.hil.commissioning.session import Session

_SWITCHES: Final = 500
"""At 1 kHz 2 s: each age is met to a five-hundredth of the interval, and noise averages out."""
_SWITCHES_MIN: Final = 150
"""Fewer do not fill the ages between two SYNCs."""
_SWITCHING_S: Final = 4.0
"""In all, as long as that leaves enough switches."""
_HOLD_CYCLES: Final = 4
"""Between two switches: the answer has come before the next one, and the shaft gains little speed."""
_GOLDEN: Final = 0.6180339887498949
"""Golden section: steps of it fill an interval evenly, however many there are."""
_CLEAR: Final = 1.25
"""Command frames between a switch and its SYNC, at least: the SYNC must not wait for the command to leave."""
_LONGEST_PART: Final = 0.7
"""Longest time from a switch to its SYNC, in periods."""
_LONGEST_NS: Final = 700_000.0
"""Longest time from a switch to the SYNC that shows it; later SYNCs show the rest of the answer."""
_BEGUN_PART: Final = 0.05
"""More of the step in the youngest answers: its begin is not among them."""
_BEHIND_PART: Final = 0.4
"""Of a period, in which a switch then follows a SYNC whose readings are still to be sampled."""
_SETTLED_LAGS: Final = 2.0
"""After half of the response: there 93 % of a first-order response have come."""
_LOST_PART: Final = 0.3
"""Less of the step than this, so late, is none of it: noise of the torque feedback is far below."""
_HEARD_PART: Final = 0.8
"""More of the step from the end of a hold to that of the next: the switch was heard."""
_IGNORED_PART: Final = 0.3
"""Less: it was not heard."""
_IN_A_ROW: Final = 3
"""Switches, of which each is sent four times: lost frames make no such three, and noise does not reach from
one of these parts to the other so often."""


def switches(session: Session) -> int:
    """Return the number of torque switches: fewer if a cycle takes long."""
    hold_s = _HOLD_CYCLES * session.found.period / NS_PER_S
    return max(_SWITCHES_MIN, min(_SWITCHES, round(_SWITCHING_S / hold_s)))


class TorqueSlope(NamedTuple):
    """Effect of 6087h on a switch in profile torque mode."""

    told: str
    takes_us: float


def torque_slope(session: Session, change_nm: float) -> TorqueSlope | None:
    """Return the slope; None in a mode without one, or if the drive does not report it."""
    if session.torque_mode() is not Mode.PROFILE_TORQUE:
        return None
    raw = session.objects.read_if_there(Object.TORQUE_SLOPE)
    if not raw:
        return None
    takes_us = 1e9 * change_nm / session.drive.rated_torque_nm / raw
    return TorqueSlope(
        f"{raw} thousandths a second, {1e-3 * takes_us:.3g} ms for {change_nm:.3g} N m", takes_us
    )


class CommandProbe:
    """Switches the torque to and fro at an instant of the cycle that shifts from switch to switch.

    The drive shows its torque only at SYNCs; as the commands come at ever other times before them, the
    samples show the answer to a switch at many ages (equivalent-time sampling).
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._network = session.network
        self._drive = session.drive
        self._port = session.port
        self._period = session.found.period
        self._latency = session.timing().sync_latency
        rated = session.drive.rated_torque_nm
        self._step_nm = max(0.02 * rated, min(0.25 * session.limits.torque_nm, 0.1 * rated))
        self.slope = torque_slope(session, 2.0 * self._step_nm)
        self.delays_us: list[float] = []
        self.answers: list[tuple[float, float]] = []
        self.cycles = 0
        self.missing: list[bool] = []
        """For each cycle: True if its reading did not come in time."""
        self.firsts: list[tuple[float, float]] = []
        """Responses at the first SYNC after a switch, before it is repeated."""
        self.commands = 0
        """Switches old enough at that SYNC to be judged."""
        self.hidden_us = 0.0
        """Ages up to this are not seen, as a command and its SYNC are not on the bus at once; 0: no effect
        began there."""
        self.commands_lost = 0
        self._held_nm: float | None = None
        """Torque at the end of the last hold; None if unknown."""
        self._heard = self._ignored = 0
        """Consecutive switches; limited to _IN_A_ROW."""

    def run(self) -> None:
        due = Instant(self._session.clock_now + self._period)
        torque = self._step_nm
        self._drive.take_readings()
        # Not so shortly before the SYNC that this would have to wait for the command to leave the bus.
        command = self._session.timing().command_latency
        shortest = _CLEAR * command
        longest = max(2.0 * shortest, min(_LONGEST_PART * self._period, max(_LONGEST_NS, 6.0 * command)))
        # Half of a hold first, so that the shaft swings about its place.
        due = self._hold(due, torque, 0.5, _HOLD_CYCLES // 2, None)
        for number in range(switches(self._session)):
            before, torque = torque, -torque
            lead = shortest + (longest - shortest) * ((number * _GOLDEN) % 1.0)
            due = self._hold(due, torque, 1.0 - lead / self._period, _HOLD_CYCLES, before)
        if _begun(self.answers):
            self._look_behind(due, torque)
        self._send(0.0, Instant(self._session.clock_now + self._period))

    def _look_behind(self, due: Instant, torque: float) -> None:
        """Switch behind the SYNC too, for a drive that samples later than it, or acts faster than a command
        can be sent in front of it."""
        self.hidden_us = min(age_us for age_us, _part in self.answers)
        for number in range(switches(self._session)):
            before, torque = torque, -torque
            part = _BEHIND_PART * ((number * _GOLDEN) % 1.0)
            due = self._hold(due, torque, part, _HOLD_CYCLES, before, behind=True)

    def _hold(
        self,
        due: Instant,
        torque: float,
        part: float,
        cycles: int,
        before: float | None,
        behind: bool = False,
    ) -> Instant:
        """Switch to ``torque`` in the first cycle; it is repeated, to make up for a lost command.

        ``behind``: the readings of that cycle's SYNC, from before the switch, may show it.
        """
        sent_at: Instant | None = None
        held_nm: float | None = None
        late = False
        for cycle in range(cycles):
            self._network.pump(due)
            self._session.check_stop()
            late = late or self._session.clock_now - due > self._period // 2
            sync_at = self._network.send_sync()
            self.cycles += 1
            command_at = Instant(max(due + round(part * self._period), sync_at))
            self._network.pump(command_at)
            answered = self._answered(sync_at)
            at = self._send(torque, Instant(command_at + self._period))
            due = Instant(max(due + self._period, self._session.clock_now))
            if not answered:  # a drive with a task for its PDOs answers later than this
                self._network.pump(due)
                answered = self._answered(sync_at)
            self.missing.append(not answered)
            shown_nm, told_at = self._drive.torque_shown
            told = told_at - sync_at >= self._latency
            may_show = behind or sent_at is not None
            sent_at = at if sent_at is None else sent_at
            if before is not None and sent_at is not None and may_show and told and not late:
                held_nm = shown_nm
                self._answer(sync_at, sent_at, shown_nm, before, torque, cycle)
            self._port.check()
        self._judge_hold(held_nm, before, torque)
        return due

    def _judge_hold(self, held_nm: float | None, before: float | None, torque: float) -> None:
        """Raise DriveInFault if the drive follows some switches and ignores others.

        ``held_nm``: torque at the end of a hold. A drive that is slow follows each switch by as little.
        """
        last_nm, self._held_nm = self._held_nm, held_nm
        if before is None or held_nm is None or last_nm is None:
            return
        part = (held_nm - last_nm) / (torque - before)
        if self._heard < _IN_A_ROW:
            self._heard = self._heard + 1 if part > _HEARD_PART else 0
        if self._ignored < _IN_A_ROW:
            self._ignored = self._ignored + 1 if part < _IGNORED_PART else 0
        if self._heard == self._ignored == _IN_A_ROW:
            raise self._drive.watch.deaf()

    def _answered(self, sync_at: Instant) -> bool:
        """Return True if a reading of the SYNC came; keep its delay."""
        delays = [reading.received_at - sync_at - self._latency for reading in self._drive.take_readings()]
        answers = [delay for delay in delays if delay >= 0]
        self.delays_us += [delay / 1e3 for delay in answers]
        return bool(answers)

    def _answer(
        self, sync_at: Instant, sent_at: Instant, shown: float, before: float, torque: float, cycle: int
    ) -> None:
        age_us = (sync_at + self._latency - sent_at) / 1e3
        part = (shown - before) / (torque - before)
        if cycle == 1:
            self.firsts.append((age_us, part))
        self.answers.append((age_us, part))

    def _send(self, torque_nm: float, expires_at: Instant) -> Instant | None:
        """Send a torque; return when the bus was given it; None if it was too late to be sent."""
        sent = self._port.write(Command(0, torque_nm, expires_at, expires_at))
        return None if sent is None else sent.handed_at

    def judge_commands(self, lag: StepLag) -> None:
        """Count as lost the commands that should have shown their effect by the first SYNC, and did not."""
        old_us = lag.half_us + _SETTLED_LAGS * lag.lag_us
        judged = [part for age_us, part in self.firsts if age_us > old_us]
        self.commands = len(judged)
        self.commands_lost = sum(part < _LOST_PART for part in judged)


def _begun(answers: list[tuple[float, float]]) -> bool:
    """Return True if the youngest answers, (age, part of the step), show it already."""
    youngest = sorted(answers)[: max(5, len(answers) // 100)]
    return len(youngest) >= 5 and median(part for _age_us, part in youngest) > _BEGUN_PART

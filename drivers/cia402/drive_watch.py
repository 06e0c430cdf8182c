"""Watches an enabled drive by what it reports: state, mode, heartbeat, statusword."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final

from servobench.drivers.canopen.nmt import NodeStatus
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.pdo import PdoMap, PdoPlan
from servobench.drivers.canopen.polls import ObjectPoll, Polled
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.follow_watch import FollowWatch, Lapse
from servobench.drivers.cia402.objects402 import INTERLOCK, Object
from servobench.drivers.cia402.pdo_plans import MODE
from servobench.drivers.cia402.profile import DriveCommand, state_of
from servobench.drivers.cia402.state_control import FAULTY, StateControl
from servobench.drivers.core.native import LastStatusword
from servobench.drivers.errors import DriveInFault, NoAnswer, PeerFault, PowerLost
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant

_OPERATIONAL: Final = NmtState.OPERATIONAL
_ENABLED_BITS: Final = 0x6F
_ENABLED: Final = 0x27
"""OPERATION ENABLED, as :data:`servobench.drivers.cia402.profile.STATUS_PATTERNS` has it (CiA 402-2)."""
_VOLTAGE: Final = 0x10
"""Bit 4 of the statusword, voltage enabled."""
MODE_EVERY: Final = Duration(50 * NS_PER_MS)
"""Interval between two reads of 6061h by SDO: that of a heartbeat. Two frames of at most 135 bits are 0.5 %
of 1 Mbit/s, 4 % of 125 kbit/s."""
MODE_SILENCE: Final = 4 * MODE_EVERY
"""A read without an answer is given up after 100 ms: on a bus that loses a tenth of its frames, one in
4000."""
_UNWATCHED: Final = Duration(1 << 62)
"""Longer than any silence."""


class DriveWatch:
    """Watch over one drive. ``active``: it was enabled, and nothing seen or done since has ended that."""

    def __init__(
        self, control: StateControl, status: NodeStatus, told: LastStatusword, follow: FollowWatch
    ) -> None:
        self.active = False
        self.stop_first: Callable[[], None] = partial(control.command_by_pdo, DriveCommand.QUICK_STOP)
        """Called before a misbehaving drive is asked for the reason, as answers take time: this drive stops
        by RPDO. With several drives in a run, each must stop all."""
        self.on_mode_watch: Callable[[], None] = _nobody
        """Called when 6061h is no longer answered, and when it is answered again."""
        self._mode_read_at = Instant(0)
        self._unanswered = False
        """True while 6061h is read and the drive has not answered for MODE_SILENCE."""
        self._went_unanswered = False
        """True if that happened since it was enabled."""
        self._follow = follow
        self._mode_pdo: PdoMap | None = None
        self._poll: ObjectPoll | None = None
        self._bears_lapses = False
        self._control = control
        self._status = status
        self._told = told
        self._as_expected = told.as_expected
        self._now = control.network.clock.now
        self._boot_ups = 0
        self._beats = True
        self._bits = _ENABLED_BITS
        self._wanted = _ENABLED
        self._silence_ns = _UNWATCHED

    def configure(self, beats: bool, plan: PdoPlan, settings: DriveSettings) -> None:
        """Set the times to watch by. ``beats``: the drive sends a heartbeat. The statusword may be silent as
        long as that."""
        self._beats = beats
        self._bears_lapses = settings.bears_lapses
        self._mode_pdo = plan.tpdo_with(*MODE)
        self._silence_ns = _silence_borne(plan, settings.drive_heartbeat_timeout_ms)
        self._expect()

    def begin(self) -> None:
        """Begin the watch: the drive is enabled now."""
        control = self._control
        self._boot_ups = self._status.boot_ups
        control.emergency_came = False
        # Some drives never set the bit "voltage enabled": it can be lost only where it was.
        voltage = max(self._told.statusword, 0) & _VOLTAGE
        self._bits, self._wanted = _ENABLED_BITS | voltage, _ENABLED | voltage
        self._expect()
        self.active = True
        self._follow.begin()
        objects = control.objects
        if self._mode_pdo is None and self._poll is None and objects.read_if_there(*MODE, "b") is not None:
            self._mode_read_at = self._now()
            self._unanswered = self._went_unanswered = False
            polled = Polled(objects.node_id, *MODE, MODE_EVERY, self._mode_read)
            self._poll = control.network.poll(polled)

    def end(self) -> None:
        """End the watch: the drive is about to be stopped."""
        self.active = False
        self._follow.end()
        if self._poll is not None:
            self._control.network.polls.end(self._poll)
            self._poll = None

    @property
    def sees_mode(self) -> bool:
        """True if 6061h is mapped, or read."""
        return (self._poll is not None and not self._unanswered) or self._follow.mode_shown

    @property
    def mode_watch(self) -> str:
        """How a drive that ignores its commands is noticed, in words; for an enabled drive."""
        follow = self._follow
        way = f"in {self._mode_pdo.name}" if self._mode_pdo else f"by SDO every {MODE_EVERY // NS_PER_MS} ms"
        if self._mode_pdo is None and self._poll is None:
            mode = "nothing, as its 6061h cannot be read"
        elif self._mode_pdo is not None and not follow.mode_shown:
            mode = f"nothing, as 6061h {way} does not show it"
        elif self._unanswered:
            mode = f"nothing, as 6061h, read {way}, is not answered any more"
        else:
            mode = f"6061h {way}{', which was not answered for a time' if self._went_unanswered else ''}"
        if not follow.has_bit:
            return mode
        bit = "bit 12 of 6041h" if follow.bit_watched else "bit 12 of 6041h once it is set: it is 0"
        return f"{mode}; {bit}"

    def _mode_read(self, data: bytes, at: Instant) -> None:
        self._mode_read_at = at
        self._follow.mode_told(int.from_bytes(data[:1], "little", signed=True), at)

    def check(self, commanded: bool) -> None:
        """Raise if the drive is not as it should be; wait only if it raises.

        NoAnswer: its heartbeat is lost, or its statusword was not told for too long. DriveInFault: it was
        enabled and reports a fault, has left OPERATION ENABLED or the NMT state OPERATIONAL (which silences
        its PDOs), was restarted, or does not follow its commands: by its mode and its statusword, or, where
        ``commanded`` is False, by its demand. PowerLost: its statusword says that there is no voltage any
        more.
        """
        status, control = self._status, self._control
        if status.lost_at is not None:
            raise NoAnswer(
                f"{control.title} was lost",
                f"no heartbeat for {status.timeout_ns / NS_PER_MS:.0f} ms",
                "check its supply and the cable",
                status.lost_at,
            )
        if not self.active:
            return
        if status.boot_ups != self._boot_ups:
            self.active = False
            raise DriveInFault(
                f"{control.title} restarted",
                f"{status.boot_ups - self._boot_ups} boot-up message",
                seen_at=status.heartbeat_at,
            )
        if self._beats and status.state is not _OPERATIONAL:
            self._end_and_stop()
            left = "an unknown NMT state" if status.state is None else status.state.name
            seen_at = status.heartbeat_at
            raise DriveInFault(f"{control.title} fell back to {left}", control.evidence(), seen_at=seen_at)
        if control.emergency_came:
            control.ask_after_emergency()
        as_expected = self._as_expected(self._now())
        if not as_expected and self._told.statusword & self._bits != self._wanted:
            self._end_and_stop()
            raise self._out_of_operation()
        if self._poll is not None and (self._now() - self._mode_read_at > MODE_SILENCE) != self._unanswered:
            self._unanswered, self._went_unanswered = not self._unanswered, True
            self.on_mode_watch()
        if not as_expected:
            self.active = False
            silence_ms = self._silence_ns / NS_PER_MS
            raise NoAnswer(
                f"{control.title}: the statusword has not been told for {silence_ms:.0f} ms",
                remedy="check the cable, and what else is on the bus",
            )
        if not commanded:
            raise self.deaf()
        follow = self._follow
        if follow.lapse is not None:
            follow.lapse.cycles += 1
        # One that is over within a cycle is one too.
        if follow.lapses and not self._bears_lapses:
            self._end_and_stop()
            raise self._unfollowed(follow.lapses[-1])

    def deaf(self) -> DriveInFault:
        """Return the error for a drive that ignores its commands; it is stopped before it is asked."""
        self._end_and_stop()
        control = self._control
        return DriveInFault(f"{control.title} no longer follows its commands", control.evidence())

    def _expect(self) -> None:
        self._told.expect(self._bits, self._wanted, self._silence_ns)

    def _end_and_stop(self) -> None:
        self.active = False
        self.stop_first()

    def _unfollowed(self, lapse: Lapse) -> DriveInFault:
        """Return the error for a lapse. The bit may come before the mode that explains it: the drive is
        asked."""
        control = self._control
        with suppress(PeerFault):
            shown = control.objects.read_if_there(Object.MODES_OF_OPERATION_DISPLAY, 0, "b")
            lapse.shown = lapse.shown if shown is None or lapse.shown != lapse.mode else shown
        return DriveInFault(
            f"{control.title} {lapse}",
            f"{lapse.evidence}, {control.evidence()}",
            "find what changed its mode, or blocks it",
            lapse.began_at,
        )

    def _out_of_operation(self) -> DriveInFault | PowerLost:
        control, word = self._control, self._told.statusword
        state = state_of(word) if word >= 0 else None
        if state in FAULTY:
            return control.in_fault()
        if self._bits & _VOLTAGE & ~word:
            return self._power_lost()
        named = "an unknown state" if state is None else repr(state.value)
        seen_at = self._told.at
        return DriveInFault(
            f"{control.title} fell out of operation into {named}", control.evidence(), seen_at=seen_at
        )

    def _power_lost(self) -> PowerLost:
        control, seen_at = self._control, self._told.at
        inputs: int | None = None
        with suppress(PeerFault):
            inputs = control.objects.read_if_there(Object.DIGITAL_INPUTS, 0, "I")
        if inputs is None:
            cause = "it has no 60FDh that could tell why"
        elif inputs & INTERLOCK:
            cause = "safe torque off: 60FDh shows an interlock"
        else:
            cause = "60FDh shows no interlock"
        return PowerLost(
            f"{control.title} lost the power of its stage while it was enabled",
            f"the bit 'voltage enabled' of the statusword is gone; {cause}; {control.evidence()}",
            "check the safety circuit and the supply of the power stage",
            seen_at,
        )


def _nobody() -> None:
    """Notify nobody."""


def _silence_borne(plan: PdoPlan, silence_ms: int) -> Duration:
    """Return the longest silence allowed for a statusword sent on change and repeated by its event timer, ns.

    One that comes with the SYNC is missed with the readings.
    """
    status = plan.tpdo_with(Object.STATUSWORD)
    if status is None or status.synchronous or not status.event_timer_ms:
        return _UNWATCHED
    return Duration(max(silence_ms, 2 * status.event_timer_ms) * NS_PER_MS)

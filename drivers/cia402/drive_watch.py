"""Whether an enabled drive is still what it should be, by what it tells of itself."""

from contextlib import suppress
from typing import Final

from drivers.canopen.nmt import NodeStatus
from drivers.canopen.nmt_states import NmtState
from drivers.canopen.pdo import PdoPlan
from drivers.cia402.objects402 import INTERLOCK, Object
from drivers.cia402.profile import state_of
from drivers.cia402.readings import LastStatusword
from drivers.cia402.state_control import FAULTY, StateControl
from drivers.errors import DriveInFault, NoAnswer, PeerFault, PowerLost
from drivers.timebase import NS_PER_MS, Duration

_ENABLED_BITS: Final = 0x6F
_ENABLED: Final = 0x27
"""OPERATION ENABLED, as :data:`drivers.cia402.profile.STATUS_PATTERNS` has it (CiA 402-2)."""
_VOLTAGE: Final = 0x10
"""Bit 4 of the statusword, voltage enabled."""
_UNWATCHED: Final = Duration(1 << 62)
"""No silence is as long."""


class DriveWatch:
    """Of one drive. ``active``: it was enabled, and since then nothing was seen or done that ended it."""

    def __init__(self, control: StateControl, status: NodeStatus, told: LastStatusword) -> None:
        self.active = False
        self._control = control
        self._status = status
        self._told = told
        self._now = control.network.clock.now
        self._boot_ups = 0
        self._beats = True
        self._bits = _ENABLED_BITS
        self._wanted = _ENABLED
        self._silence_ns = _UNWATCHED

    def configure(self, beats: bool, plan: PdoPlan, silence_ms: int) -> None:
        """``beats``: it sends a heartbeat. ``silence_ms``: longest silence that is borne of a statusword."""
        self._beats = beats
        self._silence_ns = _silence_borne(plan, silence_ms)

    def begin(self) -> None:
        """The drive is enabled now."""
        self._boot_ups = self._status.boot_ups
        self._control.emergency_came = False
        # Some drives never set the bit "voltage enabled": it can be lost only where it was.
        voltage = max(self._told.statusword, 0) & _VOLTAGE
        self._bits, self._wanted = _ENABLED_BITS | voltage, _ENABLED | voltage
        self.active = True

    def check(self) -> None:
        """Raise if the drive is not what it should be; waits only if it raises, or if an EMCY has come.

        NoAnswer: its heartbeat is lost, or its statusword was not told for too long. DriveInFault: it was
        enabled and reports a fault, has left OPERATION ENABLED or the NMT state OPERATIONAL (which silences
        its PDOs), or was restarted. PowerLost: its statusword says that there is no voltage any more.
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
        if self._beats and status.state is not NmtState.OPERATIONAL:
            self.active = False
            left = "an unknown NMT state" if status.state is None else status.state.name
            seen_at = status.heartbeat_at
            raise DriveInFault(f"{control.title} fell back to {left}", control.evidence(), seen_at=seen_at)
        if control.emergency_came:
            control.ask_after_emergency()
        if self._told.statusword & self._bits != self._wanted:
            self.active = False
            raise self._out_of_operation()
        if self._now() - self._told.at > self._silence_ns:
            self.active = False
            silence_ms = self._silence_ns / NS_PER_MS
            raise NoAnswer(
                f"{control.title}: the statusword has not been told for {silence_ms:.0f} ms",
                remedy="check the cable, and what else is on the bus",
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
            "look after the safety circuit and the supply of the power stage",
            seen_at,
        )


def _silence_borne(plan: PdoPlan, silence_ms: int) -> Duration:
    """Of a statusword that is told on change, and again by its event timer, ns.

    One that comes with the SYNC is missed with the readings.
    """
    status = plan.tpdo_with(Object.STATUSWORD)
    if status is None or status.synchronous or not status.event_timer_ms:
        return _UNWATCHED
    return Duration(max(silence_ms, 2 * status.event_timer_ms) * NS_PER_MS)

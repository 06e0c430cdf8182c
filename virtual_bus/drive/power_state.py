"""The CiA 402 state machine of a drive: commands, faults and rest in, state and what the motor does out.

The arrows are those of :data:`servobench.drivers.cia402.profile.TRANSITIONS`. Those that leave a turning
motor behind ask an option code how to stop it:

    arrow  from -> to                             option    while stopping the state is
    5      OPERATION_ENABLED -> SWITCHED_ON       605Ch     OPERATION_ENABLED
    8      OPERATION_ENABLED -> READY             605Bh     OPERATION_ENABLED
    11     OPERATION_ENABLED -> QUICK_STOP        605Ah     QUICK_STOP; then arrow 12, or stay (605Ah = 5..8)
    13     ... -> FAULT_REACTION                  605Eh     FAULT_REACTION; then arrow 14

Rules beside the arrows, CiA 402-2 clause 6:
- In READY the controlword of "enable operation" takes arrows 3 and 4 in one go.
- Arrow 16 is open only where 605Ah lets the drive stay in QUICK_STOP (5..8).
- Arrow 15 is taken on the rising edge of bit 7 only.
- A stop that waits to become arrow 5 or 8 is called off by "enable operation".
- Safe torque off takes arrow 7, 9, 10 or 12 at once and keeps arrow 2 closed.
- A drive that waits for its brake takes arrow 9 or 12 by the controlword only when the motor rests, if it
  turns slowly; a faster one coasts.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import (
    STATUS_PATTERNS,
    TRANSITION_OF,
    Control,
    DriveCommand,
    DriveEvent,
    QuickStopOption,
    State,
    Status,
    Transition,
    commands_in,
)

BASE_STATUS: dict[State, int] = {
    state: STATUS_PATTERNS[state].value | Status.VOLTAGE_ENABLED | Status.REMOTE for state in State
}
"""The statusword of a state, but for the bits of the mode."""
_FAULT_RESET: Final = int(Control.FAULT_RESET)


class MotorAction(Enum):
    """Action of the inner loops on the motor."""

    OFF = "off"
    """No torque; a turning shaft coasts."""
    FOLLOW = "follow"
    """The set-points of the mode of operation."""
    SLOW_DOWN_RAMP = "slow down ramp"
    QUICK_STOP_RAMP = "quick stop ramp"
    CURRENT_LIMIT = "current limit"
    """To rest with all the torque that the limits allow."""


STOP_OPTIONS: dict[int, Object] = {
    5: Object.DISABLE_OPERATION_OPTION,
    8: Object.SHUTDOWN_OPTION,
    11: Object.QUICK_STOP_OPTION,
    13: Object.FAULT_REACTION_OPTION,
}
"""Which option code says how to stop, by the number of the arrow."""

STOP_MOTIONS: dict[int, MotorAction] = {
    0: MotorAction.OFF,
    1: MotorAction.SLOW_DOWN_RAMP,
    2: MotorAction.QUICK_STOP_RAMP,
    3: MotorAction.CURRENT_LIMIT,
    # A drive that limits its current reaches the voltage limit no sooner: both stop alike.
    4: MotorAction.CURRENT_LIMIT,
    5: MotorAction.SLOW_DOWN_RAMP,
    6: MotorAction.QUICK_STOP_RAMP,
    7: MotorAction.CURRENT_LIMIT,
    8: MotorAction.CURRENT_LIMIT,
}
"""Option code -> how the motor stops. The codes of 605Ah; those of the others are among them."""

_ENABLES: Final = 4
"""Arrow to OPERATION_ENABLED."""
_AFTER_REST: Final = frozenset({5, 8})
"""Arrows that are taken only when the motor rests."""
_DISABLES: Final = frozenset({9, 12})
"""Arrows of "disable voltage" from a motor that has torque."""
_COMMAND_BITS: Final = 0x90


class PowerStateMachine:
    """State, and what the motor is to do. ``option`` reads an option code; no time and no I/O in here."""

    def __init__(
        self, option: Callable[[Object], int], holds_first: bool = False, slow: Callable[[], bool] = bool
    ) -> None:
        """``holds_first``: enabled, the motor is held at rest until :meth:`rested`, before it follows, and so
        it is before it is disabled while it is ``slow``."""
        self._option = option
        self._holds_first = holds_first
        self._slow = slow
        self.revision = 0
        """Counts every change of ``state``, ``motion`` or ``at_rest``."""
        self.torque_off = False
        """Safe torque off is requested: arrow 2 is closed, and :meth:`cut_torque` was called."""
        self.restart()

    def restart(self) -> None:
        """Power-on: NOT_READY, and at once on to SWITCH_ON_DISABLED (arrows 0 and 1)."""
        self.state = State.NOT_READY
        self.motion = MotorAction.OFF
        self.at_rest = False
        """The motor was brought to rest and is held there, in QUICK_STOP."""
        self._waiting: Transition | None = None
        self._controlword = 0
        self._open = _ARROWS[self.state]
        self.signal(DriveEvent.INITIALISED)

    @property
    def stopping(self) -> bool:
        """The motor is being brought to rest; :meth:`rested` is awaited."""
        motion = self.motion
        return motion is not MotorAction.OFF and motion is not MotorAction.FOLLOW and not self.at_rest

    @property
    def enabling(self) -> bool:
        """The motor is held at rest before it is allowed to follow."""
        return self._waiting is not None and self._waiting.number == _ENABLES

    @property
    def stays(self) -> bool:
        """At rest the motor goes on being held, in QUICK_STOP."""
        return self.state is State.QUICK_STOP and self._waiting is None and self._stays_in_quick_stop()

    def receive(self, controlword: int) -> None:
        """A controlword was written, a new one or the same again."""
        rising = controlword & ~self._controlword
        self._controlword = controlword
        if rising & _FAULT_RESET:
            self.command(DriveCommand.FAULT_RESET)
            return
        bits = controlword & 0x8F
        for arrow in self._open[bits]:
            if arrow.number in _DISABLES and self._holds_first and self._slow():
                self._hold_until(arrow)
            else:
                self._take(arrow)
        waits_to_leave = self._waiting is not None and self.state is State.OPERATION_ENABLED
        if waits_to_leave and DriveCommand.ENABLE_OPERATION in commands_in(bits):
            self._waiting, self.motion = None, MotorAction.FOLLOW
            self.revision += 1

    def command(self, command: DriveCommand) -> None:
        """A command from elsewhere than the controlword (6007h). Nothing happens where no arrow leaves."""
        arrow = TRANSITION_OF.get((self.state, command))
        if arrow is not None:
            self._take(arrow)

    def signal(self, event: DriveEvent) -> None:
        """Something happened in the drive. Nothing happens where no arrow leaves."""
        arrow = TRANSITION_OF.get((self.state, event))
        if arrow is not None:
            self._take(arrow)

    def cut_torque(self) -> None:
        """Safe torque off: no ramp any more. Arrows 7, 9, 10 and 12, or a fault reaction that is over."""
        if self.state is State.FAULT_REACTION:
            self.signal(DriveEvent.FAULT_REACTION_DONE)
        else:
            self.command(DriveCommand.DISABLE_VOLTAGE)

    def rested(self) -> None:
        """The motor that was being stopped has come to rest."""
        assert self.stopping, f"no stop under way in {self.state.value}"
        if self._waiting is not None:
            self._enter(self._waiting)
        elif self.state is State.FAULT_REACTION:
            self.signal(DriveEvent.FAULT_REACTION_DONE)
        elif self._stays_in_quick_stop():
            self.at_rest = True
            self.revision += 1
        else:
            self.signal(DriveEvent.QUICK_STOP_DONE)

    def _hold_until(self, arrow: Transition) -> None:
        """Take the arrow at rest."""
        if arrow is self._waiting:
            return
        self._waiting, self.at_rest = arrow, False
        if self.motion is MotorAction.FOLLOW:
            self.motion = MotorAction.QUICK_STOP_RAMP
        self.revision += 1

    def _take(self, arrow: Transition) -> None:
        if arrow is self._waiting:
            return
        if arrow.number == 16 and not self._stays_in_quick_stop():
            return
        if arrow.number == 2 and self.torque_off:
            return
        if arrow.number == _ENABLES and self._holds_first:
            self._waiting, self.motion = arrow, MotorAction.QUICK_STOP_RAMP
            self.revision += 1
            return
        was_moving = self.motion is not MotorAction.OFF
        stop = self._stop_for(arrow) if was_moving else MotorAction.OFF
        if arrow.number in _AFTER_REST and stop is not MotorAction.OFF:
            self._waiting, self.motion = arrow, stop
            self.revision += 1
            return
        self._enter(arrow, stop)
        if arrow.number in (11, 13) and stop is MotorAction.OFF:
            self.signal(DriveEvent.QUICK_STOP_DONE if arrow.number == 11 else DriveEvent.FAULT_REACTION_DONE)

    def _enter(self, arrow: Transition, motion: MotorAction = MotorAction.OFF) -> None:
        self._waiting = None
        self.at_rest = False
        self.state = arrow.target
        self._open = _ARROWS[self.state]
        self.motion = MotorAction.FOLLOW if self.state is State.OPERATION_ENABLED else motion
        self.revision += 1

    def _stop_for(self, arrow: Transition) -> MotorAction:
        option = STOP_OPTIONS.get(arrow.number)
        return MotorAction.OFF if option is None else STOP_MOTIONS[self._option(option)]

    def _stays_in_quick_stop(self) -> bool:
        return self._option(Object.QUICK_STOP_OPTION) >= QuickStopOption.SLOW_DOWN_RAMP_AND_STAY


def _arrows_for(state: State, bits: int) -> tuple[Transition, ...]:
    commands = commands_in(bits)
    if state is State.READY and DriveCommand.ENABLE_OPERATION in commands:
        return (
            TRANSITION_OF[State.READY, DriveCommand.SWITCH_ON],
            TRANSITION_OF[State.SWITCHED_ON, DriveCommand.ENABLE_OPERATION],
        )
    arrows = (TRANSITION_OF.get((state, command)) for command in commands)
    return tuple(arrow for arrow in arrows if arrow is not None)


_ARROWS: Final[dict[State, list[tuple[Transition, ...]]]] = {
    state: [_arrows_for(state, bits) for bits in range(_COMMAND_BITS)] for state in State
}
"""Arrows out of a state, by bits 0 to 3 and 7 of the controlword."""

"""CiA 402 vocabulary: the state machine and its words as tables, modes, option codes.

Shared by the drive client and by the simulated drive, so that both read one table.
Source: CiA 402-2 (operation modes and application data), also published as IEC 61800-7-201.
Object indices are in :mod:`servobench.drivers.cia402.objects402`, error codes in
:mod:`servobench.drivers.canopen.error_codes`.

    power on --0--> NOT_READY --1--> SWITCH_ON_DISABLED <--15-- FAULT <--14-- FAULT_REACTION <--13-- any
    SWITCH_ON_DISABLED --2--> READY --3--> SWITCHED_ON --4--> OPERATION_ENABLED --11--> QUICK_STOP
    back: 5 disable operation, 6 and 8 shutdown, 7, 9, 10 and 12 to SWITCH_ON_DISABLED, 16 enable again
"""

from collections import deque
from collections.abc import Callable, Collection
from enum import Enum, IntEnum
from typing import Final, NamedTuple

DRIVE_PROFILE: Final = 402
"""Low 16 bits of 1000h: the number of the device profile, CiA 402 (CiA 301, 7.5.2.1)."""


def no_drive(device_type: int, has_statusword: Callable[[], bool]) -> str:
    """Say why a device with this 1000h is not a drive; empty if it is one.

    0 means that no standardised profile is followed (CiA 301 7.5.2.1): the statusword decides then.
    """
    number = device_type & 0xFFFF
    if number == DRIVE_PROFILE or (number == 0 and has_statusword()):
        return ""
    return (
        f"1000h is {device_type:08X}h, whose low 16 bits say device profile {number} ({number:04X}h);"
        f" a drive's say {DRIVE_PROFILE} ({DRIVE_PROFILE:04X}h, CiA 402)"
    )


class State(Enum):
    """States of the power drive system, CiA 402-2 6.2 (finite state automaton)."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"

    # Members are single objects: identity is a sound hash, and far cheaper than Enum's own in a table lookup.
    __hash__ = object.__hash__


class BitPattern(NamedTuple):
    """A word matches if ``word & mask == value``."""

    mask: int
    value: int

    def matches(self, word: int) -> bool:
        return word & self.mask == self.value


class Status:
    """Bits of the statusword 0x6041."""

    READY_TO_SWITCH_ON = 1 << 0
    SWITCHED_ON = 1 << 1
    OPERATION_ENABLED = 1 << 2
    FAULT = 1 << 3
    VOLTAGE_ENABLED = 1 << 4
    QUICK_STOP = 1 << 5
    """0 while a quick stop is active."""
    SWITCH_ON_DISABLED = 1 << 6
    WARNING = 1 << 7
    MANUFACTURER = 1 << 8
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT_ACTIVE = 1 << 11
    MODE_12 = 1 << 12
    """In the cyclic synchronous modes: the drive follows the command value (CiA 402-2 13.2, 14.2, 15.2)."""
    MODE_13 = 1 << 13
    FOLLOWS_COMMAND = MODE_12


class Control:
    """Bits of the controlword 0x6040."""

    SWITCH_ON = 1 << 0
    ENABLE_VOLTAGE = 1 << 1
    QUICK_STOP = 1 << 2
    """0 commands a quick stop."""
    ENABLE_OPERATION = 1 << 3
    MODE_4 = 1 << 4
    MODE_5 = 1 << 5
    MODE_6 = 1 << 6
    FAULT_RESET = 1 << 7
    """Acts on the rising edge."""
    HALT = 1 << 8


NEW_SET_POINT: Final = Control.MODE_4
CHANGE_AT_ONCE: Final = Control.MODE_5
RELATIVE: Final = Control.MODE_6
"""Bits of the controlword in PP (CiA 402-2)."""

STATUS_PATTERNS: dict[State, BitPattern] = {
    State.NOT_READY: BitPattern(0x4F, 0x00),
    State.SWITCH_ON_DISABLED: BitPattern(0x4F, 0x40),
    State.READY: BitPattern(0x6F, 0x21),
    State.SWITCHED_ON: BitPattern(0x6F, 0x23),
    State.OPERATION_ENABLED: BitPattern(0x6F, 0x27),
    State.QUICK_STOP: BitPattern(0x6F, 0x07),
    State.FAULT_REACTION: BitPattern(0x4F, 0x0F),
    State.FAULT: BitPattern(0x4F, 0x08),
}
"""Statusword coding of the states, CiA 402-2 table "state coding"."""

STATE_BITS: Final = 0x6F
"""Mask of the statusword bits that name the state."""
_STATE_OF_BITS: tuple[State | None, ...] = tuple(
    next((state for state, pattern in STATUS_PATTERNS.items() if pattern.matches(bits)), None)
    for bits in range(STATE_BITS + 1)
)


def state_of(statusword: int) -> State | None:
    """Return the state coded in a statusword; None if its bits are no coding of the standard."""
    return _STATE_OF_BITS[statusword & STATE_BITS]


class DriveCommand(Enum):
    """Device control commands of the controlword, CiA 402-2 table "command coding"."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    DISABLE_OPERATION = "disable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"

    __hash__ = object.__hash__


COMMAND_PATTERNS: dict[DriveCommand, BitPattern] = {
    DriveCommand.SHUTDOWN: BitPattern(0x87, 0x06),
    DriveCommand.SWITCH_ON: BitPattern(0x8F, 0x07),
    DriveCommand.ENABLE_OPERATION: BitPattern(0x8F, 0x0F),
    DriveCommand.DISABLE_OPERATION: BitPattern(0x8F, 0x07),
    DriveCommand.DISABLE_VOLTAGE: BitPattern(0x82, 0x00),
    DriveCommand.QUICK_STOP: BitPattern(0x86, 0x02),
}
"""Controlword coding of the commands. Switch on and disable operation share a coding; the state tells them
apart. Fault reset is not a pattern but the rising edge of bit 7."""

CONTROLWORDS: dict[DriveCommand, int] = {
    **{command: pattern.value for command, pattern in COMMAND_PATTERNS.items()},
    DriveCommand.FAULT_RESET: Control.FAULT_RESET,
}
"""The word to send for a command, with every optional bit 0."""


class DriveEvent(Enum):
    """Events that move the state machine without a command."""

    POWER_ON = "power on"
    INITIALISED = "initialisation complete"
    FAULT_DETECTED = "fault detected"
    FAULT_REACTION_DONE = "fault reaction complete"
    QUICK_STOP_DONE = "quick stop complete"

    __hash__ = object.__hash__


class Transition(NamedTuple):
    """One arrow of the state machine; several causes share a number where the standard says so."""

    number: int
    source: State
    cause: DriveCommand | DriveEvent
    target: State


_POWERED: Final = (
    State.NOT_READY,
    State.SWITCH_ON_DISABLED,
    State.READY,
    State.SWITCHED_ON,
    State.OPERATION_ENABLED,
    State.QUICK_STOP,
)

TRANSITIONS: tuple[Transition, ...] = (
    Transition(1, State.NOT_READY, DriveEvent.INITIALISED, State.SWITCH_ON_DISABLED),
    Transition(2, State.SWITCH_ON_DISABLED, DriveCommand.SHUTDOWN, State.READY),
    Transition(3, State.READY, DriveCommand.SWITCH_ON, State.SWITCHED_ON),
    Transition(4, State.SWITCHED_ON, DriveCommand.ENABLE_OPERATION, State.OPERATION_ENABLED),
    Transition(5, State.OPERATION_ENABLED, DriveCommand.DISABLE_OPERATION, State.SWITCHED_ON),
    Transition(6, State.SWITCHED_ON, DriveCommand.SHUTDOWN, State.READY),
    Transition(7, State.READY, DriveCommand.DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    Transition(7, State.READY, DriveCommand.QUICK_STOP, State.SWITCH_ON_DISABLED),
    Transition(8, State.OPERATION_ENABLED, DriveCommand.SHUTDOWN, State.READY),
    Transition(9, State.OPERATION_ENABLED, DriveCommand.DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    Transition(10, State.SWITCHED_ON, DriveCommand.DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    Transition(10, State.SWITCHED_ON, DriveCommand.QUICK_STOP, State.SWITCH_ON_DISABLED),
    Transition(11, State.OPERATION_ENABLED, DriveCommand.QUICK_STOP, State.QUICK_STOP),
    Transition(12, State.QUICK_STOP, DriveCommand.DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    Transition(12, State.QUICK_STOP, DriveEvent.QUICK_STOP_DONE, State.SWITCH_ON_DISABLED),
    *(Transition(13, state, DriveEvent.FAULT_DETECTED, State.FAULT_REACTION) for state in _POWERED),
    Transition(14, State.FAULT_REACTION, DriveEvent.FAULT_REACTION_DONE, State.FAULT),
    Transition(15, State.FAULT, DriveCommand.FAULT_RESET, State.SWITCH_ON_DISABLED),
    Transition(16, State.QUICK_STOP, DriveCommand.ENABLE_OPERATION, State.OPERATION_ENABLED),
)
"""Every arrow between two states. Transition 0, power on, leads into NOT_READY from nowhere."""

TRANSITION_OF: dict[tuple[State, DriveCommand | DriveEvent], Transition] = {
    (arrow.source, arrow.cause): arrow for arrow in TRANSITIONS
}


def commands_in(controlword: int) -> tuple[DriveCommand, ...]:
    """Return the commands coded in a controlword, except fault reset; two for switch on = disable
    operation."""
    return _COMMANDS_OF_BITS[controlword & 0x8F]


_COMMANDS_OF_BITS: tuple[tuple[DriveCommand, ...], ...] = tuple(
    tuple(command for command, pattern in COMMAND_PATTERNS.items() if pattern.matches(bits))
    for bits in range(0x90)
)


def command_path(source: State, target: State) -> tuple[DriveCommand, ...] | None:
    """Return the shortest chain of commands from ``source`` to ``target``; None if commands alone do not lead
    there.

    A fault is never reset on the way: leaving FAULT is a separate decision, so there is no path from FAULT.
    """
    paths: dict[State, tuple[DriveCommand, ...]] = {source: ()}
    frontier = deque([source])
    while frontier and target not in paths:
        here = frontier.popleft()
        for arrow in TRANSITIONS:
            if arrow.source is not here or arrow.target in paths or not isinstance(arrow.cause, DriveCommand):
                continue
            if arrow.cause is not DriveCommand.FAULT_RESET:
                paths[arrow.target] = (*paths[here], arrow.cause)
                frontier.append(arrow.target)
    return paths.get(target)


class Mode(IntEnum):
    """Modes of operation, 0x6060 and 0x6061."""

    NONE = 0
    PROFILE_POSITION = 1
    VELOCITY = 2
    PROFILE_VELOCITY = 3
    PROFILE_TORQUE = 4
    HOMING = 6
    INTERPOLATED_POSITION = 7
    CYCLIC_SYNCHRONOUS_POSITION = 8
    CYCLIC_SYNCHRONOUS_VELOCITY = 9
    CYCLIC_SYNCHRONOUS_TORQUE = 10
    CYCLIC_SYNCHRONOUS_TORQUE_WITH_ANGLE = 11

    @property
    def title(self) -> str:
        """The mode in words: ``cyclic synchronous torque``."""
        return self.name.lower().replace("_", " ")


def supported_mode_bit(mode: Mode) -> int:
    """Return the bit of 0x6502 for ``mode``; 0 for NONE, which has no bit."""
    return 1 << (mode - 1) if mode > 0 else 0


FOLLOW_BITS: Final = {
    Mode.VELOCITY: Control.MODE_4 | Control.MODE_5 | Control.MODE_6,
    Mode.INTERPOLATED_POSITION: Control.MODE_4,
}
"""Controlword bits without which a mode does not follow its set-point: enable ramp, unlock ramp and reference
ramp; enable interpolation. The cyclic synchronous and the other profile modes need none."""

STANDARD_MODES: Final = 0x3FF
"""Bits of 6502h for the modes of CiA 402-2; the others are reserved, or the maker's."""


def tells_modes(word: int | None) -> bool:
    """Return True if 6502h names a mode of CiA 402-2: many drives lack it or hold 0, and have the modes."""
    return bool((word or 0) & STANDARD_MODES)


def offers_mode(word: int | None, mode: Mode) -> bool:
    """Return True if 6502h names the mode."""
    return bool((word or 0) & supported_mode_bit(mode))


BENCH_MODES: Final = {
    "cst": Mode.CYCLIC_SYNCHRONOUS_TORQUE,
    "csv": Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    "csp": Mode.CYCLIC_SYNCHRONOUS_POSITION,
    "ip": Mode.INTERPOLATED_POSITION,
    "vl": Mode.VELOCITY,
}
"""The modes in which a bench runs a drive, by ``drive.NAME.mode`` of a bench file."""

BENCH_RULE: Final = (
    '`hil run` needs cyclic synchronous torque (`mode = "cst"`), velocity (`"csv"`) or position (`"csp"`), '
    'interpolated position (`"ip"`) or velocity mode (`"vl"`); a drive with none of them can be '
    "commissioned, not run"
)
"""One wording for every command and for docs/limits.md."""


def run_words(modes: Collection[Mode]) -> str:
    """Say how `hil run` can use a drive that has ``modes``."""
    usable = [f'"{key}"' for key, mode in BENCH_MODES.items() if mode in modes]
    if not usable:
        return BENCH_RULE
    return f"`hil run` can use it with mode = {' or '.join(usable)}"


class AbortConnectionOption(IntEnum):
    """0x6007: reaction to a lost connection to the master; default FAULT_SIGNAL."""

    NO_ACTION = 0
    FAULT_SIGNAL = 1
    DISABLE_VOLTAGE = 2
    QUICK_STOP = 3


class QuickStopOption(IntEnum):
    """0x605A: how to stop on a quick stop, and whether to stay in QUICK_STOP; default QUICK_STOP_RAMP."""

    DISABLE = 0
    SLOW_DOWN_RAMP = 1
    QUICK_STOP_RAMP = 2
    CURRENT_LIMIT = 3
    VOLTAGE_LIMIT = 4
    SLOW_DOWN_RAMP_AND_STAY = 5
    QUICK_STOP_RAMP_AND_STAY = 6
    CURRENT_LIMIT_AND_STAY = 7
    VOLTAGE_LIMIT_AND_STAY = 8


class ShutdownOption(IntEnum):
    """0x605B: how to stop on transition 8; default DISABLE."""

    DISABLE = 0
    SLOW_DOWN_RAMP = 1


class DisableOperationOption(IntEnum):
    """0x605C: how to stop on transition 5; default SLOW_DOWN_RAMP."""

    DISABLE = 0
    SLOW_DOWN_RAMP = 1


class HaltOption(IntEnum):
    """0x605D: how to stop on a halt; default SLOW_DOWN_RAMP."""

    SLOW_DOWN_RAMP = 1
    QUICK_STOP_RAMP = 2
    CURRENT_LIMIT = 3
    VOLTAGE_LIMIT = 4


class FaultReactionOption(IntEnum):
    """0x605E: how to stop on a fault that leaves the drive able to; default QUICK_STOP_RAMP."""

    DISABLE = 0
    SLOW_DOWN_RAMP = 1
    QUICK_STOP_RAMP = 2
    CURRENT_LIMIT = 3
    VOLTAGE_LIMIT = 4

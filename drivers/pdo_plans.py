"""The PDO plans that the bench gives to drives, by mode of operation."""

from drivers.objects402 import Object
from drivers.pdo import (
    EVENT_DRIVEN,
    EVERY_SYNC,
    HIGH_RESOLUTION_TIME_STAMP,
    SYNCHRONOUS_MAX,
    PdoDirection,
    PdoEntry,
    PdoMap,
    PdoPlan,
)
from drivers.profile402 import Mode

_CONTROLWORD = PdoEntry(Object.CONTROLWORD, 0, "H")
_TORQUE = PdoEntry(Object.TARGET_TORQUE, 0, "h")
_POSITION = PdoEntry(Object.TARGET_POSITION, 0, "i")
_VELOCITY = PdoEntry(Object.TARGET_VELOCITY, 0, "i")

TARGETS: dict[Mode, PdoEntry] = {
    Mode.PROFILE_POSITION: _POSITION,
    Mode.PROFILE_VELOCITY: _VELOCITY,
    Mode.PROFILE_TORQUE: _TORQUE,
    Mode.CYCLIC_SYNCHRONOUS_POSITION: _POSITION,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: _VELOCITY,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE: _TORQUE,
}
"""The set-point of a mode; homing has none."""


def mode_plan(
    node_id: int,
    mode: Mode,
    *,
    device_stamp: bool,
    synchronous_command: bool = False,
    position_every_cycles: int = 1,
) -> PdoPlan:
    """The plan for one mode.

    TPDO1: statusword, velocity, torque. TPDO2: position and, with ``device_stamp``, the drive's own stamp
    0x1013. RPDO1: controlword and the set-point of the mode, applied on arrival or, if
    ``synchronous_command``, at the next SYNC.

    With ``position_every_cycles`` above 1 the TPDO2 holds the position alone and comes with every so many
    SYNCs, which leaves room for three drives at 1 kHz on 1 Mbit/s; the stamp is of no use without a reading
    of its own, so it is not mapped.
    """
    target = TARGETS.get(mode)
    command = (_CONTROLWORD,) if target is None else (_CONTROLWORD, target)
    tpdos = _actual_values(node_id, device_stamp, position_every_cycles)
    return PdoPlan(tpdos, _commands(node_id, (command,), synchronous_command))


def torque_plan(
    node_id: int, *, device_stamp: bool, synchronous_command: bool = False, position_every_cycles: int = 1
) -> PdoPlan:
    """:func:`mode_plan` for cyclic synchronous torque."""
    return mode_plan(
        node_id,
        Mode.CYCLIC_SYNCHRONOUS_TORQUE,
        device_stamp=device_stamp,
        synchronous_command=synchronous_command,
        position_every_cycles=position_every_cycles,
    )


def all_modes_plan(node_id: int, *, device_stamp: bool, synchronous_command: bool = False) -> PdoPlan:
    """The plan for a drive that changes between the cyclic modes: an RPDO for each set-point.

    Each carries the controlword as well, so one frame a cycle does in every mode.
    """
    commands = tuple((_CONTROLWORD, target) for target in (_TORQUE, _POSITION, _VELOCITY))
    return PdoPlan(
        _actual_values(node_id, device_stamp, 1), _commands(node_id, commands, synchronous_command)
    )


def _actual_values(node_id: int, device_stamp: bool, position_every_cycles: int) -> tuple[PdoMap, ...]:
    if not 1 <= position_every_cycles <= SYNCHRONOUS_MAX:
        raise ValueError(f"position_every_cycles {position_every_cycles} is not in 1..{SYNCHRONOUS_MAX}")
    actual = (
        PdoEntry(Object.STATUSWORD, 0, "H"),
        PdoEntry(Object.VELOCITY_ACTUAL_VALUE, 0, "i"),
        PdoEntry(Object.TORQUE_ACTUAL_VALUE, 0, "h"),
    )
    position: tuple[PdoEntry, ...] = (PdoEntry(Object.POSITION_ACTUAL_VALUE, 0, "i"),)
    if device_stamp and position_every_cycles == 1:
        position += (PdoEntry(HIGH_RESOLUTION_TIME_STAMP, 0, "I"),)
    transmit = PdoDirection.TRANSMIT
    return (
        PdoMap(transmit, 1, transmit.default_cob_id(1, node_id), actual),
        PdoMap(transmit, 2, transmit.default_cob_id(2, node_id), position, position_every_cycles),
    )


def _commands(
    node_id: int, commands: tuple[tuple[PdoEntry, ...], ...], synchronous: bool
) -> tuple[PdoMap, ...]:
    receive = PdoDirection.RECEIVE
    kind = EVERY_SYNC if synchronous else EVENT_DRIVEN
    return tuple(
        PdoMap(receive, number, receive.default_cob_id(number, node_id), entries, kind)
        for number, entries in enumerate(commands, start=1)
    )

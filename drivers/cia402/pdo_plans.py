"""The PDO plans that the bench gives to drives, by mode of operation."""

from drivers.canopen.pdo import (
    EVENT_DRIVEN,
    EVERY_SYNC,
    HIGH_RESOLUTION_TIME_STAMP,
    PdoDirection,
    PdoEntry,
    PdoMap,
    PdoPlan,
)
from drivers.canopen.pdo_capability import Key
from drivers.cia402.objects402 import Object
from drivers.cia402.pdo_layouts import (
    ALL,
    DEMAND,
    POSITION,
    STAMP,
    STATUS,
    STATUS_TIMER_MS,
    TORQUE,
    VELOCITY,
    Features,
    choices,
    layout,
)
from drivers.cia402.profile import Mode

_CONTROLWORD = PdoEntry(Object.CONTROLWORD, 0, "H")
_TORQUE = PdoEntry(Object.TARGET_TORQUE, 0, "h")
_POSITION = PdoEntry(Object.TARGET_POSITION, 0, "i")
_VELOCITY = PdoEntry(Object.TARGET_VELOCITY, 0, "i")
_CODES: dict[Key, str] = {STATUS: "H", VELOCITY: "i", TORQUE: "h", POSITION: "i", DEMAND: "h", STAMP: "I"}
"""Types of CiA 402-2 and CiA 301."""

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
    demand: bool = True,
    status_on_change: bool = True,
    synchronous_command: bool = False,
    position_every_cycles: int = 1,
    status_timer_ms: int = STATUS_TIMER_MS,
    coherent: bool = False,
    demand_changes: bool = False,
) -> PdoPlan:
    """The plan for one mode, for a drive that can map what is asked for.

    TPDO1: velocity and, with ``device_stamp``, the drive's own stamp 1013h. TPDO2: torque, position and,
    with ``demand`` in a torque mode, the torque demand 6074h; with every ``position_every_cycles``-th SYNC,
    above 1 so that three drives at 1 kHz fit 1 Mbit/s. TPDO3: the statusword on change, and every
    ``status_timer_ms``. RPDO1: controlword and the set-point of the mode, applied on arrival or, if
    ``synchronous_command``, at the next SYNC.

    ``status_on_change``: see :mod:`drivers.cia402.pdo_layouts`, which also says what ``coherent`` is.
    ``demand_changes``: a TPDO4 with 6074h and 1013h, sent whenever they change: when a command began to act.
    """
    target = TARGETS.get(mode)
    command = (_CONTROLWORD,) if target is None else (_CONTROLWORD, target)
    able = Features(device_stamp, demand and target is _TORQUE, status_on_change)
    tpdos = _actual_values(node_id, able, position_every_cycles, status_timer_ms, coherent)
    if demand_changes:
        tpdos = (*tpdos, _demand_changes(node_id))
    return PdoPlan(tpdos, _commands(node_id, (command,), synchronous_command))


def torque_plan(
    node_id: int,
    *,
    device_stamp: bool,
    synchronous_command: bool = False,
    position_every_cycles: int = 1,
    demand_changes: bool = False,
) -> PdoPlan:
    """:func:`mode_plan` for cyclic synchronous torque."""
    return mode_plan(
        node_id,
        Mode.CYCLIC_SYNCHRONOUS_TORQUE,
        device_stamp=device_stamp,
        synchronous_command=synchronous_command,
        position_every_cycles=position_every_cycles,
        demand_changes=demand_changes,
    )


def all_modes_plan(node_id: int, *, device_stamp: bool, synchronous_command: bool = False) -> PdoPlan:
    """The plan for a drive that changes between the cyclic modes: an RPDO for each set-point.

    Each carries the controlword as well, so one frame a cycle does in every mode.
    """
    commands = tuple((_CONTROLWORD, target) for target in (_TORQUE, _POSITION, _VELOCITY))
    tpdos = _actual_values(node_id, ALL._replace(stamp=device_stamp), 1, STATUS_TIMER_MS, coherent=False)
    return PdoPlan(tpdos, _commands(node_id, commands, synchronous_command))


def _actual_values(
    node_id: int, able: Features, position_every_cycles: int, timer_ms: int, coherent: bool
) -> tuple[PdoMap, ...]:
    features = choices(able, position_every_cycles)[0]
    groups = layout(features, TORQUE, position_every_cycles, timer_ms, coherent=coherent)
    transmit = PdoDirection.TRANSMIT
    return tuple(
        PdoMap(
            transmit,
            number,
            transmit.default_cob_id(number, node_id),
            tuple(PdoEntry(*key, _CODES[key]) for key in group.keys),
            group.transmission_type,
            group.inhibit_time_100us,
            group.event_timer_ms,
        )
        for number, group in enumerate(groups, start=1)
    )


def _demand_changes(node_id: int) -> PdoMap:
    transmit = PdoDirection.TRANSMIT
    entries = (PdoEntry(*DEMAND, "h"), PdoEntry(HIGH_RESOLUTION_TIME_STAMP, 0, "I"))
    return PdoMap(transmit, 4, transmit.default_cob_id(4, node_id), entries, EVENT_DRIVEN)


def _commands(
    node_id: int, commands: tuple[tuple[PdoEntry, ...], ...], synchronous: bool
) -> tuple[PdoMap, ...]:
    receive = PdoDirection.RECEIVE
    kind = EVERY_SYNC if synchronous else EVENT_DRIVEN
    return tuple(
        PdoMap(receive, number, receive.default_cob_id(number, node_id), entries, kind)
        for number, entries in enumerate(commands, start=1)
    )

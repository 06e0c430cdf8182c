"""The PDO plans that the bench gives to drives: which actual values travel together, and how often.

The speed travels with the drive's stamp of that very sample, first on the bus and with every SYNC; torque,
position and the torque demand follow, less often if the bus is full; the statusword is told when it changes.
The layouts of the TPDOs, the best first:

                                                606Ch 1013h    6077h 6064h 6074h    6041h
    all that the bench can use                  every SYNC     every n-th SYNC      on change
    6041h not on change, n = 1                  every SYNC     every SYNC, with 6041h in place of 6074h
    6041h not on change, no stamp or n > 1      every SYNC, with 6041h in place of 1013h, the rest as above
    coherent                                    every SYNC, behind 6041h 6077h 6064h with every SYNC
"""

from typing import Final, NamedTuple

from drivers.canopen.objects301 import Cia301
from drivers.canopen.pdo import (
    EVENT_DRIVEN,
    EVERY_SYNC,
    SYNCHRONOUS_MAX,
    Key,
    PdoDirection,
    PdoEntry,
    PdoMap,
    PdoPlan,
)
from drivers.cia402.objects402 import Object
from drivers.cia402.profile import Mode

STATUS: Final[Key] = (Object.STATUSWORD, 0)
VELOCITY: Final[Key] = (Object.VELOCITY_ACTUAL_VALUE, 0)
TORQUE: Final[Key] = (Object.TORQUE_ACTUAL_VALUE, 0)
CURRENT: Final[Key] = (Object.CURRENT_ACTUAL_VALUE, 0)
POSITION: Final[Key] = (Object.POSITION_ACTUAL_VALUE, 0)
DEMAND: Final[Key] = (Object.TORQUE_DEMAND, 0)
STAMP: Final[Key] = (Cia301.HIGH_RESOLUTION_TIME_STAMP, 0)

STATUS_INHIBIT_100US: Final = 10
"""1 ms: a bit of the statusword that chatters costs no more than a statusword in every cycle would."""
STATUS_TIMER_MS: Final = 25
"""With a heartbeat that may be missed for 150 ms; see :func:`status_timer_ms`."""
_TELLINGS: Final = 6
"""Tellings of the statusword in the time after which a lost heartbeat is noticed: on a bus that loses every
tenth frame, six in a row are lost once in a million."""


class Features(NamedTuple):
    """What a drive tells beyond speed, torque, position and statusword."""

    stamp: bool = True
    """1013h in the frame of the speed."""
    demand: bool = True
    """6074h in the frame of the position."""
    status_on_change: bool = True
    """6041h when it changes; else with every SYNC."""

    def within(self, other: "Features") -> bool:
        """Nothing is used that ``other`` has not."""
        return all(there or not used for used, there in zip(self, other, strict=True))


ALL: Final = Features()
_PREFERENCE: Final = (
    ALL,
    Features(demand=False),
    Features(demand=False, status_on_change=False),
    Features(stamp=False),
    Features(stamp=False, demand=False),
    Features(stamp=False, status_on_change=False),
    Features(stamp=False, demand=False, status_on_change=False),
)
"""The stamp is worth most: by it readings are attributed whatever the bus does to them."""


class Group(NamedTuple):
    """Objects that travel together."""

    keys: tuple[Key, ...]
    transmission_type: int
    inhibit_time_100us: int = 0
    event_timer_ms: int = 0


def choices(able: Features, position_every_cycles: int) -> list[Features]:
    """What can be used of what a drive is able to do, the best first.

    A statusword with every SYNC has its place beside the position only if that comes with every SYNC too.
    """
    return [
        each
        for each in _PREFERENCE
        if each.within(able) and (each.status_on_change or not each.stamp or position_every_cycles == 1)
    ]


def layout(
    features: Features,
    torque: Key | None,
    position_every_cycles: int,
    timer_ms: int,
    *,
    coherent: bool = False,
) -> tuple[Group, ...]:
    """What travels together, first the frame that is to have the lowest identifier.

    ``torque``: what stands for the torque, if anything does. ``timer_ms``: how often the statusword is told
    without a change. ``coherent``: torque, position and statusword are of the same SYNC as the speed, which
    comes last. Raises ValueError for a ``position_every_cycles`` that is no transmission type.
    """
    if not 1 <= position_every_cycles <= SYNCHRONOUS_MAX:
        raise ValueError(f"position_every_cycles {position_every_cycles} is not in 1..{SYNCHRONOUS_MAX}")
    speed = (VELOCITY, STAMP) if features.stamp else (VELOCITY,)
    actual = (POSITION,) if torque is None else (torque, POSITION)
    if coherent:
        return Group((STATUS, *actual), EVERY_SYNC), Group(speed, EVERY_SYNC)
    if not features.status_on_change and features.stamp:
        return Group(speed, EVERY_SYNC), Group((*actual, STATUS), EVERY_SYNC)
    if features.demand:
        actual = (*actual, DEMAND)
    if not features.status_on_change:
        return Group((VELOCITY, STATUS), EVERY_SYNC), Group(actual, position_every_cycles)
    return (
        Group(speed, EVERY_SYNC),
        Group(actual, position_every_cycles),
        Group((STATUS,), EVENT_DRIVEN, STATUS_INHIBIT_100US, timer_ms),
    )


def status_timer_ms(heartbeat_timeout_ms: int) -> int:
    """How often the statusword is told without a change: its silence is to be noticed as fast as a lost
    heartbeat, and a few lost frames are not to be taken for silence."""
    return max(1, heartbeat_timeout_ms // _TELLINGS)


def limits_of(features: Features, *, torque_mode: bool) -> list[str]:
    """What is lost where a feature is not used, in words."""
    limits = []
    if not features.stamp:
        limits.append("no 1013h beside 606Ch: readings are attributed to SYNCs by their order")
    if not features.demand and torque_mode:
        limits.append("no 6074h beside the position: which command acts is not measured")
    if not features.status_on_change:
        limits.append("6041h is not told on change: it is told with the SYNC")
    return limits


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
NEEDED_OBJECTS: Final[dict[Mode, int]] = {
    **{mode: target.index for mode, target in TARGETS.items()},
    Mode.HOMING: Object.HOMING_METHOD,
}
"""What a drive cannot have a mode without: the object of its set-point, or of the method of homing."""


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

    ``status_on_change``: see :mod:`drivers.cia402.pdo_plans`, which also says what ``coherent`` is.
    ``demand_changes``: a TPDO4 with 6074h and 1013h, sent whenever they change: when a command began to act.
    """
    target = TARGETS.get(mode)
    command = (_CONTROLWORD,) if target is None else (_CONTROLWORD, target)
    able = Features(device_stamp, demand and target is _TORQUE, status_on_change)
    tpdos = _actual_values(node_id, able, position_every_cycles, status_timer_ms, coherent)
    if demand_changes:
        tpdos = (*tpdos, _demand_changes(node_id))
    return PdoPlan(tpdos, _commands(node_id, (command,), synchronous_command))


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
    entries = (PdoEntry(*DEMAND, "h"), PdoEntry(Cia301.HIGH_RESOLUTION_TIME_STAMP, 0, "I"))
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

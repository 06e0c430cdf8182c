"""The PDO plans that the bench offers to drives: which actual values travel together, and how often.

The speed travels with the drive's stamp of that very sample, first on the bus and with every SYNC; torque,
position and the torque demand follow, less often if the bus is full; statusword and mode are told when they
change. The layouts of the TPDOs, the best first:

                                                606Ch 1013h    6077h 6064h 6074h    6041h 6061h
    all that the bench can use                  every SYNC     every n-th SYNC      on change
    6041h not on change, n = 1                  every SYNC     every SYNC, with 6041h in place of 6074h
    6041h not on change, no stamp or n > 1      every SYNC, with 6041h in place of 1013h, the rest as above
    coherent                                    every SYNC, behind 6041h 6077h 6064h with every SYNC
    counted                                     every SYNC, with 6064h in place of 1013h, the rest as above

With every SYNC 6061h travels beside 6041h if 8 bits are free there. In the coherent layout it has a TPDO of
its own else, on change, if the drive has one left.
"""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from servobench.drivers.canopen.objects301 import PDO_ENTRIES_MAX, Cia301
from servobench.drivers.canopen.pdo import (
    EVENT_DRIVEN,
    EVERY_SYNC,
    SYNCHRONOUS_MAX,
    Key,
    PdoDirection,
    PdoEntry,
    PdoPlan,
)
from servobench.drivers.canopen.pdo_capability import PdoCapability, PdoSlot, objects_of
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode

STATUS: Final[Key] = (Object.STATUSWORD, 0)
VELOCITY: Final[Key] = (Object.VELOCITY_ACTUAL_VALUE, 0)
TORQUE: Final[Key] = (Object.TORQUE_ACTUAL_VALUE, 0)
CURRENT: Final[Key] = (Object.CURRENT_ACTUAL_VALUE, 0)
POSITION: Final[Key] = (Object.POSITION_ACTUAL_VALUE, 0)
DEMAND: Final[Key] = (Object.TORQUE_DEMAND, 0)
CONTROL: Final[Key] = (Object.CONTROLWORD, 0)
MODE: Final[Key] = (Object.MODES_OF_OPERATION_DISPLAY, 0)
STAMP: Final[Key] = (Cia301.HIGH_RESOLUTION_TIME_STAMP, 0)

STATUS_INHIBIT_100US: Final = 10
"""1 ms: a bit of the statusword that chatters costs no more than a statusword in every cycle would."""
STATUS_TIMER_MS: Final = 25
"""Suits a heartbeat that may be missed for 150 ms; see :func:`status_timer_ms`."""
_TELLINGS: Final = 6
"""Statuswords within the time after which a lost heartbeat is noticed: on a bus that loses every tenth frame,
six in a row are lost once in a million."""


class Features(NamedTuple):
    """Optional data from a drive, beyond speed, torque, position and statusword."""

    stamp: bool = True
    """1013h, or its maker's equivalent, in the frame of the speed."""
    demand: bool = True
    """6074h in the frame of the position."""
    status_on_change: bool = True
    """6041h on change; else with every SYNC."""
    mode: bool = True
    """6061h: shows that the drive is still in the mode of its commands."""
    counted: bool = False
    """6064h in the frame of the speed, which leaves no room for a stamp."""

    def within(self, other: "Features") -> bool:
        """Return True if ``other`` has all features used here."""
        return all(there or not used for used, there in zip(self, other, strict=True))


ALL: Final = Features()
_COUNTED: Final = Features(stamp=False, counted=True)
_PREFERENCE: Final = (
    _COUNTED,
    _COUNTED._replace(demand=False),
    _COUNTED._replace(demand=False, status_on_change=False),
    ALL,
    Features(demand=False),
    Features(demand=False, status_on_change=False),
    Features(stamp=False),
    Features(stamp=False, demand=False),
    Features(stamp=False, status_on_change=False),
    Features(stamp=False, demand=False, status_on_change=False),
)
"""Order of preference. The count is offered where it is asked for. Else the stamp is worth most: it
attributes readings whatever the bus does to them. The mode is worth least, because it can be read by SDO."""


class Group(NamedTuple):
    """Objects that travel together."""

    keys: tuple[Key, ...]
    transmission_type: int
    inhibit_time_100us: int = 0
    event_timer_ms: int = 0


def choices(able: Features, position_every_cycles: int) -> list[Features]:
    """Return the usable subsets of a drive's features, the best first.

    A statusword with every SYNC fits beside the position only if that comes with every SYNC too.
    """
    return [
        each._replace(mode=mode)
        for each in _PREFERENCE
        for mode in ((True, False) if able.mode else (False,))
        if each._replace(mode=mode).within(able)
        and (each.status_on_change or not (each.stamp or each.counted) or position_every_cycles == 1)
    ]


def layout(
    features: Features, torque: Key | None, wish: "PlanWish", *, coherent: bool = False
) -> tuple[Group, ...]:
    """Group the objects into frames, the one for the lowest identifier first.

    ``torque``: the object used as torque, if any. ``coherent``: torque, position and statusword are of the
    same SYNC as the speed, which comes last. Raises ValueError for a ``position_every_cycles`` that is no
    transmission type.
    """
    position_every_cycles, timer_ms = wish.position_every_cycles, wish.status_timer_ms
    if not 1 <= position_every_cycles <= SYNCHRONOUS_MAX:
        raise ValueError(f"position_every_cycles {position_every_cycles} is not in 1..{SYNCHRONOUS_MAX}")
    speed = (VELOCITY, wish.stamp) if features.stamp else (VELOCITY,)
    actual = () if torque is None else (torque,)
    mode = (MODE,) if features.mode else ()
    room = mode  # beside 6041h and one of 6077h and 6064h
    if features.counted:
        speed = (VELOCITY, POSITION)
    else:
        actual = (*actual, POSITION)
        room = mode if torque is None else ()
    if coherent:
        groups = Group((STATUS, *actual, *room), EVERY_SYNC), Group(speed, EVERY_SYNC)
        if room or not (mode and wish.mode_apart and features.status_on_change):
            return groups
        return (*groups, Group(mode, EVENT_DRIVEN, STATUS_INHIBIT_100US, timer_ms))
    if not features.status_on_change and (features.stamp or features.counted):
        return Group(speed, EVERY_SYNC), Group((*actual, STATUS, *room), EVERY_SYNC)
    if features.demand:
        actual = (*actual, DEMAND)
    if not features.status_on_change:
        return Group((VELOCITY, STATUS, *mode), EVERY_SYNC), Group(actual, position_every_cycles)
    status = Group((STATUS, *mode), EVENT_DRIVEN, STATUS_INHIBIT_100US, timer_ms)
    others = (Group(actual, position_every_cycles),) if actual else ()
    return (Group(speed, EVERY_SYNC), *others, status)


def status_timer_ms(heartbeat_timeout_ms: int) -> int:
    """Return the repeat time of an unchanged statusword: its silence must be noticed as fast as a lost
    heartbeat, and a few lost frames must not count as silence."""
    return max(1, heartbeat_timeout_ms // _TELLINGS)


def limits_of(features: Features, wish: "PlanWish") -> list[str]:
    """Say what is lost by the features not used."""
    limits = []
    if not features.stamp:
        limits.append(
            f"no {wish.stamp[0]:04X}h beside 606Ch: readings are attributed to SYNCs by their order"
        )
    if not features.demand and wish.torque_mode and not wish.coherent:
        limits.append("no 6074h beside the position: which command acts is not measured")
    if not features.status_on_change:
        limits.append("6041h is not told on change: it is told with the SYNC")
    if not features.mode:
        limits.append("no 6061h in a TPDO: the mode is asked for by SDO")
    return limits


_TORQUE = PdoEntry(Object.TARGET_TORQUE, 0, "h")
_POSITION = PdoEntry(Object.TARGET_POSITION, 0, "i")
_VELOCITY = PdoEntry(Object.TARGET_VELOCITY, 0, "i")
TARGETS: dict[Mode, PdoEntry] = {
    Mode.PROFILE_POSITION: _POSITION,
    Mode.VELOCITY: PdoEntry(Object.VL_TARGET_VELOCITY, 0, "h"),
    Mode.PROFILE_VELOCITY: _VELOCITY,
    Mode.PROFILE_TORQUE: _TORQUE,
    Mode.INTERPOLATED_POSITION: PdoEntry(Object.INTERPOLATION_DATA_RECORD, 1, "i"),
    Mode.CYCLIC_SYNCHRONOUS_POSITION: _POSITION,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: _VELOCITY,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE: _TORQUE,
}
"""The set-point of a mode; homing has none."""
NEEDED_OBJECTS: Final[dict[Mode, int]] = {
    **{mode: target.index for mode, target in TARGETS.items()},
    Mode.HOMING: Object.HOMING_METHOD,
}
"""Objects essential to a mode: the set-point, or the homing method."""

STANDARD_CODES: dict[Key, str] = {
    **dict.fromkeys((STATUS, CONTROL), "H"),
    **dict.fromkeys((VELOCITY, POSITION), "i"),
    **dict.fromkeys((TORQUE, DEMAND), "h"),
    STAMP: "I",
    MODE: "b",
    **{(target.index, target.sub): target.code for target in TARGETS.values()},
}
"""Types of CiA 402-2 and CiA 301."""
STANDARD = PdoCapability(
    tuple(
        PdoSlot(
            *(direction, number, None, True, None, True, (), True, PDO_ENTRIES_MAX),
            inhibit_writable=True,
            event_timer_writable=True,
        )
        for direction in PdoDirection
        for number in range(1, 5)
    ),
    objects_of(STANDARD_CODES),
)
"""The PDO capability assumed for a drive without a dictionary."""


def standard(stamp: Key) -> PdoCapability:
    """Return :data:`STANDARD` for a drive whose stamp is that object."""
    if stamp == STAMP:
        return STANDARD
    return replace(STANDARD, objects={**STANDARD.objects, **objects_of({stamp: STANDARD_CODES[STAMP]})})


@dataclass(frozen=True, slots=True)
class PlanWish:
    """The loop's requirements on a drive."""

    mode: Mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE
    synchronous_command: bool = False
    """The drive applies the set-point at the next SYNC, not on arrival."""
    position_every_cycles: int = 1
    """Above 1 the position comes only with every n-th SYNC."""
    features: Features = ALL
    """The features that may be used."""
    status_timer_ms: int = STATUS_TIMER_MS
    coherent: bool = False
    """True: a reading holds values of one SYNC only; see :func:`layout`."""
    stamp: Key = STAMP
    """The object that holds the drive's stamp."""
    mode_apart: bool = True
    """True: 6061h may have its own TPDO."""

    @property
    def torque_mode(self) -> bool:
        """The set-point is a torque."""
        target = TARGETS.get(self.mode)
        return target is not None and target.index == Object.TARGET_TORQUE


def features_of(plan: PdoPlan, stamp: Key = STAMP) -> Features:
    """Return the features that a plan uses; ``stamp``: the object that holds the drive's stamp."""
    speed, status = plan.tpdo_with(*VELOCITY), plan.tpdo_with(*STATUS)
    return Features(
        stamp=speed is not None and speed.place_of(*stamp) is not None,
        demand=any(pdo.synchronous and pdo.place_of(*DEMAND) is not None for pdo in plan.tpdos),
        status_on_change=status is not None and not status.synchronous,
        mode=plan.tpdo_with(*MODE) is not None,
        counted=speed is not None and speed.place_of(*POSITION) is not None,
    )

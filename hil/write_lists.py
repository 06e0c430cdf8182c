"""The objects that each command may write to a drive by SDO: any other write is refused unsent.

``docs/writes.md`` shows them; ``python docs/make_writes.py`` renews it. The reason for each object stands
beside it, here and in :mod:`servobench.drivers.cia402.objects402`.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.canopen.write_list import NOTHING, ListedWrite, Product, WriteList
from servobench.drivers.cia402.objects402 import CONTROL, MOTION, SET_UP, Object, listed
from servobench.drivers.vendors.families import commutation_for, gains_for
from servobench.virtual_bus.drive.load_object import (
    LOAD_COURSE_SUB,
    LOAD_DELAY_SUB,
    LOAD_MACHINE,
    LOAD_TORQUE_SUB,
    SIMULATED_DRIVE,
)

_LIMITS: Final = "Limits, reactions, PDO plan"
_TURN: Final = "Encoder counts by a turn"
"""Steps of commissioning, by their titles."""
_HISTORY: Final = listed(
    Cia301.ERROR_HISTORY, "an error history that was empty is emptied again", "when all is put back"
)


PUTTING_BACK: Final = CONTROL | WriteList("putting back", (_HISTORY,))
"""Writes beyond the objects that a journal names."""


def _load(sub: int, why: str, when: str) -> ListedWrite:
    index = range(LOAD_MACHINE, LOAD_MACHINE + 1)
    return ListedWrite(index, (sub,), "Load machine", why, when, SIMULATED_DRIVE)


RUN: Final = (
    SET_UP
    | WriteList(
        "drive files and loads",
        (
            listed(Object.POLARITY, "signs that commissioning turned over", "set-up, from the drive file"),
            _load(LOAD_TORQUE_SUB, "load torque of the bench", "each step of a load; 0 at the end"),
            _load(LOAD_COURSE_SUB, "load over time", "first cycle; off at the end"),
            _load(LOAD_DELAY_SUB, "delay of a load over time", "before the first cycle"),
        ),
    )
).named("hil run")
MEASURE: Final = (SET_UP | PUTTING_BACK).named("hil measure")
RESTORE: Final = (
    SET_UP
    | PUTTING_BACK
    | WriteList(
        "commissioning",
        (
            listed(Object.HALT_OPTION, "halt by quick stop ramp", _LIMITS),
            listed(Object.FOLLOWING_ERROR_WINDOW, "following error of the limits", _LIMITS),
            listed(Object.MAX_CURRENT, "current limit of the bench", _LIMITS),
            listed(Object.SOFTWARE_POSITION_LIMIT, "travel of the limits", _LIMITS, (1, 2)),
            listed(Object.POLARITY, "signs that contradict each other", "Direction and polarity"),
            listed(Object.PROFILE_VELOCITY, "speed of a motion", f"{_LIMITS}; in profile position"),
            listed(Object.PROFILE_ACCELERATION, "ramp of a motion", "steps that turn the shaft"),
            listed(
                Object.PROFILE_DECELERATION, "ramp of a motion and of a stop", "steps that turn the shaft"
            ),
            listed(Object.MAX_ACCELERATION, "ramps that it makes too slow", f"{_LIMITS}; in profile modes"),
            listed(Object.MAX_DECELERATION, "ramps that it makes too slow", f"{_LIMITS}; in profile modes"),
            listed(Object.TORQUE_SLOPE, "a slope that hides commands", f"{_LIMITS}; in profile torque"),
            listed(Object.HOMING_METHOD, "homing on the index: one turn", _TURN),
            listed(Object.HOMING_SPEEDS, "speeds of that homing", _TURN, (1, 2)),
            listed(Object.HOMING_ACCELERATION, "ramp of that homing", _TURN),
            listed(Object.HOME_OFFSET, "position of the home", "hil homing --offset-turns"),
            listed(Object.COMMUTATION_ANGLE, "angle of the field", "hil phase: each 20 ms"),
            listed(
                Object.DIGITAL_OUTPUTS,
                "outputs, the brake's among them",
                "hil io --set, hil brake --test",
                (1, 2),
            ),
        ),
    )
).named("hil restore")
"""Objects that a journal may name; nothing else is written, except :data:`PUTTING_BACK`."""
STORE: Final = WriteList(
    "orders", (listed(Cia301.STORE_PARAMETERS, "the drive keeps its settings", "with --store", (1,)),)
)
COMMISSION: Final = (RESTORE | STORE).named("hil commission")
JOG: Final = RESTORE.named("hil jog")
HOMING: Final = RESTORE.named("hil homing")
BRAKE: Final = RESTORE.named("hil brake")


def makers_commutation(product: Product) -> tuple[ListedWrite, ...]:
    """Return the objects in which a drive of this make keeps how encoder and rotor are joined."""
    known = commutation_for(product.vendor, product.code, product.device_name)
    return tuple(
        ListedWrite(
            range(each.index, each.index + 1),
            (each.sub,),
            "Commutation",
            "pole pairs, order of the lines and offset as found",
            "hil phase",
            product,
        )
        for each in (() if known is None else known.settings)
    )


PHASE: Final = (RESTORE | STORE | WriteList("phase", makers_commutation(SIMULATED_DRIVE))).named("hil phase")
"""Of a known maker's drive its own objects too, once it has said whose it is."""


def makers_gains(product: Product) -> tuple[ListedWrite, ...]:
    """Return the objects in which a drive of this make keeps the gains of its loops."""
    known = gains_for(product.vendor, product.code, product.device_name)
    return tuple(
        ListedWrite(
            range(each.index, each.index + 1),
            (each.sub,),
            "Loop gains",
            "gains as computed",
            "hil tune --apply",
            product,
        )
        for each in known or ()
    )


TUNE: Final = (RESTORE | STORE | WriteList("tune", makers_gains(SIMULATED_DRIVE))).named("hil tune")
"""Of a known maker's drive its own objects too, once it has said whose it is."""
IO: Final = WriteList("hil io", (listed(Object.DIGITAL_OUTPUTS, "outputs as asked for", "--set", (1, 2)),))
STOP: Final = CONTROL.named("hil stop")
FAULT: Final = CONTROL.named("hil fault")
RIG: Final = (SET_UP | MOTION).named("a fixture of pytest")
"""The drive of a test; its author allows further writes by ``DriveRig.allow_write``."""

COMMANDS: Final[Mapping[str, WriteList]] = MappingProxyType(
    {
        "run": RUN,
        "measure": MEASURE,
        "commission": COMMISSION,
        "jog": JOG,
        "homing": HOMING,
        "brake": BRAKE,
        "phase": PHASE,
        "tune": TUNE,
        "io": IO,
        "restore": RESTORE | STORE,
        "stop": STOP,
        "fault": FAULT,
        "scan": NOTHING.named("hil scan"),
    }
)
"""Write lists by command; a command that is missing sends nothing to a drive."""


def writes_of(command: str) -> WriteList:
    """Return the list of ``hil COMMAND``; ``(index, sub) in writes_of("run")`` for a drive of any make.

    A command that writes to no drive has an empty one.
    """
    return COMMANDS.get(command, NOTHING.named(f"hil {command}"))

"""Which PDOs a drive is given: the plans of its settings one after the other, until it takes one."""

from dataclasses import replace
from itertools import product

from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.canopen.pdo import PdoDirection, PdoPlan, write_plan
from servobench.drivers.canopen.pdo_capability import PdoCapability, capability_of_drive
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.pdo_planner import PlanImpossible, mode_plan, plan_pdos
from servobench.drivers.cia402.pdo_plans import (
    ALL,
    DEMAND,
    MODE,
    TORQUE,
    Features,
    PlanWish,
    choices,
    features_of,
    standard,
    status_timer_ms,
)
from servobench.drivers.errors import PeerFault, TransferAborted


def map_pdos(objects: RemoteObjects, settings: DriveSettings) -> tuple[PdoPlan, list[str]]:
    """Write the plan of the settings; else the best one that the drive takes, for its dictionary or the
    standard one. Return it with notes on its limits.

    A drive with unchangeable mappings is served with those, if they carry what is needed. Raises
    PlanImpossible; or TransferAborted or SettingRefused, with PlanImpossible as the cause where the drive
    keeps its mappings and they cannot serve the mode.
    """
    if settings.plan is not None:
        return settings.plan, write_plan(objects, settings.plan)
    plan, notes = _map(objects, settings)
    if settings.counted and not features_of(plan).counted:
        notes = ["no 6064h beside 606Ch: no reading has a count of its own SYNC", *notes]
    return plan, notes


def _map(objects: RemoteObjects, settings: DriveSettings) -> tuple[PdoPlan, list[str]]:
    refusals: list[PeerFault] = []
    tried: list[PdoPlan] = []
    for features in choices(_able(objects, settings), settings.position_every_cycles):
        plan, notes = _planned(objects, settings, features)
        if plan in tried or not features.counted <= features_of(plan).counted:
            continue
        tried.append(plan)
        try:
            written = write_plan(objects, plan)
        except (TransferAborted, SettingRefused) as error:
            refusals.append(error)
            continue
        refused = [f"a PDO plan that tells more was not taken: {refusals[0].evidence}"] if refusals else []
        return plan, refused + notes + written
    if settings.capability is None and objects.read_if_there(*TORQUE) is None:
        wish = replace(_wish(settings), features=_able(objects, settings))
        plan = _without_torque(mode_plan(objects.node_id, wish))
        return plan, ["no 6077h: readings carry no torque", *write_plan(objects, plan)]
    return _map_as_held(objects, settings, refusals[0])


def _without_torque(plan: PdoPlan) -> PdoPlan:
    return replace(
        plan,
        tpdos=tuple(
            replace(pdo, entries=tuple(entry for entry in pdo.entries if (entry.index, entry.sub) != TORQUE))
            for pdo in plan.tpdos
        ),
    )


def _able(objects: RemoteObjects, settings: DriveSettings) -> Features:
    """Return the features that the drive may have; with a dictionary the planner decides."""
    if settings.capability is not None:
        return Features(counted=settings.counted)
    stamp, demand, mode = (
        objects.read_if_there(*key) is not None for key in (settings.stamp.key, DEMAND, MODE)
    )
    return Features(stamp, demand and _wish(settings).torque_mode, mode=mode, counted=settings.counted)


def _planned(
    objects: RemoteObjects, settings: DriveSettings, features: Features
) -> tuple[PdoPlan, list[str]]:
    """Make a plan that uses no more than ``features``; return it with its limits."""
    node, wish = objects.node_id, replace(_wish(settings), features=features)
    result = plan_pdos(settings.capability or standard(wish.stamp), node, wish)
    changes = settings.demand_changes and settings.stamp.of_events
    if settings.capability is None and changes and features._replace(mode=True) == ALL:
        return mode_plan(node, wish, demand_changes=True), list(result.notes)
    return result.plan, list(result.notes)


def _wish(settings: DriveSettings) -> PlanWish:
    return PlanWish(
        settings.mode,
        settings.synchronous_command,
        settings.position_every_cycles,
        status_timer_ms=status_timer_ms(settings.drive_heartbeat_timeout_ms),
        coherent=settings.coherent,
        stamp=settings.stamp.key,
        mode_apart=not settings.observed.entries,
        features=Features(counted=settings.counted),
    )


def _map_as_held(
    objects: RemoteObjects, settings: DriveSettings, refusal: PeerFault
) -> tuple[PdoPlan, list[str]]:
    """Use the mappings that the drive holds: first those of one direction, with plans for the other, then
    all. Raises the last refusal if they do not serve."""
    wished = mode_plan(objects.node_id, _wish(settings), demand_changes=settings.demand_changes)
    codes = {(entry.index, entry.sub): entry.code for pdo in wished for entry in pdo.entries}
    held = capability_of_drive(objects, codes)
    impossible: PlanImpossible | None = None
    tried: list[PdoPlan] = []
    for kept, features in product(
        ("RPDO ", "TPDO ", ""), choices(_able(objects, settings), settings.position_every_cycles)
    ):
        try:
            result = plan_pdos(
                _with_held(settings.capability or standard(settings.stamp.key), held, kept),
                objects.node_id,
                replace(_wish(settings), features=features),
            )
            if result.plan in tried or not features.counted <= features_of(result.plan).counted:
                continue
            tried.append(result.plan)
            written = write_plan(objects, result.plan)
        except PlanImpossible as error:
            impossible = error
        except (TransferAborted, SettingRefused) as error:
            refusal = error
        else:
            note = f"{kept}mappings are used as the drive has them: {refusal.evidence}"
            return result.plan, [note, *result.notes, *written]
    raise refusal from impossible


def _with_held(known: PdoCapability, held: PdoCapability, kept: str) -> PdoCapability:
    """Return ``known`` with the PDOs of the direction ``kept`` as they are ``held``; with all if it is
    empty."""
    if not kept:
        return held
    slots = tuple(
        slot
        for direction in PdoDirection
        for slot in (held if kept[0] == direction.letter else known).of(direction)
    )
    return replace(known, slots=slots)

"""Objects that a drive sends with SYNCs for the recording alone: the loop does not use them."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.canopen.objects301 import object_name
from servobench.drivers.canopen.pdo import BITS_MAX, PdoDirection, PdoEntry, PdoMap, PdoPlan, write_plan
from servobench.drivers.errors import PeerFault, TransferAborted

NUMBERS = range(1, 5)
"""TPDOs with a predefined identifier."""
_REMEDY = "take it out of the bench file's observe"


class Observed(NamedTuple):
    """The objects to be sent."""

    entries: tuple[PdoEntry, ...] = ()
    every_cycles: int = 1
    """With every so many SYNCs."""


NOTHING = Observed()


class NotObservable(PeerFault):
    """A drive cannot send an object by PDO; ``evidence`` holds its own words."""


def with_observed(plan: PdoPlan, node_id: int, observed: Observed) -> PdoPlan | None:
    """Fill the TPDOs that ``plan`` leaves free, one after the other; None: they do not hold everything."""
    used = {pdo.number for pdo in plan.tpdos}
    free = [number for number in NUMBERS if number not in used]
    contents = _packed(observed.entries)
    if len(contents) > len(free):
        return None
    sent = PdoDirection.TRANSMIT
    maps = [
        PdoMap(sent, number, sent.default_cob_id(number, node_id), entries, observed.every_cycles)
        for number, entries in zip(free, contents, strict=False)
    ]
    return replace(plan, observed=tuple(maps))


def _packed(entries: Iterable[PdoEntry]) -> list[tuple[PdoEntry, ...]]:
    pdos: list[tuple[PdoEntry, ...]] = []
    for entry in entries:
        last = pdos[-1] if pdos else ()
        if not pdos or sum(each.bits for each in last) + entry.bits > BITS_MAX:
            pdos.append((entry,))
        else:
            pdos[-1] = (*last, entry)
    return pdos


def map_observed(objects: RemoteObjects, plan: PdoPlan, observed: Observed) -> tuple[PdoPlan, list[str]]:
    """Write them into the drive, which holds ``plan`` and is pre-operational; return notes on what was done.

    Raises NotObservable.
    """
    if not observed.entries:
        return plan, []
    for entry in observed.entries:
        _check(objects, entry)
    whole = with_observed(plan, objects.node_id, observed)
    if whole is None:
        serving = ", ".join(pdo.name for pdo in plan.tpdos)
        names = _names(observed.entries)
        raise NotObservable(
            f"node {objects.node_id} has no TPDO left for {names}", f"{serving} serve the loop", _REMEDY
        )
    try:
        return whole, write_plan(objects, whole)
    except (TransferAborted, SettingRefused) as error:
        raise NotObservable(
            f"node {objects.node_id} does not map {_names(observed.entries)}", error.evidence, _REMEDY
        ) from error


def _check(objects: RemoteObjects, entry: PdoEntry) -> None:
    name = object_name(entry.index, entry.sub)
    try:
        data = objects.network.upload(objects.node_id, entry.index, entry.sub)
    except TransferAborted as error:
        raise NotObservable(f"node {objects.node_id}: {name}", error.evidence, _REMEDY) from error
    if len(data) * 8 != entry.bits:
        raise NotObservable(
            f"node {objects.node_id}: {name} has {len(data)} bytes",
            f"the bench file's type has {entry.bits // 8}",
            "give its type as the maker's manual has it",
        )


def _names(entries: Sequence[PdoEntry]) -> str:
    return ", ".join(object_name(entry.index, entry.sub) for entry in entries)

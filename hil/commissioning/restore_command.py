"""``hil restore``: a drive's former settings, from a journal; needs no extra."""

from pathlib import Path
from typing import Any

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.drive_setup import read_identity
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.dialog import say
from servobench.hil.execution.world import drive_network
from servobench.hil.machine.stopping import stop_signals
from servobench.hil.restoring.journal import DriveMark, append_restored, read_journal
from servobench.hil.restoring.restore import await_answer, restore, store_settings
from servobench.hil.write_lists import RESTORE, STORE

_ANSWER_LIMIT = Duration(5 * NS_PER_S)
"""A drive that was just switched on boots in a second or two."""


def run_restore(journal: Path, bus: str | None, store: bool = False) -> dict[str, Any]:
    """Run ``hil restore``; return its result. ``bus``: None: that of the journal. ``store``: have the drive
    keep what it holds then, if all is as it was.

    Raises PeerFault if the node is another drive now or does not store, NoAnswer or BusDown if it cannot be
    reached.
    """
    contents = read_journal(journal)
    head = contents.head
    if bus is None:
        parse_bus_spec(head.bus, str(journal), "bus")
    writes = RESTORE | STORE if store else RESTORE
    with stop_signals(), drive_network(bus or head.bus, head.bitrate_bit_s, writes) as network:
        await_answer(network, head.node, _ANSWER_LIMIT)
        check_mark(RemoteObjects(network, head.node), head.mark)
        result = restore(network, contents, say)
        stored = store and result.complete
        if stored:
            store_settings(network, head.node)
    text = [f"{result.objects} objects, {result.written} had to be written"]
    if result.complete:
        append_restored(journal)
        text.append("everything is as it was, byte for byte")
        if stored:
            text.append("the drive keeps it")
    else:
        text += [f"still different: {failure}" for failure in result.failures]
    return {
        "objects": result.objects,
        "written": result.written,
        "complete": result.complete,
        "stored": stored,
        "failures": result.failures,
        "text": text,
    }


def check_mark(objects: RemoteObjects, mark: DriveMark) -> None:
    """Raise PeerFault if the node is another drive than the journal's."""
    identity = read_identity(objects)
    here = DriveMark(identity.vendor, identity.product, identity.serial)
    if here != mark:
        raise PeerFault(
            f"node {objects.node_id} is not the drive of the journal",
            f"vendor, product and serial number are {here.vendor:X}h, {here.product:X}h, {here.serial}; "
            f"the journal is of {mark.vendor:X}h, {mark.product:X}h, {mark.serial}",
            "connect the drive whose journal it is",
        )

"""The commands ``hil commission`` and ``hil restore`` behind their options."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from drivers.canopen.network import CanopenNetwork
from drivers.canopen.objects import RemoteObjects
from drivers.cia402.drive_setup import read_identity
from drivers.errors import BadInput, PeerFault
from drivers.sheets.dictionary import load_dictionary
from drivers.timebase import NS_PER_S, Duration
from drivers.wire.adapters import parse_bus_spec
from hil.commissioning.commission import commission
from hil.commissioning.dialog import Dialog, EmergencyStop, Silent, Terminal, say
from hil.commissioning.outcome import StepVerdict
from hil.commissioning.rehearsal import Rehearsed, rehearsed_drive
from hil.commissioning.report import HTML_FILE, Commissioned, as_json
from hil.commissioning.request import CommissionRequest, Nameplate
from hil.execution.world import WorldPlan, open_world
from hil.machine.realtime import timing_conditions
from hil.machine.stopping import stop_signals
from hil.restoring.journal import DriveMark, append_restored, read_journal
from hil.restoring.restore import await_answer, restore
from virtual_bus.hosting.faulty_device import SimulatedNode

_ANSWER_LIMIT = Duration(5 * NS_PER_S)


def run_command(
    request: CommissionRequest, *, yes: bool, rehearsed: Rehearsed | None, plate_given: bool
) -> tuple[int, dict[str, Any]]:
    """``hil commission``: its exit status, and its figures."""
    spec = parse_bus_spec(request.bus, "--bus")
    devices: Sequence[SimulatedNode] = ()
    if spec.simulated != (rehearsed is not None):
        expected = "--rehearse SEED or --rehearse-eds FILE with --bus simulated, and only with it"
        raise BadInput("--bus", "", request.bus, expected)
    if rehearsed is not None:
        servo, plate = rehearsed_drive(rehearsed, request.node, request.bitrate_bit_s, say)
        devices = [servo]
        request = replace(request, eds=request.eds or rehearsed.eds)
        if not plate_given:
            request = replace(request, nameplate=Nameplate.model_validate(plate), trust_nameplate=True)
            say("no --motor: the rehearsed drive's own nameplate is taken, and trusted against the drive")
    if not yes and not request.dry_run and not sys.stdin.isatty():
        raise BadInput("--yes", "", "no terminal to ask at", "--yes, or a terminal as standard input")
    sheet = None
    if request.eds is not None:
        sheet = load_dictionary(request.eds, request.node)
        if sheet.repairs:
            say(f"{request.eds}: {len(sheet.repairs)} repairs, see hil eds")
    silent = yes or request.dry_run
    dialog: Dialog = Silent(say) if silent else Terminal(sys.stdin, say)
    seed = 0 if rehearsed is None else rehearsed.seed or 0
    plan = WorldPlan(spec, request.bitrate_bit_s, False, None, seed)
    with stop_signals() as signals, open_world(plan, devices) as world:
        stop = EmergencyStop(signals, sys.stdin)
        with timing_conditions(world.real_time):
            result = commission(request, world, dialog, stop, sheet)
    return _conclude(request, result)


def _conclude(request: CommissionRequest, result: Commissioned) -> tuple[int, dict[str, Any]]:
    done = sum(record.verdict is StepVerdict.DONE for record in result.records)
    faults = sum(len(record.outcome.faults) for record in result.records)
    say(f"{done} of {len(result.records)} steps done, {faults} faults found; see {request.out / HTML_FILE}")
    figures = as_json(request, result)
    if result.error is not None:
        say(f"hil: error: {result.error}")
        return result.error.exit_status, figures
    return (0 if result.passed else 1), figures


def run_restore(bus: str, node: int, journal: Path, bitrate_bit_s: int) -> dict[str, Any]:
    """``hil restore``: what came of it.

    Raises BadInput for a journal of another drive or node, NoAnswer or BusDown if it cannot be reached.
    """
    contents = read_journal(journal)
    if contents.head.node != node:
        raise BadInput("--node", "", node, f"{contents.head.node}, whose journal {journal} is")
    spec = parse_bus_spec(bus, "--bus")
    if spec.simulated:
        raise BadInput("--bus", "", bus, "a bus on which the drive still is")
    plan = WorldPlan(spec, bitrate_bit_s, False, None, 0)
    with stop_signals(), open_world(plan, ()) as world:
        network = CanopenNetwork(world.link, world.clock)
        await_answer(network, node, _ANSWER_LIMIT)
        check_mark(RemoteObjects(network, node), contents.head.mark)
        result = restore(network, contents, say)
    text = [f"{result.objects} objects, {result.written} had to be written"]
    if result.complete:
        append_restored(journal)
        text.append("everything is as it was, byte for byte")
    else:
        text += [f"still different: {failure}" for failure in result.failures]
    return {
        "objects": result.objects,
        "written": result.written,
        "complete": result.complete,
        "failures": result.failures,
        "text": text,
    }


def check_mark(objects: RemoteObjects, mark: DriveMark) -> None:
    """Raises PeerFault if the node is another drive than the one of the journal."""
    identity = read_identity(objects)
    here = DriveMark(identity.vendor, identity.product, identity.serial)
    if here != mark:
        raise PeerFault(
            f"node {objects.node_id} is not the drive of the journal",
            f"vendor, product and serial number are {here.vendor:X}h, {here.product:X}h, {here.serial}; "
            f"the journal is of {mark.vendor:X}h, {mark.product:X}h, {mark.serial}",
            "connect the drive whose journal it is",
        )

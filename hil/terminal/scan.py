"""``hil scan``: adapters of this machine, and nodes on a bus."""

import json
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.hil.terminal.options import JsonOption, bitrate_option, bus_option, flag, valued
from servobench.hil.terminal.output import columns, put, say

if TYPE_CHECKING:
    from servobench.hil.inspecting.scanning import Adapters, BusReport


def scan(
    bus: Annotated[
        str | None, bus_option("Search this bus for nodes: socketcan:can0, slcan:PORT, ...")
    ] = None,
    bitrate: Annotated[int | None, bitrate_option("Bit rate, bit/s; default: found by listening.")] = None,
    assign: Annotated[
        list[str] | None,
        valued("--assign", "NODE", "Assign this node-ID to a device without one (LSS); repeatable."),
    ] = None,
    store: Annotated[bool, flag("--store", "With --assign: store the node-ID in the device.")] = False,
    passive: Annotated[bool, flag("--passive", "Only listen; send nothing.")] = False,
    listen: Annotated[
        float, valued("--listen", "S", "Time to listen before sending, s.", min=0.0, max=600.0)
    ] = 1.5,
    wait: Annotated[
        float,
        valued(
            "--wait", "S", "Look again until a node has answered, at most so long, s.", min=0.0, max=600.0
        ),
    ] = 0.0,
    as_json: JsonOption = False,
) -> None:
    """List the adapters of this machine; with --bus, the nodes on a bus, without disturbing it.

    Examples:
      hil scan
      hil scan --bus hub:lab --wait 60   # until somebody is there
      hil scan --bus socketcan:can0   # a real drive
    """
    from servobench.drivers.canopen.nmt_states import UNCONFIGURED
    from servobench.drivers.errors import BadInput
    from servobench.drivers.timebase import duration_s
    from servobench.drivers.wire.adapters import parse_bus_spec
    from servobench.hil.inspecting.scanning import ScanPlan, find_adapters, scan_bus
    from servobench.hil.terminal.options import node_ids

    plan = None
    if bus is not None:
        nodes = node_ids(assign, "--assign") if assign else []
        if UNCONFIGURED in nodes:
            raise BadInput("--assign", "", UNCONFIGURED, "a node-ID 1..127")
        spec = parse_bus_spec(bus)
        plan = ScanPlan(spec, bitrate, duration_s(listen), passive, tuple(nodes), store, duration_s(wait))
    elif assign or passive or wait or bitrate is not None:
        raise BadInput("--bus", "", None, "the bus to look at")
    if plan is None:
        adapters = find_adapters()
        figures = {"adapters": adapters.as_json(), "bus": None}
        put(figures, as_json, lambda _figures: _print_adapters(adapters))
    elif as_json:
        report = scan_bus(plan, say)
        typer.echo(json.dumps({"adapters": find_adapters().as_json(), "bus": report.as_json()}))
    else:
        _print_bus(scan_bus(plan, say))


def _print_adapters(adapters: "Adapters") -> None:
    from rich.console import Console

    from servobench.drivers.wire.attached import link_advice

    console = Console(highlight=False)
    table = columns("adapter", "what", "bit rate", "state", overflow="fold")
    for link in adapters.can_links:
        rate = f"{link.bitrate_bit_s}" if link.bitrate_bit_s else "-"
        state = f"up, {link.state.lower()}" if link.up and link.state else "up" if link.up else "down"
        table.add_row(link.spec, f"kernel, {link.kind or 'can'}", rate, state)
    advice = [text for link in adapters.can_links for text in link_advice(link)]
    for port in adapters.serial_ports:
        what = ", ".join(part for part in (port.usb_id, port.description, port.hint) if part)
        table.add_row(port.spec, what, "-", "ready" if port.permitted else "no permission (group dialout)")
    for other in adapters.others:
        table.add_row(other, "python-can", "-", "-")
    for hub in adapters.hubs:
        table.add_row(f"hub:{hub}", "hub of this user", "-", "-")
    if table.row_count:
        console.print(table)
        for text in advice:
            console.print(f"note: {text}", soft_wrap=True)
        console.print("\nWho is on a bus: hil scan --bus ADAPTER")
    else:
        console.print("No CAN adapter and no USB serial port. What this machine can do: hil doctor")


def _print_bus(report: "BusReport") -> None:
    rate = f"{report.bitrate_bit_s} bit/s" if report.bitrate_bit_s else "bit rate unknown"
    how = ", found by listening" if report.bitrate_detected and not report.spec.startswith("hub:") else ""
    print(f"{report.spec}: {rate}{how}; {report.traffic.frames} frames heard before anything was asked")
    for node in report.nodes:
        print(f"\nnode {node.node_id:<4} {node.profile or 'a device'}{f', {node.name}' if node.name else ''}")
        state = node.nmt_state or "unknown"
        if "heartbeat" not in node.heard and node.heartbeat_ms == 0:
            state += " (it sends no heartbeat)"
        print(f"          state {state}; error register {_hex(node.error_register, 2)}")
        if node.vendor_id is not None:
            print(
                f"          vendor {_hex(node.vendor_id, 8)}, product {_hex(node.product_code, 8)},"
                f" revision {_hex(node.revision_number, 8)}, serial {_hex(node.serial_number, 8)}"
            )
        if node.note:
            print(f"          {node.note}")
    if not report.nodes:
        print("no node was heard or answered")
    for address in report.unconfigured:
        print(f"\nwithout node-ID: {address}")
        print(f"          give it one: hil scan --bus {report.spec} --assign NODE")
    for node_id, address in report.assigned:
        print(f"\nnode {node_id} is now the device with {address}")
    for note in report.notes:
        print(f"\n{note}")


def _hex(value: int | None, digits: int) -> str:
    return "-" if value is None else f"{value:0{digits}X}h"

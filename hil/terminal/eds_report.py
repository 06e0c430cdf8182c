"""Terminal output of a data sheet."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from servobench.drivers.canopen.bus_scan import profile_title
from servobench.drivers.canopen.pdo import mapping_text
from servobench.drivers.canopen.pdo_budget import LOAD_LIMIT_PERCENT, Budget
from servobench.drivers.cia402.profile import BENCH_MODES, run_words
from servobench.drivers.sheets.dictionary import LoadedDictionary
from servobench.drivers.sheets.eds.text import Repair
from servobench.drivers.sheets.fitness import MODES_TOLD, FileIdentity, Fitness
from servobench.hil.terminal.eds_sheet import Planned, run_key, unit_lines
from servobench.hil.terminal.output import columns, titled


def print_sheet(
    file: Path,
    loaded: LoadedDictionary,
    fitness: Fitness,
    planned: Planned | None,
) -> None:
    """Print identity, profile, modes, PDOs, missing objects, repairs, and finally the verdict."""
    console = Console(highlight=False)
    _say(console, _facts(file, loaded, fitness))
    if fitness.modes:
        _say(console, Text("What its modes serve for", style="bold"), _mode_table(fitness))
    _say(console, Text("PDOs as the device has them", style="bold"), _pdo_table(fitness))
    if planned is not None:
        _print_plan(console, planned)
    _print_units(console, loaded, fitness)
    _print_lacks(console, fitness)
    _print_repairs(console, loaded.repairs)
    _print_verdict(console, fitness)


def _say(console: Console, *parts: Table | Text) -> None:
    for part in parts:
        console.print(part, soft_wrap=isinstance(part, Text))
    console.print()


def _facts(file: Path, loaded: LoadedDictionary, fitness: Fitness) -> Table:
    identity, objects = fitness.identity, loaded.objects
    entries = sum(len(described.entries) for described in objects.values())
    size = f"{len(objects)} objects, {entries} entries"
    rates = ", ".join(map(str, loaded.device.bit_rates_kbit_s))
    lines = {
        "File": f"{file} ({loaded.kind}, node {loaded.dictionary.node_id}, {size})",
        "Made": " ".join(
            part for part in (loaded.file.modified or loaded.file.created, _version(loaded)) if part
        ),
        "Device": _device(identity),
        "Identity": _numbers(identity),
        "Profile": _profile(fitness),
        "Modes": f"{', '.join(mode.title for mode in fitness.modes) or 'none'}, by {fitness.modes_told_by}",
        "Bit rates": f"{rates} kbit/s" if rates else "",
        "Commissioning": _commissioning(loaded),
    }
    return titled({title: line for title, line in lines.items() if line}, overflow="fold")


def _version(loaded: LoadedDictionary) -> str:
    file = loaded.file
    return f"version {file.version}.{file.revision or 0}" if file.version else ""


def _device(identity: FileIdentity) -> str:
    names = [identity.vendor_name, identity.product_name]
    if identity.device_name not in ("", identity.product_name):
        names.append(f"(device name {identity.device_name})")
    return " ".join(name for name in names if name)


def _numbers(identity: FileIdentity) -> str:
    parts = (
        ("vendor", identity.vendor),
        ("product", identity.product),
        ("revision", identity.revision),
        ("device type", identity.device_type),
    )
    return ", ".join(f"{name} {value:08X}h" for name, value in parts if value is not None) or "none given"


def _profile(fitness: Fitness) -> str:
    number = fitness.profile
    profile = "not given" if number is None else profile_title(number) if number else "no standard profile"
    return f"{profile}, {fitness.axes} {'axis' if fitness.axes == 1 else 'axes'} with a controlword"


def _commissioning(loaded: LoadedDictionary) -> str:
    commissioning = loaded.commissioning
    if commissioning is None:
        return ""
    parts = [
        f"node {commissioning.node_id}" if commissioning.node_id is not None else "",
        commissioning.node_name,
        f"{commissioning.bit_rate_kbit_s} kbit/s" if commissioning.bit_rate_kbit_s else "",
        f"serial {commissioning.serial_number:08X}h" if commissioning.serial_number is not None else "",
    ]
    return ", ".join(part for part in parts if part)


def _mode_table(fitness: Fitness) -> Table:
    """Tabulate the modes: whether hil commission and hil run can command each, and why not."""
    table = columns("mode", "hil commission", "hil run", "")
    for each in fitness.usable:
        key = run_key(each) if fitness.serves else None
        commission = "yes" if fitness.serves and each.plan is not None else "no"
        table.add_row(each.mode.title, commission, f'mode = "{key}"' if key else "no", Text(each.reason))
    judged = {each.mode for each in fitness.usable}
    for mode in fitness.modes:
        if mode not in judged:
            table.add_row(mode.title, "no", "no", "")
    return table


def _pdo_table(fitness: Fitness) -> Table | Text:
    if not fitness.pdos:
        return Text("none", style="yellow")
    figures = ("type", "inhibit", "event")
    table = columns("PDO", "COB-ID", *figures, "mapping", right=figures)
    for pdo in fitness.pdos:
        identifier = "-" if pdo.identifier is None else f"{pdo.identifier:03X}h"
        inhibit = "-" if not pdo.inhibit_time else f"{pdo.inhibit_time / 10:g} ms"
        event = "-" if not pdo.event_timer else f"{pdo.event_timer} ms"
        kind = "-" if pdo.transmission_type is None else str(pdo.transmission_type)
        mapping = mapping_text(pdo.mapping) or "nothing"
        room = f"{pdo.entries_max} entries" if pdo.mapping_writable else "fixed"
        state = identifier if pdo.valid else f"{identifier} off"
        table.add_row(pdo.name, state, kind, inhibit, event, Text(f"{mapping} ({room})"))
    return table


def _print_plan(console: Console, planned: Planned) -> None:
    title = Text(f"PDO plan for {planned.mode}", style="bold")
    if planned.result is None or planned.budget is None:
        _say(console, title, Text(f"none: {planned.reason}", style="bold red"))
        return
    notes = [Text(f"note: {note}", style="yellow") for note in planned.result.notes]
    _say(console, title, _budget_table(planned.budget), *_budget_lines(planned.budget), *notes)


def _budget_table(budget: Budget) -> Table:
    figures = ("COB-ID", "bytes", "bits", "us", "a cycle")
    table = columns("frame", *figures, "content", right=figures)
    for line in budget.lines:
        table.add_row(
            line.name,
            f"{line.cob_id:03X}h",
            str(line.data_bytes),
            str(line.bits_max),
            f"{line.time_ns / 1e3:.0f}",
            f"{line.a_cycle:g}",
            Text(line.content),
        )
    return table


def _budget_lines(budget: Budget) -> list[Text]:
    load = budget.load_percent
    rate = f"{budget.bitrate_bit_s / 1000:g} kbit/s"
    style = "bold red" if load > 100.0 else "yellow" if load > LOAD_LIMIT_PERCENT else ""
    return [
        Text(
            f"{budget.busy_ns / 1e3:.0f} us of {budget.period_ns / 1e3:.0f} us at {rate}: "
            f"{load:.1f} % of the bus, {budget.fullest_cycle_percent:.1f} % in the fullest cycle",
            style=style,
        ),
        Text(
            f"shortest cycle {budget.shortest_period_ns / 1e3:.0f} us "
            f"with {100 - LOAD_LIMIT_PERCENT:.0f} % left; "
            f"room for {budget.sdo_transfers_a_s:.0f} SDO transfers a second"
        ),
    ]


def _print_units(console: Console, loaded: LoadedDictionary, fitness: Fitness) -> None:
    lines, notes = unit_lines(loaded, fitness)
    table = columns()
    for line in lines:
        value = "" if line.value is None else f"{line.value:.6g} {line.unit}"
        table.add_row(line.name, value, Text(line.source))
    _say(
        console,
        Text("One raw unit, of the motor shaft, by the values in the file", style="bold"),
        table,
        *[Text(f"note: {note}", style="yellow") for note in notes],
    )


def _print_lacks(console: Console, fitness: Fitness) -> None:
    if not fitness.lacks:
        return
    table = columns()
    for lack in fitness.lacks:
        table.add_row(f"{lack.index:04X}h", Text(lack.name), Text(lack.consequence))
    _say(console, Text("Recommended objects that it does not have", style="bold"), table)


def _print_repairs(console: Console, repairs: Sequence[Repair]) -> None:
    if not repairs:
        _say(console, Text("The file needed no repair."))
        return
    title = Text(
        f"{len(repairs)} {'repair' if len(repairs) == 1 else 'repairs'} to read the file", style="bold"
    )
    table = columns()
    for repair in repairs:
        line = f"line {repair.line}" if repair.line else ""
        table.add_row(line, Text(f"[{repair.section}]"), Text(f"{repair.fault}: {repair.action}"))
    _say(console, title, table)


def _print_verdict(console: Console, fitness: Fitness) -> None:
    for remark in fitness.remarks:
        console.print(Text(f"note: {remark}", style="yellow"), soft_wrap=True)
    if fitness.serves:
        best = fitness.best
        mode = f", best in {best.mode.title}" if best is not None else ""
        served = [each.mode for each in fitness.usable if each.plan is not None]
        style = "bold green" if set(served) & set(BENCH_MODES.values()) else "bold yellow"
        if_taken = "" if fitness.modes_told_by == MODES_TOLD else ", if it takes it: 6502h tells no mode"
        words = f"It can serve a bench{mode}{if_taken}; {run_words(served)}."
        console.print(Text(words, style=style), soft_wrap=True)
        return
    console.print(Text("It cannot serve a bench:", style="bold red"))
    for obstacle in fitness.obstacles:
        console.print(Text(f"  {obstacle}"), soft_wrap=True)

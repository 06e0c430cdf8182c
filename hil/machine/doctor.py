"""``hil doctor``: what this machine can do, and the exact command that mends each lack."""

from collections.abc import Sequence
from dataclasses import replace

from rich.console import Console
from rich.text import Text

from hil.machine import doctor_bus, doctor_machine
from hil.machine.capability import Capability, CapabilityStatus, Machine

CHECKS = (*doctor_bus.CHECKS, *doctor_machine.CHECKS)

ALWAYS = "Whatever is lacking, --bus simulated (simulated time) and --bus hub:NAME (real time) work."


def run_checks(machine: Machine | None = None) -> list[Capability]:
    """Each check once, in a fixed order. Nothing is changed, nothing is sent."""
    machine = machine or Machine()
    checks = [check(machine) for check in CHECKS]
    return (
        [replace(each, remedy=each.remedy.replace("sudo ", "")) for each in checks]
        if machine.is_root
        else checks
    )


def print_checks(checks: Sequence[Capability], console: Console | None = None) -> None:
    """One line for each check, and below a lack its remedy, unbroken, so that it can be pasted."""
    console = console or Console(highlight=False)
    width = max(len(check.name) for check in checks)
    for check in checks:
        for line in _lines(check, width):
            console.print(line, soft_wrap=True)
    lacks = sum(check.status is CapabilityStatus.LACK for check in checks)
    console.print(f"\n{len(checks) - lacks} of {len(checks)} there. {ALWAYS}", soft_wrap=True)


def _lines(check: Capability, width: int) -> list[Text]:
    style = "green" if check.status is CapabilityStatus.OK else "yellow"
    first = Text.assemble(
        (f"{check.status.value:<6}", style),
        f"{check.name:<{width}}  {check.detail}",
        (f"  (for {check.needed_for})", "dim"),
    )
    remedy = Text(f"{'':<{width + 8}}{check.remedy}", style="bold")
    return [first, remedy] if check.remedy else [first]

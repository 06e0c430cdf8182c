"""``hil doctor``: what this machine can do, and the exact command that mends each lack."""

from collections.abc import Callable, Sequence
from typing import Final

from rich.console import Console
from rich.text import Text

from hil.machine import doctor_bus, doctor_machine
from hil.machine.capability import Capability, CapabilityStatus, Look, Machine

CHECKS: Final[tuple[tuple[str, str, Callable[[Machine], Look]], ...]] = (
    ("SocketCAN", "--bus socketcan:...", doctor_bus.socketcan),
    ("vcan driver", "--bus socketcan:vcan0", doctor_bus.vcan_module),
    ("vcan0", "--bus socketcan:vcan0", doctor_bus.vcan_interface),
    ("CAN interfaces", "--bus socketcan:can0", doctor_bus.real_interfaces),
    ("CAP_NET_ADMIN", "making and setting CAN interfaces", doctor_bus.net_admin),
    ("python-can adapters", "--bus pcan:..., kvaser:..., gs_usb:..., ...", doctor_bus.adapters),
    ("serial ports", "--bus slcan:/dev/...", doctor_bus.serial_ports),
    ("User Mode Linux", "make test-vcan where the kernel has no SocketCAN", doctor_bus.user_mode_linux),
    ("real-time priority", "low lateness on a real-time bus", doctor_machine.realtime_scheduling),
    ("locked memory", "no page of the loop written out to disk", doctor_machine.locked_memory),
    ("processors", "loop, simulated drive and logger at 1 kHz in real time", doctor_machine.processors),
    ("processor frequency", "low lateness on a real-time bus", doctor_machine.frequency_governor),
    ("Rerun viewer", "hil run --view, and looking at a recording", doctor_machine.viewer),
    ("display", "hil run --view", doctor_machine.display),
    ("Vulkan driver", "pictures of a recording without a screen", doctor_machine.headless_vulkan),
    ("disk space", "recordings in the present folder", doctor_machine.disk_space),
    (
        "compiled modules",
        "pace: interpreted, everything works several times slower",
        doctor_machine.compiled_modules,
    ),
)
"""Name, what of the bench depends on it, and who looks."""

ALWAYS = "Whatever is lacking, --bus simulated (simulated time) and --bus hub:NAME (real time) work."


def run_checks(machine: Machine | None = None) -> list[Capability]:
    """Each check once, in a fixed order. Nothing is changed, nothing is sent."""
    machine = machine or Machine()
    checks = []
    for name, needed_for, look in CHECKS:
        detail, remedy = look(machine)
        status = CapabilityStatus.LACK if remedy else CapabilityStatus.OK
        remedy = remedy.replace("sudo ", "") if machine.is_root else remedy
        checks.append(Capability(name, status, detail, needed_for, remedy))
    return checks


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

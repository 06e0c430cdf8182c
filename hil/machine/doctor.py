"""``hil doctor``: the capabilities of this machine, and the command that cures each lack."""

import logging
import os
import resource
import shutil
import socket
import sysconfig
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, Literal, NamedTuple

import can
from rich.console import Console
from rich.text import Text
from serial.tools import list_ports

from servobench.design.core.build import check_built
from servobench.drivers import compiled
from servobench.drivers.errors import BadInput
from servobench.drivers.wire.adapters import link_up_command, socketcan_links
from servobench.drivers.wire.attached import can_links, link_advice


class Look(NamedTuple):
    """Result of one check."""

    detail: str
    """A few words."""
    remedy: str = ""
    """The command that cures a lack, or an alternative; empty if nothing is lacking."""


@dataclass(frozen=True, slots=True)
class Capability:
    """One capability of the machine."""

    name: str
    status: Literal["ok", "lack"]
    detail: str
    needed_for: str
    """Part of the bench that depends on it."""
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Machine:
    """The files, limits and environment that the checks read; a test passes its own."""

    root: Path = Path("/")
    """Root of proc, sys, dev, usr and lib."""
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))
    limits: Mapping[int, int] = field(default_factory=lambda: _soft_limits())
    """resource.RLIMIT_* -> soft limit."""
    release: str = field(default_factory=lambda: os.uname().release)
    """The kernel's release, as ``uname -r`` says it."""
    cpu_count: int = field(default_factory=lambda: len(os.sched_getaffinity(0)))
    """Processors that this process may use."""
    is_root: bool = field(default_factory=lambda: os.geteuid() == 0)
    """True if commands need no sudo."""
    in_checkout: bool = field(default_factory=lambda: (compiled.ROOT / ".ci").is_dir())
    """True if this program is its own sources, with their scripts and tests."""

    def path(self, *parts: str) -> Path:
        """Return a path below the root, e.g. ``path("sys", "class", "net")``."""
        return self.root.joinpath(*parts)

    def text(self, *parts: str) -> str:
        """Return a small file's text without its last line end; empty if it cannot be read."""
        try:
            return self.path(*parts).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return ""

    def has_privilege(self, number: int) -> bool:
        """Return True if this process has the capability ``number`` of capabilities(7) in effect."""
        for line in self.text("proc", "self", "status").splitlines():
            if line.startswith("CapEff:"):
                return bool(int(line.split()[1], 16) >> number & 1)
        return False

    def program(self, name: str) -> str | None:
        """Return the program ``name`` on the search path, as ``which`` finds it below the root."""
        folders = self.environment.get("PATH", "").split(os.pathsep)
        return shutil.which(name, path=os.pathsep.join(str(self.path(each.lstrip("/"))) for each in folders))


def _soft_limits() -> dict[int, int]:
    kinds = (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK)
    return {kind: resource.getrlimit(kind)[0] for kind in kinds}


CAP_NET_ADMIN, CAP_IPC_LOCK, CAP_SYS_NICE = 12, 14, 23
"""<linux/capability.h>"""

NOT_HARDWARE = frozenset(
    {"hub", "simulated", "virtual", "udp_multicast", "socketcand", "socketcan", "serial", "slcan"}
)
"""Interfaces of python-can without an adapter of their own, or looked at in another way here.

``socketcand`` would listen on the network for seconds.
"""

INSTEAD = "use --bus hub:NAME, which needs no SocketCAN"


def socketcan(machine: Machine) -> Look:
    """Check that the kernel provides CAN sockets."""
    if kernel_has_can():
        return Look(f"kernel {machine.release}")
    if _module_exists(machine, "can-raw"):
        return Look("built as a module, not loaded", "sudo modprobe can-raw")
    remedy = f"{INSTEAD}, or .ci/uml/run -- COMMAND" if machine.in_checkout else INSTEAD
    return Look(f"kernel {machine.release} has none", remedy)


def kernel_has_can() -> bool:
    """Return True if a CAN_RAW socket can be opened."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def vcan_module(machine: Machine) -> Look:
    """Check that the kernel can make virtual CAN interfaces."""
    if machine.path("sys", "module", "vcan").exists():
        return Look("loaded")
    if _module_exists(machine, "vcan"):
        return Look("there, not loaded", "sudo modprobe vcan")
    return Look("this kernel has none", INSTEAD)


def vcan_interface(machine: Machine) -> Look:
    """Check that vcan0 exists and is up."""
    interfaces = can_interfaces(machine)
    if interfaces.get("vcan0"):
        return Look("up")
    if "vcan0" in interfaces:
        return Look("down", "sudo ip link set vcan0 up")
    if vcan_module(machine).remedy == INSTEAD:
        return Look("this kernel cannot make it", INSTEAD)
    make = "sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up"
    return Look("not there", make)


def real_interfaces(machine: Machine) -> Look:
    """Check for CAN interfaces of the kernel that are not virtual."""
    interfaces = {
        key: up for key, up in can_interfaces(machine).items() if not key.startswith(("vcan", "vxcan"))
    }
    down = [key for key, up in interfaces.items() if not up]
    if down:
        return Look(f"{', '.join(down)} down", f"sudo {link_up_command(down[0])}")
    if interfaces:
        return Look(f"{', '.join(interfaces)} up")
    return Look("none", "plug in an adapter that the kernel drives (lsusb, dmesg)")


def interface_settings(machine: Machine) -> Look:
    """Check that the CAN adapters of the kernel are set up for a bench."""
    links = can_links(machine.path("sys", "class", "net"))
    advice = [text for link in links for text in link_advice(link)]
    if advice:
        what, _, command = advice[0].partition(": ")
        more = f", and {len(advice) - 1} more (hil scan)" if len(advice) > 1 else ""
        return Look(f"{what}{more}", f"sudo sh -c '{command}'")
    known = [link.name for link in links if link.kind == "can" and link.up]
    return Look(f"{', '.join(known)} fit" if known else "no adapter that is up")


def can_interfaces(machine: Machine) -> dict[str, bool]:
    """Return name -> up, for each CAN interface of the kernel."""
    links = socketcan_links(machine.path("sys", "class", "net"))
    return {link.spec.removeprefix("socketcan:"): link.usable for link in links}


def net_admin(machine: Machine) -> Look:
    """Check that this process may create and set CAN interfaces; using one needs no privilege."""
    if machine.has_privilege(CAP_NET_ADMIN):
        return Look("granted")
    return Look("not granted", "put sudo before the ip link commands")


def adapters(_machine: Machine) -> Look:
    """Check for adapters that python-can finds by itself, through the vendors' libraries."""
    detected = detected_adapters()
    if detected:
        return Look(", ".join(detected))
    return Look("none found", "plug in the adapter and install its vendor's library, then hil doctor again")


def detected_adapters() -> list[str]:
    """Return ``interface:channel`` of each adapter found."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)  # each vendor library that is not installed is a warning
    try:
        interfaces = sorted(can.VALID_INTERFACES - NOT_HARDWARE)
        configs = can.detect_available_configs(interfaces, timeout=2.0)
    finally:
        logging.disable(before)
    return [f"{config['interface']}:{config['channel']}" for config in configs]


def serial_ports(_machine: Machine) -> Look:
    """Check for serial ports with a device, for slcan adapters and load machines."""
    ports = sorted(port.device for port in list_ports.comports() if port.vid is not None)
    closed = [port for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    if closed:
        return Look(
            f"no permission for {', '.join(closed)}", 'sudo usermod -aG dialout "$USER", then log in again'
        )
    if ports:
        return Look(", ".join(ports))
    return Look("no USB serial adapter", "plug in the adapter")


def user_mode_linux(machine: Machine) -> Look:
    """Check that a kernel with SocketCAN can be started as a process, for the tests of a checkout."""
    if kernel := machine.program("linux.uml"):
        return Look(kernel)
    return Look("not installed", "sudo apt-get install user-mode-linux kmod iproute2 gcc libc6-dev")


def _module_exists(machine: Machine, module: str) -> bool:
    folder = ("lib", "modules", machine.release)
    listed = machine.text(*folder, "modules.dep") + machine.text(*folder, "modules.builtin")
    return f"/{module}.ko" in listed


RTPRIO_MIN = 50
"""Priority of SCHED_FIFO used by hil/machine/realtime.py."""
MEMLOCK_MIN_BYTES = 1 << 30
"""A loop process with numpy and its rings, with room to spare."""
DISK_MIN_BYTES = 2 << 30
"""An hour's recording at 1 kHz with raw frames, with room to spare."""
CPU_COUNT_MIN = 2
"""One for the loop alone."""
LIMITS_FILE = "/etc/security/limits.d/servobench.conf"


def realtime_scheduling(machine: Machine) -> Look:
    """Check that the loop's process may run under SCHED_FIFO."""
    if machine.has_privilege(CAP_SYS_NICE):
        return Look("CAP_SYS_NICE")
    return _limited(machine.limits[resource.RLIMIT_RTPRIO], RTPRIO_MIN, "", "rtprio", "80")


def locked_memory(machine: Machine) -> Look:
    """Check that the loop's process may lock its memory."""
    if machine.has_privilege(CAP_IPC_LOCK):
        return Look("CAP_IPC_LOCK")
    limit = machine.limits[resource.RLIMIT_MEMLOCK]
    return _limited(limit, MEMLOCK_MIN_BYTES, " bytes", "memlock", "unlimited")


def _limited(limit: int, least: int, unit: str, kind: str, value: str) -> Look:
    """Check that a limit of this process is at least ``least``; ``value``: its new value otherwise."""
    unlimited = limit == resource.RLIM_INFINITY
    if unlimited or limit >= least:
        return Look(f"up to {'no limit' if unlimited else limit}{unit}")
    raising = f'echo "$USER - {kind} {value}" | sudo tee -a {LIMITS_FILE}, then log in again'
    return Look(f"limit {kind} is {limit}{unit}", raising)


def processors(machine: Machine) -> Look:
    """Check that loop, drive and logger need not share one processor."""
    detail = f"{machine.cpu_count} usable"
    if machine.cpu_count >= CPU_COUNT_MIN:
        return Look(detail)
    return Look(detail, "take a longer loop.period_us, or --bus simulated")


def frequency_governor(machine: Machine) -> Look:
    """Check that the processor holds its clock frequency."""
    cpufreq = ("sys", "devices", "system", "cpu", "cpu0", "cpufreq", "scaling_governor")
    governor = machine.text(*cpufreq)
    if governor in ("", "performance"):
        return Look(governor or "not scaled by this kernel")
    return Look(f"governor {governor}", "sudo cpupower frequency-set --governor performance")


def viewer(_machine: Machine) -> Look:
    """Check that the Rerun viewer is installed."""
    beside = Path(sysconfig.get_path("scripts")) / "rerun"
    path = str(beside) if beside.exists() else shutil.which("rerun")
    if path:
        return Look(path)
    return Look("not found", "pip install 'servobench[view]'")


def display(machine: Machine) -> Look:
    """Check that a window can be opened."""
    for variable in ("WAYLAND_DISPLAY", "DISPLAY"):
        if value := machine.environment.get(variable):
            return Look(f"{variable}={value}")
    return Look("none", "open the .rrd on a machine with a screen: rerun FILE.rrd")


def headless_vulkan(machine: Machine) -> Look:
    """Check that pictures of a recording can be drawn without a screen."""
    folders = (machine.path("usr", "share", "vulkan", "icd.d"), machine.path("etc", "vulkan", "icd.d"))
    drivers = sorted(file.stem.partition("_icd")[0] for folder in folders for file in folder.glob("*.json"))
    if drivers:
        return Look(", ".join(drivers))
    return Look("none installed", "sudo apt-get install mesa-vulkan-drivers")


def disk_space(_machine: Machine) -> Look:
    """Check that a long recording fits into the present folder."""
    free = shutil.disk_usage(Path.cwd()).free
    detail = f"{free / 1e9:.1f} GB free"
    if free >= DISK_MIN_BYTES:
        return Look(detail)
    return Look(detail, "hil run --record DIR with a DIR on a larger disk")


def compiled_modules(_machine: Machine) -> Look:
    """Check that the modules run in every cycle are compiled."""
    build = compiled.use_fresh()
    if not build.why:
        return Look(", ".join(build.compiled))
    held_back = f"{', '.join(build.held_back)} interpreted, " if build.held_back and build.compiled else ""
    return Look(f"{held_back or 'all interpreted, '}{build.why}", compiled.remedy())


def native_core(_machine: Machine) -> Look:
    """Check that each room's core is built from its present sources."""
    try:
        import servobench.virtual_bus.core  # noqa: F401

        check_built("design", partial(BadInput, "design", "core"))
    except BadInput as lack:
        return Look(f"{lack.value}", lack.expected)
    return Look("built from these sources")


CHECKS: Final[tuple[tuple[str, str, Callable[[Machine], Look]], ...]] = (
    ("SocketCAN", "--bus socketcan:...", socketcan),
    ("vcan driver", "--bus socketcan:vcan0", vcan_module),
    ("vcan0", "--bus socketcan:vcan0", vcan_interface),
    ("CAN interfaces", "--bus socketcan:can0", real_interfaces),
    ("CAN settings", "--bus socketcan:can0", interface_settings),
    ("CAP_NET_ADMIN", "making and setting CAN interfaces", net_admin),
    ("python-can adapters", "--bus pcan:..., kvaser:..., gs_usb:..., ...", adapters),
    ("serial ports", "--bus slcan:/dev/...", serial_ports),
    ("User Mode Linux", "make test-vcan where the kernel has no SocketCAN", user_mode_linux),
    ("real-time priority", "low lateness on a real-time bus", realtime_scheduling),
    ("locked memory", "no page of the loop written out to disk", locked_memory),
    ("processors", "loop, simulated drive and logger at 1 kHz in real time", processors),
    ("processor frequency", "low lateness on a real-time bus", frequency_governor),
    ("Rerun viewer", "hil run --view, and looking at a recording", viewer),
    ("display", "hil run --view", display),
    ("Vulkan driver", "pictures of a recording without a screen", headless_vulkan),
    ("disk space", "recordings in the present folder", disk_space),
    ("native core", "everything simulated, and each bus", native_core),
    ("compiled modules", "pace: interpreted, everything works several times slower", compiled_modules),
)
"""Name, dependent part of the bench, and the check."""

ALWAYS = "--bus simulated (simulated time) and --bus hub:NAME (real time) always work."


def run_checks(machine: Machine | None = None) -> list[Capability]:
    """Run each check once, in a fixed order. Nothing is changed, nothing is sent."""
    machine = machine or Machine()
    checks = []
    for name, needed_for, look in CHECKS:
        if look is user_mode_linux and not machine.in_checkout:
            continue
        detail, remedy = look(machine)
        remedy = remedy.replace("sudo ", "") if machine.is_root else remedy
        checks.append(Capability(name, "lack" if remedy else "ok", detail, needed_for, remedy))
    return checks


def print_checks(checks: Sequence[Capability], console: Console | None = None) -> None:
    """Print one line per check, and below a lack its remedy, unbroken, for pasting."""
    console = console or Console(highlight=False)
    width = max(len(check.name) for check in checks)
    for check in checks:
        for line in _lines(check, width):
            console.print(line, soft_wrap=True)
    lacks = sum(check.status == "lack" for check in checks)
    console.print(f"\n{len(checks) - lacks} of {len(checks)} available. {ALWAYS}", soft_wrap=True)


def _lines(check: Capability, width: int) -> list[Text]:
    style = "green" if check.status == "ok" else "yellow"
    first = Text.assemble(
        (f"{check.status:<6}", style),
        f"{check.name:<{width}}  {check.detail}",
        (f"  (for {check.needed_for})", "dim"),
    )
    remedy = Text(f"{'':<{width + 8}}{check.remedy}", style="bold")
    return [first, remedy] if check.remedy else [first]

"""What this machine can do beside the bus: scheduling, memory, processors, viewer, disk; what is compiled."""

import resource
import shutil
import sysconfig
from pathlib import Path

from drivers import compiled
from hil.machine.capability import Capability, Machine, capable, lacking

CAP_IPC_LOCK = 14
CAP_SYS_NICE = 23

RTPRIO_MIN = 50
"""hil/machine/realtime.py asks for this priority of SCHED_FIFO."""
MEMLOCK_MIN_BYTES = 1 << 30
"""A loop process with numpy, numba and its rings, with room to spare."""
DISK_MIN_BYTES = 2 << 30
"""An hour's recording at 1 kHz with raw frames, with room to spare."""
CPU_COUNT_MIN = 2

LIMITS_FILE = "/etc/security/limits.d/servobench.conf"


def realtime_scheduling(machine: Machine) -> Capability:
    """Whether the loop's process may run under SCHED_FIFO."""
    name, needed_for = "real-time priority", "low lateness on a real-time bus"
    limit = machine.limits[resource.RLIMIT_RTPRIO]
    if machine.has_privilege(CAP_SYS_NICE):
        return capable(name, "CAP_SYS_NICE", needed_for)
    if limit == resource.RLIM_INFINITY or limit >= RTPRIO_MIN:
        return capable(name, f"up to {_limit_text(limit)}", needed_for)
    return lacking(name, f"limit rtprio is {limit}", needed_for, _raise_limit("rtprio", "80"))


def locked_memory(machine: Machine) -> Capability:
    """Whether the loop's process may lock its memory."""
    name, needed_for = "locked memory", "no page of the loop written out to disk"
    limit = machine.limits[resource.RLIMIT_MEMLOCK]
    if machine.has_privilege(CAP_IPC_LOCK):
        return capable(name, "CAP_IPC_LOCK", needed_for)
    if limit == resource.RLIM_INFINITY or limit >= MEMLOCK_MIN_BYTES:
        return capable(name, f"up to {_limit_text(limit)} bytes", needed_for)
    return lacking(name, f"limit memlock is {limit} bytes", needed_for, _raise_limit("memlock", "unlimited"))


def processors(machine: Machine) -> Capability:
    """Whether the loop, the drive and the logger need not share one processor."""
    name, needed_for = "processors", "loop, simulated drive and logger at 1 kHz in real time"
    detail = f"{machine.cpu_count} usable"
    if machine.cpu_count >= CPU_COUNT_MIN:
        return capable(name, detail, needed_for)
    return lacking(name, detail, needed_for, "take a longer loop.period_us, or --bus simulated")


def frequency_governor(machine: Machine) -> Capability:
    """Whether the processor holds its clock frequency."""
    name, needed_for = "processor frequency", "low lateness on a real-time bus"
    cpufreq = ("sys", "devices", "system", "cpu", "cpu0", "cpufreq", "scaling_governor")
    governor = machine.text(*cpufreq)
    if governor in ("", "performance"):
        return capable(name, governor or "not scaled by this kernel", needed_for)
    remedy = "sudo cpupower frequency-set --governor performance"
    return lacking(name, f"governor {governor}", needed_for, remedy)


def viewer(_machine: Machine) -> Capability:
    """Whether the Rerun viewer is installed beside the bench."""
    name, needed_for = "Rerun viewer", "hil run --view, and looking at a recording"
    beside = Path(sysconfig.get_path("scripts")) / "rerun"
    path = str(beside) if beside.exists() else shutil.which("rerun")
    if path:
        return capable(name, path, needed_for)
    return lacking(name, "not found", needed_for, "pip install rerun-sdk")


def display(machine: Machine) -> Capability:
    """Whether a window can be opened."""
    name, needed_for = "display", "hil run --view"
    for variable in ("WAYLAND_DISPLAY", "DISPLAY"):
        if value := machine.environment.get(variable):
            return capable(name, f"{variable}={value}", needed_for)
    remedy = "open the .rrd on a machine with a screen: rerun FILE.rrd"
    return lacking(name, "none", needed_for, remedy)


def headless_vulkan(machine: Machine) -> Capability:
    """Whether pictures of a recording can be drawn without a screen."""
    name, needed_for = "Vulkan driver", "pictures of a recording without a screen"
    folders = (machine.path("usr", "share", "vulkan", "icd.d"), machine.path("etc", "vulkan", "icd.d"))
    drivers = sorted(file.stem.partition("_icd")[0] for folder in folders for file in folder.glob("*.json"))
    if drivers:
        return capable(name, ", ".join(drivers), needed_for)
    return lacking(name, "none installed", needed_for, "sudo apt-get install mesa-vulkan-drivers")


def disk_space(_machine: Machine) -> Capability:
    """Whether a long recording fits into the present folder."""
    name, needed_for = "disk space", "recordings in the present folder"
    free = shutil.disk_usage(Path.cwd()).free
    detail = f"{free / 1e9:.1f} GB free"
    if free >= DISK_MIN_BYTES:
        return capable(name, detail, needed_for)
    return lacking(name, detail, needed_for, "hil run --record DIR with a DIR on a larger disk")


def compiled_modules(_machine: Machine) -> Capability:
    """Whether the modules that run in every cycle are compiled."""
    name, needed_for = "compiled modules", "pace: interpreted, everything works several times slower"
    build = compiled.use_fresh()
    if not build.why:
        return capable(name, ", ".join(build.compiled), needed_for)
    held_back = f"{', '.join(build.held_back)} interpreted, " if build.held_back and build.compiled else ""
    return lacking(name, f"{held_back or 'all interpreted, '}{build.why}", needed_for, compiled.remedy())


def _raise_limit(kind: str, value: str) -> str:
    return f'echo "$USER - {kind} {value}" | sudo tee -a {LIMITS_FILE}, then log in again'


def _limit_text(limit: int) -> str:
    return "no limit" if limit == resource.RLIM_INFINITY else str(limit)


CHECKS = (
    realtime_scheduling,
    locked_memory,
    processors,
    frequency_governor,
    viewer,
    display,
    headless_vulkan,
    disk_space,
    compiled_modules,
)

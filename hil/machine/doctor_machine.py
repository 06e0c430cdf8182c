"""What this machine can do beside the bus: scheduling, memory, processors, viewer, disk; what is compiled."""

import resource
import shutil
import sysconfig
from pathlib import Path

from drivers import compiled
from hil.machine.capability import Look, Machine

CAP_IPC_LOCK = 14
CAP_SYS_NICE = 23

RTPRIO_MIN = 50
"""hil/machine/realtime.py asks for this priority of SCHED_FIFO."""
MEMLOCK_MIN_BYTES = 1 << 30
"""A loop process with numpy, numba and its rings, with room to spare."""
DISK_MIN_BYTES = 2 << 30
"""An hour's recording at 1 kHz with raw frames, with room to spare."""
CPU_COUNT_MIN = 2
"""One for the loop alone."""

LIMITS_FILE = "/etc/security/limits.d/servobench.conf"


def realtime_scheduling(machine: Machine) -> Look:
    """Whether the loop's process may run under SCHED_FIFO."""
    limit = machine.limits[resource.RLIMIT_RTPRIO]
    if machine.has_privilege(CAP_SYS_NICE):
        return Look("CAP_SYS_NICE")
    if limit == resource.RLIM_INFINITY or limit >= RTPRIO_MIN:
        return Look(f"up to {_limit_text(limit)}")
    return Look(f"limit rtprio is {limit}", _raise_limit("rtprio", "80"))


def locked_memory(machine: Machine) -> Look:
    """Whether the loop's process may lock its memory."""
    limit = machine.limits[resource.RLIMIT_MEMLOCK]
    if machine.has_privilege(CAP_IPC_LOCK):
        return Look("CAP_IPC_LOCK")
    if limit == resource.RLIM_INFINITY or limit >= MEMLOCK_MIN_BYTES:
        return Look(f"up to {_limit_text(limit)} bytes")
    return Look(f"limit memlock is {limit} bytes", _raise_limit("memlock", "unlimited"))


def processors(machine: Machine) -> Look:
    """Whether the loop, the drive and the logger need not share one processor."""
    detail = f"{machine.cpu_count} usable"
    if machine.cpu_count >= CPU_COUNT_MIN:
        return Look(detail)
    return Look(detail, "take a longer loop.period_us, or --bus simulated")


def frequency_governor(machine: Machine) -> Look:
    """Whether the processor holds its clock frequency."""
    cpufreq = ("sys", "devices", "system", "cpu", "cpu0", "cpufreq", "scaling_governor")
    governor = machine.text(*cpufreq)
    if governor in ("", "performance"):
        return Look(governor or "not scaled by this kernel")
    return Look(f"governor {governor}", "sudo cpupower frequency-set --governor performance")


def viewer(_machine: Machine) -> Look:
    """Whether the Rerun viewer is installed beside the bench."""
    beside = Path(sysconfig.get_path("scripts")) / "rerun"
    path = str(beside) if beside.exists() else shutil.which("rerun")
    if path:
        return Look(path)
    return Look("not found", "pip install rerun-sdk")


def display(machine: Machine) -> Look:
    """Whether a window can be opened."""
    for variable in ("WAYLAND_DISPLAY", "DISPLAY"):
        if value := machine.environment.get(variable):
            return Look(f"{variable}={value}")
    return Look("none", "open the .rrd on a machine with a screen: rerun FILE.rrd")


def headless_vulkan(machine: Machine) -> Look:
    """Whether pictures of a recording can be drawn without a screen."""
    folders = (machine.path("usr", "share", "vulkan", "icd.d"), machine.path("etc", "vulkan", "icd.d"))
    drivers = sorted(file.stem.partition("_icd")[0] for folder in folders for file in folder.glob("*.json"))
    if drivers:
        return Look(", ".join(drivers))
    return Look("none installed", "sudo apt-get install mesa-vulkan-drivers")


def disk_space(_machine: Machine) -> Look:
    """Whether a long recording fits into the present folder."""
    free = shutil.disk_usage(Path.cwd()).free
    detail = f"{free / 1e9:.1f} GB free"
    if free >= DISK_MIN_BYTES:
        return Look(detail)
    return Look(detail, "hil run --record DIR with a DIR on a larger disk")


def compiled_modules(_machine: Machine) -> Look:
    """Whether the modules that run in every cycle are compiled."""
    build = compiled.use_fresh()
    if not build.why:
        return Look(", ".join(build.compiled))
    held_back = f"{', '.join(build.held_back)} interpreted, " if build.held_back and build.compiled else ""
    return Look(f"{held_back or 'all interpreted, '}{build.why}", compiled.remedy())


def _raise_limit(kind: str, value: str) -> str:
    return f'echo "$USER - {kind} {value}" | sudo tee -a {LIMITS_FILE}, then log in again'


def _limit_text(limit: int) -> str:
    return "no limit" if limit == resource.RLIM_INFINITY else str(limit)

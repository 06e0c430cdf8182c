"""``hil doctor`` word by word: what each check finds, and the command that mends what is lacking."""

import ctypes
import gc
import os
import resource
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest

from servobench.drivers import compiled
from servobench.hil.machine import doctor
from servobench.hil.machine.doctor import Look, Machine
from servobench.hil.machine.realtime import quiet_garbage_collector, realtime_process, timing_conditions
from tests.unit.hil.test_doctor import DOWN, RELEASE, UP, machine, put, put_interface, put_privilege

__all__ = ["machine"]

HUB: Final = "use --bus hub:NAME, which needs no SocketCAN"
RAISED: Final = "sudo tee -a /etc/security/limits.d/servobench.conf, then log in again"


def with_limit(machine: Machine, kind: int, limit: int) -> Machine:
    return replace(machine, limits={kind: limit})


@pytest.mark.parametrize(
    ("limit", "look"),
    [
        (
            49,
            Look("limit rtprio is 49", f'echo "$USER - rtprio 80" | {RAISED}'),
        ),
        (50, Look("up to 50")),
        (resource.RLIM_INFINITY, Look("up to no limit")),
    ],
)
def test_real_time_priority(machine: Machine, limit: int, look: Look) -> None:
    assert doctor.realtime_scheduling(with_limit(machine, resource.RLIMIT_RTPRIO, limit)) == look


@pytest.mark.parametrize(
    ("limit", "look"),
    [
        (
            (1 << 30) - 1,
            Look(
                "limit memlock is 1073741823 bytes",
                f'echo "$USER - memlock unlimited" | {RAISED}',
            ),
        ),
        (1 << 30, Look("up to 1073741824 bytes")),
        (resource.RLIM_INFINITY, Look("up to no limit bytes")),
    ],
)
def test_locked_memory(machine: Machine, limit: int, look: Look) -> None:
    assert doctor.locked_memory(with_limit(machine, resource.RLIMIT_MEMLOCK, limit)) == look


def test_privileges_stand_for_limits(machine: Machine) -> None:
    put_privilege(machine, 14)
    assert doctor.locked_memory(machine) == Look("CAP_IPC_LOCK")
    put_privilege(machine, 23)
    assert doctor.realtime_scheduling(machine) == Look("CAP_SYS_NICE")
    put_privilege(machine, 12)
    assert doctor.net_admin(machine) == Look("granted")


def test_a_status_without_capabilities_grants_none(machine: Machine) -> None:
    assert not machine.has_privilege(0)
    put(machine, "proc/self/status", "Name:\tpython\nCapPrm:\tffffffffffffffff\nCapEff:\t0000000000000001\n")
    assert [machine.has_privilege(number) for number in (0, 1, 12)] == [True, False, False]


@pytest.mark.parametrize(
    ("count", "remedy"), [(1, "take a longer loop.period_us, or --bus simulated"), (2, ""), (64, "")]
)
def test_processors(machine: Machine, count: int, remedy: str) -> None:
    assert doctor.processors(replace(machine, cpu_count=count)) == Look(f"{count} usable", remedy)


@pytest.mark.parametrize(
    ("governor", "look"),
    [
        (None, Look("not scaled by this kernel")),
        ("performance\n", Look("performance")),
        ("ondemand\n", Look("governor ondemand", "sudo cpupower frequency-set --governor performance")),
    ],
)
def test_frequency(machine: Machine, governor: str | None, look: Look) -> None:
    if governor is not None:
        put(machine, "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", governor)
    assert doctor.frequency_governor(machine) == look


@pytest.mark.parametrize(
    ("environment", "look"),
    [
        ({}, Look("none", "open the .rrd on a machine with a screen: rerun FILE.rrd")),
        ({"DISPLAY": ""}, Look("none", "open the .rrd on a machine with a screen: rerun FILE.rrd")),
        ({"DISPLAY": ":1"}, Look("DISPLAY=:1")),
        ({"DISPLAY": ":1", "WAYLAND_DISPLAY": "wayland-0"}, Look("WAYLAND_DISPLAY=wayland-0")),
    ],
)
def test_display(machine: Machine, environment: dict[str, str], look: Look) -> None:
    assert doctor.display(replace(machine, environment=environment)) == look


def test_vulkan(machine: Machine) -> None:
    lack = Look("none installed", "sudo apt-get install mesa-vulkan-drivers")
    assert doctor.headless_vulkan(machine) == lack
    put(machine, "etc/vulkan/icd.d/nvidia_icd.json")
    put(machine, "usr/share/vulkan/icd.d/lvp_icd.x86_64.json")
    put(machine, "usr/share/vulkan/icd.d/readme.txt")
    assert doctor.headless_vulkan(machine) == Look("lvp, nvidia")


def test_the_viewer_beside_the_bench_comes_before_that_of_the_path(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sysconfig.get_path", lambda _kind: str(tmp_path))
    elsewhere: list[str | None] = [None]
    monkeypatch.setattr("shutil.which", lambda _name: elsewhere[0])
    assert doctor.viewer(machine) == Look("not found", "pip install 'servobench[view]'")
    elsewhere[0] = "/usr/bin/rerun"
    assert doctor.viewer(machine) == Look("/usr/bin/rerun")
    (tmp_path / "rerun").touch()
    assert doctor.viewer(machine) == Look(str(tmp_path / "rerun"))


@pytest.mark.parametrize(
    ("free", "look"),
    [
        ((2 << 30) - 1, Look("2.1 GB free", "hil run --record DIR with a DIR on a larger disk")),
        (2 << 30, Look("2.1 GB free")),
        (123_456_789_012, Look("123.5 GB free")),
    ],
)
def test_disk(machine: Machine, free: int, look: Look, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _folder: SimpleNamespace(free=free))
    assert doctor.disk_space(machine) == look


@pytest.mark.parametrize(
    ("groups", "held_back", "why", "look"),
    [
        (("wire", "loop"), (), "", Look("wire, loop")),
        (("wire",), ("loop", "bus"), "edited", Look("loop, bus interpreted, edited", "make it")),
        ((), ("wire",), "edited", Look("all interpreted, edited", "make it")),
        ((), (), "never compiled", Look("all interpreted, never compiled", "make it")),
    ],
)
def test_compiled_modules(
    machine: Machine,
    monkeypatch: pytest.MonkeyPatch,
    groups: tuple[str, ...],
    held_back: tuple[str, ...],
    why: str,
    look: Look,
) -> None:
    build = SimpleNamespace(compiled=groups, held_back=held_back, why=why)
    monkeypatch.setattr(compiled, "use_fresh", lambda: build)
    monkeypatch.setattr(compiled, "remedy", lambda: "make it")
    assert doctor.compiled_modules(machine) == look


# ---- the bus ------------------------------------------------------------------------------------------


def test_socketcan(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    there = [False]
    monkeypatch.setattr(doctor, "kernel_has_can", lambda: there[0])
    lack = Look(f"kernel {RELEASE} has none", f"{HUB}, or .ci/uml/run -- COMMAND")
    assert doctor.socketcan(machine) == lack
    assert doctor.socketcan(replace(machine, in_checkout=False)) == Look(lack.detail, HUB)
    put(machine, f"lib/modules/{RELEASE}/modules.builtin", "kernel/net/can/can-raw.ko\n")
    assert doctor.socketcan(machine) == Look("built as a module, not loaded", "sudo modprobe can-raw")
    there[0] = True
    assert doctor.socketcan(machine) == Look(f"kernel {RELEASE}")


def test_a_socket_that_cannot_be_opened_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_arguments: object) -> None:
        raise OSError

    opened: list[tuple[object, ...]] = []

    def allow(*arguments: object) -> Any:
        opened.append(arguments)
        return SimpleNamespace(close=lambda: opened.append(()))

    monkeypatch.setattr("socket.socket", refuse)
    assert not doctor.kernel_has_can()
    monkeypatch.setattr("socket.socket", allow)
    assert doctor.kernel_has_can()
    assert len(opened) == 2
    assert opened[1] == (), "and closed"


def test_virtual_interfaces(machine: Machine) -> None:
    modules = f"lib/modules/{RELEASE}/modules.dep"
    assert doctor.vcan_module(machine) == Look("this kernel has none", HUB)
    assert doctor.vcan_interface(machine) == Look("this kernel cannot make it", HUB)
    put(machine, modules, "kernel/drivers/net/can/vcan.ko: \n")
    make = "sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up"
    assert doctor.vcan_module(machine) == Look("there, not loaded", "sudo modprobe vcan")
    assert doctor.vcan_interface(machine) == Look("not there", make)
    machine.path(modules).unlink()
    put(machine, "sys/module/vcan/refcnt")
    assert doctor.vcan_module(machine) == Look("loaded")
    assert doctor.vcan_interface(machine) == Look("not there", make)
    put_interface(machine, "vcan0", DOWN)
    assert doctor.vcan_interface(machine) == Look("down", "sudo ip link set vcan0 up")
    put_interface(machine, "vcan0", UP)
    assert doctor.vcan_interface(machine) == Look("up")


def test_real_interfaces(machine: Machine) -> None:
    put_interface(machine, "vxcan1", DOWN)
    put_interface(machine, "vcan0", DOWN)
    lack = Look("none", "plug in an adapter that the kernel drives (lsusb, dmesg)")
    assert doctor.real_interfaces(machine) == lack
    put_interface(machine, "can0", UP)
    put_interface(machine, "can1", UP)
    assert doctor.can_interfaces(machine) == {"vxcan1": False, "vcan0": False, "can0": True, "can1": True}
    assert doctor.real_interfaces(machine) == Look("can0, can1 up")
    put_interface(machine, "can1", DOWN)
    put_interface(machine, "can2", DOWN)
    detail, remedy = doctor.real_interfaces(machine)
    assert detail == "can1, can2 down"
    assert remedy.startswith("sudo ip link set can1 up type can bitrate")


def test_adapters_are_named_as_they_are_opened(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[list[str], float]] = []
    found: list[dict[str, object]] = []

    def detect(interfaces: list[str], timeout: float) -> list[dict[str, object]]:
        asked.append((interfaces, timeout))
        return found

    monkeypatch.setattr("can.detect_available_configs", detect)
    lack = Look("none found", "plug in the adapter and install its vendor's library, then hil doctor again")
    assert doctor.adapters(machine) == lack
    found += [{"interface": "pcan", "channel": "PCAN_USBBUS1"}, {"interface": "kvaser", "channel": 0}]
    assert doctor.adapters(machine) == Look("pcan:PCAN_USBBUS1, kvaser:0")
    (interfaces, timeout), _ = asked
    assert timeout == 2.0
    assert interfaces == sorted(interfaces)
    assert {"pcan", "kvaser"} <= set(interfaces)
    assert not {"socketcan", "socketcand", "virtual", "slcan", "hub", "simulated"} & set(interfaces)


def test_serial_ports(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    ports: list[Any] = [SimpleNamespace(device="/dev/ttyS0", vid=None)]
    closed: set[str] = set()
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    monkeypatch.setattr("os.access", lambda port, mode: mode == os.R_OK | os.W_OK and port not in closed)
    assert doctor.serial_ports(machine) == Look("no USB serial adapter", "plug in the adapter")
    ports += [SimpleNamespace(device=f"/dev/ttyUSB{number}", vid=7) for number in (1, 0)]
    assert doctor.serial_ports(machine) == Look("/dev/ttyUSB0, /dev/ttyUSB1")
    closed.add("/dev/ttyUSB1")
    assert doctor.serial_ports(machine) == Look(
        "no permission for /dev/ttyUSB1", 'sudo usermod -aG dialout "$USER", then log in again'
    )


def test_user_mode_linux(machine: Machine) -> None:
    lack = Look("not installed", "sudo apt-get install user-mode-linux kmod iproute2 gcc libc6-dev")
    assert doctor.user_mode_linux(machine) == lack
    kernel = put(machine, "opt/linux.uml")
    kernel.chmod(0o755)
    searching = replace(machine, environment={"PATH": f"/bin{os.pathsep}/opt"})
    assert doctor.user_mode_linux(searching) == Look(str(kernel))


# ---- real time ----------------------------------------------------------------------------------------


class Kernel:
    """In the place of libc and the scheduler: what it was asked, and what it refuses."""

    def __init__(self, *refuses: str) -> None:
        self.asked: list[tuple[object, ...]] = []
        self._refuses = refuses

    def prctl(self, *arguments: int) -> int:
        self.asked.append(("prctl", *arguments))
        return -1 if "prctl" in self._refuses else 0

    def mlockall(self, flags: int) -> int:
        self.asked.append(("mlockall", flags))
        return -1 if "mlockall" in self._refuses else 0

    def munlockall(self) -> int:
        self.asked.append(("munlockall",))
        return 0

    def setscheduler(self, process: int, policy: int, parameter: Any) -> None:
        if policy == os.SCHED_FIFO and "scheduler" in self._refuses:
            raise PermissionError
        self.asked.append((process, policy, parameter.sched_priority))


@pytest.fixture
def of_kernel(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Kernel]:
    def make(*refuses: str) -> Kernel:
        kernel = Kernel(*refuses)
        monkeypatch.setattr("gc.collect", lambda: 0)  # of all that pytest has, it takes a while
        monkeypatch.setattr(ctypes, "CDLL", lambda *_arguments, **_options: kernel)
        monkeypatch.setattr(os, "sched_setscheduler", kernel.setscheduler)
        monkeypatch.setattr(os, "sched_getscheduler", lambda _process: os.SCHED_OTHER)
        monkeypatch.setattr(os, "sched_getparam", lambda _process: os.sched_param(0))
        return kernel

    return make


SLACK: Final = ("prctl", 29, 1, 0, 0, 0)
LOCK: Final = ("mlockall", 1 | 2 | 4)
FIFO: Final = (0, os.SCHED_FIFO, 50)
AS_BEFORE: Final = (0, os.SCHED_OTHER, 0)


@pytest.mark.parametrize(
    ("refuses", "told", "asked"),
    [
        ((), (), [SLACK, LOCK, FIFO, AS_BEFORE, ("munlockall",)]),
        (("prctl",), ("timer slack of 1 ns (prctl)",), [SLACK, LOCK, FIFO, AS_BEFORE, ("munlockall",)]),
        (
            ("mlockall",),
            ("locked memory (mlockall; raise the limit memlock)",),
            [SLACK, LOCK, FIFO, AS_BEFORE],
        ),
        (
            ("scheduler",),
            ("SCHED_FIFO (raise the limit rtprio)",),
            [SLACK, LOCK, AS_BEFORE, ("munlockall",)],
        ),
    ],
)
def test_what_the_kernel_is_asked_and_given_back(
    of_kernel: Callable[..., Kernel],
    refuses: tuple[str, ...],
    told: tuple[str, ...],
    asked: list[tuple[object, ...]],
) -> None:
    kernel = of_kernel(*refuses)

    def fail() -> None:
        with realtime_process() as refused:
            assert refused == told
            assert not gc.isenabled()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert kernel.asked == asked
    assert gc.isenabled()


@pytest.mark.parametrize(
    ("real_time", "privileged", "asks", "collects"),
    [(True, True, True, 1), (True, False, False, 1), (False, True, False, 0), (False, False, False, 0)],
)
def test_the_kernel_is_asked_in_real_time_alone(
    of_kernel: Callable[..., Kernel],
    monkeypatch: pytest.MonkeyPatch,
    real_time: bool,
    privileged: bool,
    asks: bool,
    collects: int,
) -> None:
    kernel, collected = of_kernel("mlockall"), []
    monkeypatch.setattr("gc.collect", lambda: collected.append(1))
    with timing_conditions(real_time, privileged) as refused:
        assert refused == (("locked memory (mlockall; raise the limit memlock)",) if asks else ())
        assert not gc.isenabled()
    assert bool(kernel.asked) is asks
    assert len(collected) == collects
    assert gc.isenabled()


def test_a_collector_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        with quiet_garbage_collector():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()

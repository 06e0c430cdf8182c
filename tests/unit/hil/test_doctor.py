"""The checks of ``hil doctor`` on machines made of a few files."""

import io
import json
import logging
import resource
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from rich.console import Console

from servobench.hil.machine import doctor
from servobench.hil.machine.doctor import CHECKS, Look, Machine, print_checks, run_checks

CheckFunction = Callable[[Machine], Look]
RELEASE = "6.1.0-test"
ARPHRD_CAN = 280
UP, DOWN = "0x41\n", "0x40\n"


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    """A machine with nothing on it."""
    return Machine(
        root=tmp_path,
        environment={},
        limits={resource.RLIMIT_RTPRIO: 0, resource.RLIMIT_MEMLOCK: 8 << 20},
        release=RELEASE,
        cpu_count=1,
        is_root=False,
    )


def put(machine: Machine, path: str, text: str = "") -> Path:
    """Write a file of the machine."""
    file = machine.path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    return file


def put_interface(machine: Machine, name: str, flags: str, kind: int = ARPHRD_CAN) -> None:
    """Give the machine a network interface."""
    put(machine, f"sys/class/net/{name}/type", f"{kind}\n")
    put(machine, f"sys/class/net/{name}/flags", flags)


def put_privilege(machine: Machine, number: int) -> None:
    """Grant one capability to the process."""
    put(machine, "proc/self/status", f"Name:\tpython\nCapEff:\t{1 << number:016x}\n")


def test_socketcan_follows_the_kernel(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "kernel_has_can", lambda: True)
    assert not doctor.socketcan(machine).remedy

    monkeypatch.setattr(doctor, "kernel_has_can", lambda: False)
    without = doctor.socketcan(machine)
    assert "hub:NAME" in without.remedy

    put(
        machine,
        f"lib/modules/{RELEASE}/modules.dep",
        "kernel/net/can/can-raw.ko.xz: kernel/net/can/can.ko.xz\n",
    )
    assert doctor.socketcan(machine).remedy == "sudo modprobe can-raw"


def test_vcan_module_missing_unloaded_loaded(machine: Machine) -> None:
    assert "hub:NAME" in doctor.vcan_module(machine).remedy

    put(machine, f"lib/modules/{RELEASE}/modules.dep", "kernel/drivers/net/can/vcan.ko: \n")
    assert doctor.vcan_module(machine).remedy == "sudo modprobe vcan"

    put(machine, "sys/module/vcan/refcnt", "0")
    assert not doctor.vcan_module(machine).remedy


def test_vcan0_absent_down_up(machine: Machine) -> None:
    assert "hub:NAME" in doctor.vcan_interface(machine).remedy

    put(machine, "sys/module/vcan/refcnt", "0")
    absent = doctor.vcan_interface(machine)
    assert absent.remedy == "sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up"

    put_interface(machine, "vcan0", DOWN)
    assert doctor.vcan_interface(machine).remedy == "sudo ip link set vcan0 up"

    put_interface(machine, "vcan0", UP)
    assert not doctor.vcan_interface(machine).remedy


def test_only_can_interfaces_that_are_not_virtual_count_as_real(machine: Machine) -> None:
    put_interface(machine, "eth0", UP, kind=1)
    put_interface(machine, "vcan0", UP)
    assert doctor.real_interfaces(machine).detail == "none"

    put_interface(machine, "can1", UP)
    assert doctor.real_interfaces(machine).detail == "can1 up"

    put_interface(machine, "can0", DOWN)
    down = doctor.real_interfaces(machine)
    assert down.detail == "can0 down"
    assert "ip link set can0 up type can bitrate" in down.remedy


@pytest.mark.parametrize(
    ("check", "privilege"),
    [
        (doctor.net_admin, doctor.CAP_NET_ADMIN),
        (doctor.realtime_scheduling, doctor.CAP_SYS_NICE),
        (doctor.locked_memory, doctor.CAP_IPC_LOCK),
    ],
)
def test_a_privilege_counts_only_by_its_own_bit(
    machine: Machine, check: CheckFunction, privilege: int
) -> None:
    assert check(machine).remedy
    put_privilege(machine, privilege + 1)
    assert check(machine).remedy
    put_privilege(machine, privilege)
    assert not check(machine).remedy


@pytest.mark.parametrize(
    ("check", "kind", "enough"),
    [
        (doctor.realtime_scheduling, resource.RLIMIT_RTPRIO, doctor.RTPRIO_MIN),
        (doctor.locked_memory, resource.RLIMIT_MEMLOCK, doctor.MEMLOCK_MIN_BYTES),
    ],
)
def test_a_limit_is_enough_from_its_bound_on(
    machine: Machine, check: CheckFunction, kind: int, enough: int
) -> None:
    for limit, lacking in ((enough - 1, True), (enough, False), (resource.RLIM_INFINITY, False)):
        assert bool(check(replace(machine, limits={kind: limit})).remedy) == lacking


def test_processors_and_governor(machine: Machine) -> None:
    assert doctor.processors(machine).remedy
    assert not doctor.processors(replace(machine, cpu_count=2)).remedy

    assert not doctor.frequency_governor(machine).remedy
    governor = "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"
    put(machine, governor, "powersave\n")
    assert "cpupower" in doctor.frequency_governor(machine).remedy
    put(machine, governor, "performance\n")
    assert not doctor.frequency_governor(machine).remedy


def test_display_and_vulkan(machine: Machine) -> None:
    assert doctor.display(machine).remedy
    assert doctor.display(replace(machine, environment={"DISPLAY": ":0"})).detail == "DISPLAY=:0"

    assert "mesa-vulkan-drivers" in doctor.headless_vulkan(machine).remedy
    put(machine, "usr/share/vulkan/icd.d/lvp_icd.x86_64.json", "{}")
    assert doctor.headless_vulkan(machine).detail == "lvp"


def test_a_program_must_be_on_the_path_and_executable(machine: Machine) -> None:
    kernel = put(machine, "usr/bin/linux.uml")
    searching = replace(machine, environment={"PATH": "/bin:/usr/bin"})
    assert doctor.user_mode_linux(searching).remedy
    kernel.chmod(0o755)
    assert doctor.user_mode_linux(machine).remedy
    assert not doctor.user_mode_linux(searching).remedy


def test_every_lack_has_a_remedy_and_nothing_else_has(machine: Machine) -> None:
    for found in run_checks(machine):
        assert bool(found.remedy) == (found.status == "lack"), found
        assert found.detail
        assert found.needed_for


def test_root_is_told_no_sudo(machine: Machine) -> None:
    assert any("sudo" in found.remedy for found in run_checks(machine))
    assert not any("sudo" in found.remedy for found in run_checks(replace(machine, is_root=True)))


def test_a_package_is_told_of_nothing_that_only_a_checkout_has(machine: Machine) -> None:
    found = run_checks(replace(machine, in_checkout=False))
    assert not [each for each in found if ".ci/" in each.remedy or "make test" in each.needed_for]
    assert len(found) == len(CHECKS) - 1


def test_looking_for_adapters_leaves_the_log_as_it_was() -> None:
    before = logging.root.manager.disable
    doctor.detected_adapters()
    assert logging.root.manager.disable == before


def test_this_machine_is_told_in_unbroken_lines_and_as_json() -> None:
    checks = run_checks()
    assert len(checks) == len(CHECKS)

    shown = io.StringIO()
    print_checks(checks, Console(file=shown, width=40))
    for found in checks:
        assert found.name in shown.getvalue()
        assert found.remedy in shown.getvalue()

    keys = {"name", "status", "detail", "needed_for", "remedy"}
    assert all(set(each) == keys for each in json.loads(json.dumps([asdict(found) for found in checks])))

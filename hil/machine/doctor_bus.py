"""What this machine can do on a CAN bus: SocketCAN, virtual and real interfaces, serial ports."""

import logging
import os
import socket

import can
from serial.tools import list_ports

from drivers.wire.adapters import link_up_command, socketcan_links
from hil.machine.capability import Look, Machine

CAP_NET_ADMIN = 12

NOT_HARDWARE = frozenset(
    {"hub", "simulated", "virtual", "udp_multicast", "socketcand", "socketcan", "serial", "slcan"}
)
"""Interfaces of python-can without an adapter of their own, or looked at in another way here.

``socketcand`` would listen on the network for seconds.
"""

INSTEAD = "use --bus hub:NAME, which needs no SocketCAN"


def socketcan(machine: Machine) -> Look:
    """Whether the kernel gives CAN sockets."""
    if kernel_has_can():
        return Look(f"kernel {machine.release}")
    if _module_exists(machine, "can-raw"):
        return Look("built as a module, not loaded", "sudo modprobe can-raw")
    detail = f"kernel {machine.release} has none"
    return Look(detail, f"{INSTEAD}, or .ci/uml/run -- COMMAND")


def kernel_has_can() -> bool:
    """Whether a CAN_RAW socket can be opened."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def vcan_module(machine: Machine) -> Look:
    """Whether the kernel can make virtual CAN interfaces."""
    if machine.path("sys", "module", "vcan").exists():
        return Look("loaded")
    if _module_exists(machine, "vcan"):
        return Look("there, not loaded", "sudo modprobe vcan")
    return Look("this kernel has none", INSTEAD)


def vcan_interface(machine: Machine) -> Look:
    """Whether vcan0 is there and up."""
    interfaces = can_interfaces(machine)
    if interfaces.get("vcan0"):
        return Look("up")
    if "vcan0" in interfaces:
        return Look("down", "sudo ip link set vcan0 up")
    if not _has_vcan(machine):
        return Look("this kernel cannot make it", INSTEAD)
    make = "sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up"
    return Look("not there", make)


def real_interfaces(machine: Machine) -> Look:
    """The CAN interfaces of the kernel that are not virtual."""
    interfaces = {
        key: up for key, up in can_interfaces(machine).items() if not key.startswith(("vcan", "vxcan"))
    }
    down = [key for key, up in interfaces.items() if not up]
    if down:
        return Look(f"{', '.join(down)} down", f"sudo {link_up_command(down[0])}")
    if interfaces:
        return Look(f"{', '.join(interfaces)} up")
    return Look("none", "plug in an adapter that the kernel drives (lsusb, dmesg)")


def can_interfaces(machine: Machine) -> dict[str, bool]:
    """Name -> up, of each CAN interface of the kernel."""
    links = socketcan_links(machine.path("sys", "class", "net"))
    return {link.spec.removeprefix("socketcan:"): link.usable for link in links}


def net_admin(machine: Machine) -> Look:
    """Whether this process may make and set CAN interfaces; using one needs no privilege."""
    if machine.has_privilege(CAP_NET_ADMIN):
        return Look("granted")
    return Look("not granted", "put sudo before the ip link commands")


def adapters(_machine: Machine) -> Look:
    """The adapters that python-can finds by itself, through the vendors' libraries."""
    detected = detected_adapters()
    if detected:
        return Look(", ".join(detected))
    return Look("none found", "plug in the adapter and install its vendor's library, then hil doctor again")


def detected_adapters() -> list[str]:
    """``interface:channel`` of each adapter found."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)  # each vendor library that is not installed is a warning
    try:
        interfaces = sorted(can.VALID_INTERFACES - NOT_HARDWARE)
        configs = can.detect_available_configs(interfaces, timeout=2.0)
    finally:
        logging.disable(before)
    return [f"{config['interface']}:{config['channel']}" for config in configs]


def serial_ports(_machine: Machine) -> Look:
    """The serial ports with something behind them, for slcan adapters and load machines."""
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
    """Whether a kernel with SocketCAN can be started as a process, for the tests."""
    kernel = machine.program("linux.uml")
    if kernel is not None:
        return Look(str(kernel))
    return Look("not installed", "sudo apt-get install user-mode-linux kmod iproute2 gcc libc6-dev")


def _has_vcan(machine: Machine) -> bool:
    return machine.path("sys", "module", "vcan").exists() or _module_exists(machine, "vcan")


def _module_exists(machine: Machine, module: str) -> bool:
    folder = ("lib", "modules", machine.release)
    listed = machine.text(*folder, "modules.dep") + machine.text(*folder, "modules.builtin")
    return f"/{module}.ko" in listed

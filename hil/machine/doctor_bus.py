"""What this machine can do on a CAN bus: SocketCAN, virtual and real interfaces, serial ports."""

import logging
import os
import socket

import can
from serial.tools import list_ports

from drivers.wire.adapters import link_up_command, socketcan_links
from hil.machine.capability import Capability, Machine, capable, lacking

CAP_NET_ADMIN = 12

NOT_HARDWARE = frozenset(
    {"hub", "simulated", "virtual", "udp_multicast", "socketcand", "socketcan", "serial", "slcan"}
)
"""Interfaces of python-can without an adapter of their own, or looked at in another way here.

``socketcand`` would listen on the network for seconds.
"""

INSTEAD = "use --bus hub:NAME, which needs no SocketCAN"


def socketcan(machine: Machine) -> Capability:
    """Whether the kernel gives CAN sockets."""
    name, needed_for = "SocketCAN", "--bus socketcan:..."
    if kernel_has_can():
        return capable(name, f"kernel {machine.release}", needed_for)
    if _module_exists(machine, "can-raw"):
        return lacking(name, "built as a module, not loaded", needed_for, "sudo modprobe can-raw")
    detail = f"kernel {machine.release} has none"
    return lacking(name, detail, needed_for, f"{INSTEAD}, or .ci/uml/run -- COMMAND")


def kernel_has_can() -> bool:
    """Whether a CAN_RAW socket can be opened."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def vcan_module(machine: Machine) -> Capability:
    """Whether the kernel can make virtual CAN interfaces."""
    name, needed_for = "vcan driver", "--bus socketcan:vcan0"
    if machine.path("sys", "module", "vcan").exists():
        return capable(name, "loaded", needed_for)
    if _module_exists(machine, "vcan"):
        return lacking(name, "there, not loaded", needed_for, "sudo modprobe vcan")
    return lacking(name, "this kernel has none", needed_for, INSTEAD)


def vcan_interface(machine: Machine) -> Capability:
    """Whether vcan0 is there and up."""
    name, needed_for = "vcan0", "--bus socketcan:vcan0"
    interfaces = can_interfaces(machine)
    if interfaces.get("vcan0"):
        return capable(name, "up", needed_for)
    if "vcan0" in interfaces:
        return lacking(name, "down", needed_for, "sudo ip link set vcan0 up")
    if not _has_vcan(machine):
        return lacking(name, "this kernel cannot make it", needed_for, INSTEAD)
    make = "sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up"
    return lacking(name, "not there", needed_for, make)


def real_interfaces(machine: Machine) -> Capability:
    """The CAN interfaces of the kernel that are not virtual."""
    name, needed_for = "CAN interfaces", "--bus socketcan:can0"
    interfaces = {
        key: up for key, up in can_interfaces(machine).items() if not key.startswith(("vcan", "vxcan"))
    }
    down = [key for key, up in interfaces.items() if not up]
    if down:
        remedy = f"sudo {link_up_command(down[0])}"
        return lacking(name, f"{', '.join(down)} down", needed_for, remedy)
    if interfaces:
        return capable(name, f"{', '.join(interfaces)} up", needed_for)
    return lacking(name, "none", needed_for, "plug in an adapter that the kernel drives (lsusb, dmesg)")


def can_interfaces(machine: Machine) -> dict[str, bool]:
    """Name -> up, of each CAN interface of the kernel."""
    links = socketcan_links(machine.path("sys", "class", "net"))
    return {link.spec.removeprefix("socketcan:"): link.usable for link in links}


def net_admin(machine: Machine) -> Capability:
    """Whether this process may make and set CAN interfaces; using one needs no privilege."""
    name, needed_for = "CAP_NET_ADMIN", "making and setting CAN interfaces"
    if machine.has_privilege(CAP_NET_ADMIN):
        return capable(name, "granted", needed_for)
    return lacking(name, "not granted", needed_for, "put sudo before the ip link commands")


def adapters(_machine: Machine) -> Capability:
    """The adapters that python-can finds by itself, through the vendors' libraries."""
    name, needed_for = "python-can adapters", "--bus pcan:..., kvaser:..., gs_usb:..., ..."
    detected = detected_adapters()
    if detected:
        return capable(name, ", ".join(detected), needed_for)
    remedy = "plug in the adapter and install its vendor's library, then hil doctor again"
    return lacking(name, "none found", needed_for, remedy)


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


def serial_ports(_machine: Machine) -> Capability:
    """The serial ports with something behind them, for slcan adapters and load machines."""
    name, needed_for = "serial ports", "--bus slcan:/dev/..."
    ports = sorted(port.device for port in list_ports.comports() if port.vid is not None)
    closed = [port for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    if closed:
        remedy = 'sudo usermod -aG dialout "$USER", then log in again'
        return lacking(name, f"no permission for {', '.join(closed)}", needed_for, remedy)
    if ports:
        return capable(name, ", ".join(ports), needed_for)
    return lacking(name, "no USB serial adapter", needed_for, "plug in the adapter")


def user_mode_linux(machine: Machine) -> Capability:
    """Whether a kernel with SocketCAN can be started as a process, for the tests."""
    name, needed_for = "User Mode Linux", "make test-vcan where the kernel has no SocketCAN"
    kernel = machine.program("linux.uml")
    if kernel is not None:
        return capable(name, str(kernel), needed_for)
    remedy = "sudo apt-get install user-mode-linux kmod iproute2 gcc libc6-dev"
    return lacking(name, "not installed", needed_for, remedy)


def _has_vcan(machine: Machine) -> bool:
    return machine.path("sys", "module", "vcan").exists() or _module_exists(machine, "vcan")


def _module_exists(machine: Machine, module: str) -> bool:
    folder = ("lib", "modules", machine.release)
    listed = machine.text(*folder, "modules.dep") + machine.text(*folder, "modules.builtin")
    return f"/{module}.ko" in listed


CHECKS = (
    socketcan,
    vcan_module,
    vcan_interface,
    real_interfaces,
    net_admin,
    adapters,
    serial_ports,
    user_mode_linux,
)

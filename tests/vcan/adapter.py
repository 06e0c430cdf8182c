"""An adapter of the bench's own: a virtual interface, joined with the drive's by the kernel's gateway. It may
be down, stuck, deaf or gone, and the bus goes on without it. A socket sends the error frames that a driver
would.
"""

import fcntl
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import pack, unpack_from
from typing import Final

import pytest

from servobench.drivers.wire.frame_port import ERROR_FLAG
from tests.scenario.processes import simulated_drive

ADAPTER: Final = "can7"
BUS_OFF, UNACKNOWLEDGED, RESTARTED = (0x040, 0), (0x020, 0), (0x100, 0)
"""Class, and detail of the controller (linux/can/error.h)."""
CHECK: Final = "check the cable, its terminations, the bit rates, and that another node is on"
_SIOCSIFFLAGS: Final = 0x8914
_IFF_UP: Final = 1
_NEW_QUEUE, _DELETE_QUEUE, _KIND, _ROOT = 36, 37, 1, 0xFFFFFFFF
"""RTM_NEWQDISC, RTM_DELQDISC, TCA_KIND, TC_H_ROOT (linux/rtnetlink.h, linux/pkt_sched.h)."""
_REPLACE: Final = 0x1 | 0x4 | 0x100 | 0x400
"""NLM_F_REQUEST, ACK, REPLACE, CREATE."""


def run_tool(*command: str) -> None:
    """Run ``ip``, ``tc`` or ``cangw``; raises CalledProcessError if it fails."""
    subprocess.run(command, check=True, timeout=60)


@contextmanager
def adapter_beside(channel: str, name: str = ADAPTER) -> Iterator[None]:
    """The adapter is there, up, and hears what is on ``channel``."""
    run_tool("ip", "link", "add", "dev", name, "type", "vcan")
    try:
        run_tool("ip", "link", "set", name, "up")
        for source, other in ((channel, name), (name, channel)):
            run_tool("cangw", "-A", "-s", source, "-d", other, "-e")
        yield
    finally:
        subprocess.run(["ip", "link", "del", name], check=False, capture_output=True, timeout=60)


@contextmanager
def drive_beside(channel: str) -> Iterator[str]:
    """A simulated drive on ``channel``, and the adapter beside it; SPEC of the bus with the drive."""
    if os.geteuid() or any(shutil.which(tool) is None for tool in ("cangw", "tc")):
        pytest.skip("an adapter of the tests' own needs root, cangw of can-utils and tc of iproute2")
    with adapter_beside(channel), simulated_drive(f"socketcan:{channel}"):
        yield f"socketcan:{channel}"


def echoes_like_a_driver() -> bool:
    """Whether an own frame comes back once it has left the queue, as with a controller (``vcan echo=1``);
    else the kernel gives it back though it never left."""
    told = Path("/sys/module/vcan/parameters/echo")
    return told.exists() and told.read_text().strip() == "Y"


def set_up(up: bool) -> None:
    """Set the adapter up or down, by the kernel's call: a program takes a busy machine longer than the fault
    is to last."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as opened:
        fcntl.ioctl(opened, _SIOCSIFFLAGS, pack("16sH22x", ADAPTER.encode(), _IFF_UP if up else 0))


def error(what: tuple[int, int]) -> None:
    """The driver tells an error."""
    classes, detail = what
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as driver:
        driver.bind((ADAPTER,))
        driver.send(pack("=IB3x8s", ERROR_FLAG | classes, 8, bytes((0, detail))))


def hold() -> None:
    """The adapter sends nothing, and its queue of ten frames is full."""
    run_tool("tc", "qdisc", "replace", "dev", ADAPTER, "root", "netem", "delay", "200s", "limit", "10")


def flood(frames: int) -> None:
    """Another process offers so many frames, about one each millisecond, to a queue of ten which passes 125
    a second; what is refused it does not repeat. Afterwards the adapter is as fast as ever."""
    run_tool("tc", "qdisc", "replace", "dev", ADAPTER, "root", "netem", "rate", "16kbit", "limit", "10")
    run_tool("cangen", ADAPTER, "-g", "1", "-i", "-I", "7FF", "-L", "8", "-n", str(frames))
    release()


def lose() -> None:
    """The adapter loses what it is handed, as one that is bus-off: without a carrier the kernel takes each
    frame and drops it (``can_bus_off`` in drivers/net/can/dev, ``noop_enqueue`` in net/sched)."""
    _queue(_NEW_QUEUE, b"blackhole\0\0\0")


def release() -> None:
    """It sends again, at once."""
    _queue(_DELETE_QUEUE, b"")


def _queue(action: int, kind: bytes) -> None:
    """As ``tc qdisc``, but at once: a program takes a busy machine longer than the fault is to last."""
    index = socket.if_nametoindex(ADAPTER)
    message = pack("=BxxxiIII", 0, index, 0, _ROOT, 0)
    if kind:
        message += pack("=HH", 4 + len(kind), _KIND) + kind
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0) as kernel:
        kernel.send(pack("=IHHII", 16 + len(message), action, _REPLACE, 1, 0) + message)
        (number,) = unpack_from("=i", kernel.recv(4096), 16)
    if number:
        raise OSError(-number, os.strerror(-number))

"""Bus specifications and the adapters that they name.

simulated                     a simulated segment in simulated time (opened by the bench itself)
hub:NAME                      a simulated segment in real time, between processes of this machine
socketcan:can0                a SocketCAN interface
slcan:/dev/ttyACM0@115200     a serial adapter and the speed of its serial line, baud
pcan:PCAN_USBBUS1, kvaser:0   any other interface that python-can knows
"""

import errno
import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import can
from can.interfaces import BACKENDS

from servobench.drivers.errors import MISSING, BadInput, BenchError, BusDown
from servobench.drivers.wire.link import StampSource
from servobench.drivers.wire.slcan import LINE_BAUD, SlcanBus
from servobench.drivers.wire.socketcan import StampedSocketcanBus

# python-can warns of every vendor driver that it looks for and does not find.
logging.getLogger("can").addHandler(logging.NullHandler())

SIMULATED = "simulated"
HUB = "hub"
_HUB_NAME_LENGTH_MAX = 48
"""Characters: a socket's path of 107 bytes leaves this many below the usual folders."""
HUB_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9_.-]{{0,{_HUB_NAME_LENGTH_MAX - 1}}}")
_BAUD = re.compile(r"[1-9][0-9]{0,7}")
HUB_NAME_EXPECTED = (
    f"1 to {_HUB_NAME_LENGTH_MAX} letters, digits, '_', '-' or '.', the first a letter or a digit"
)
SOCKETCAN = "socketcan"
SLCAN = "slcan"
SERIAL_INTERFACES = (SLCAN, "serial", "robotell", "seeedstudio")
"""Interfaces whose channel is a serial port, which may have a line speed."""

_NAME_IN_KERNEL = re.compile(r"v?can[0-9]+")
"""Usual names of SocketCAN's interfaces, which people type alone."""
_FOREIGN_NETWORK = ("udp_multicast",)
"""Interfaces that send bus traffic beyond this machine, to any listener."""
_NUMBERED_CHANNELS = ("kvaser", "vector", "ixxat", "neovi", "canalystii", "cantact", "neousys")
_MONOTONIC_STAMPS = (SIMULATED, HUB, SLCAN)
_WALL_CLOCK_STAMPS = (SOCKETCAN, "virtual")
_OPENING_FAILURES = (
    can.CanError,
    OSError,
    ValueError,
    TypeError,
    ImportError,
    NameError,
    AttributeError,
    RuntimeError,
)
"""Exceptions that python-can's interfaces raise without their driver or device."""
_NETWORK_LINKS = Path("/sys/class/net")
_ARPHRD_CAN = "280"
"""Hardware type of an interface (linux/if_arp.h)."""
_IFF_UP = 1
"""Flag of an interface (linux/if.h)."""


@dataclass(frozen=True, slots=True)
class BusSpec:
    """A bus as the user names it."""

    interface: str
    channel: str = ""
    line_baud: int | None = None
    """Speed of a serial adapter's line, not of the CAN bus."""

    @property
    def simulated(self) -> bool:
        """True if the bench creates this bus itself, in simulated time."""
        return self.interface == SIMULATED

    def __str__(self) -> str:
        text = f"{self.interface}:{self.channel}" if self.channel else self.interface
        return f"{text}@{self.line_baud}" if self.line_baud is not None else text


class OpenBus(NamedTuple):
    """A bus that is up, and the origin of its stamps."""

    bus: can.BusABC
    stamps: StampSource
    name: str


class Adapter(NamedTuple):
    """Something on this machine that can be a bus."""

    spec: str
    description: str
    usable: bool
    """Up and ready now."""


def known_interfaces() -> tuple[str, ...]:
    """Return every interface allowed in a specification, sorted."""
    return tuple(sorted({*BACKENDS, SIMULATED, HUB} - set(_FOREIGN_NETWORK)))


def parse_bus_spec(text: str, source: str = "--bus", key: str = "") -> BusSpec:
    """Parse ``interface[:channel[@baud]]``; raises BadInput naming ``source`` and ``key``."""
    interface, _, channel = text.strip().partition(":")
    known = known_interfaces()
    if interface not in known:
        near = get_close_matches(interface, known, n=1)
        if _NAME_IN_KERNEL.fullmatch(text):
            near = [f"{SOCKETCAN}:{text}"]
        remedy = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
        raise BadInput(source, key, text or MISSING, "INTERFACE[:CHANNEL] of an interface known here", remedy)
    if interface == SIMULATED and channel:
        raise BadInput(source, key, text, "'simulated' without a channel")
    if interface in (HUB, SOCKETCAN, *SERIAL_INTERFACES) and not channel:
        raise BadInput(source, key, text, f"a channel, e.g. {_example(interface)!r}")
    if interface == HUB and HUB_NAME.fullmatch(channel) is None:
        raise BadInput(source, key, text, f"hub:NAME with a name of {HUB_NAME_EXPECTED}")
    line_baud = None
    if interface in SERIAL_INTERFACES and "@" in channel:
        channel, _, baud = channel.rpartition("@")
        if _BAUD.fullmatch(baud) is None:
            raise BadInput(
                source, key, text, f"a line speed in baud behind '@', e.g. {_example(interface)!r}"
            )
        line_baud = int(baud)
    return BusSpec(interface, channel, line_baud)


def shared_bus(
    text: str, remedy: str = "use hub:NAME", expected: str = "a bus that other processes can join"
) -> BusSpec:
    """Parse the bus of ``--bus``. Raises BadInput for the one in simulated time, which no other process can
    join."""
    spec = parse_bus_spec(text)
    if spec.simulated:
        raise BadInput("--bus", "", text, expected, remedy)
    return spec


def open_bus(spec: BusSpec, bitrate_bit_s: int, *, for_link: bool = True) -> OpenBus:
    """Open a real-time bus. Raises BusDown with the remedy, or BadInput for one that can never be opened.

    ``for_link``: a :class:`~servobench.drivers.wire.link.BusLink` uses it, so own frames come back where they
    carry the instant at which they were on the bus, and several frames may come at once; not for a caller who
    reads python-can's messages or waits on ``fileno``.

    ``simulated`` is opened by the owner of its segment.
    """
    if spec.simulated:
        raise BadInput(
            "--bus", "", str(spec), "a real-time bus", "use hub:NAME for a simulated bus in real time"
        )
    try:
        bus = _OPENERS.get(spec.interface, _open_other)(spec, bitrate_bit_s, for_link)
    except BenchError:
        raise
    except can.CanInterfaceNotImplementedError as error:
        raise BusDown(
            f"no driver for {spec} on this machine", str(error), "install the adapter's driver"
        ) from error
    except (NameError, ImportError) as error:  # how some interfaces of python-can say so
        evidence = f"the vendor's library is not installed: {error}"
        raise BusDown(f"no driver for {spec} on this machine", evidence, "install it") from error
    except _OPENING_FAILURES as error:
        raise BusDown(f"cannot open {spec}", str(error), _remedy(spec, bitrate_bit_s, error)) from error
    if spec.interface in _MONOTONIC_STAMPS:
        stamps = StampSource.MONOTONIC
    elif spec.interface in _WALL_CLOCK_STAMPS:
        stamps = StampSource.WALL_CLOCK
    else:
        stamps = StampSource.RECEIPT
    return OpenBus(bus, stamps, str(spec))


def socketcan_links(root: Path = _NETWORK_LINKS) -> list[Adapter]:
    """Return CAN network interfaces, up or not."""
    links = []
    for link in sorted(root.iterdir()) if root.is_dir() else []:
        if _attribute(link, "type") == _ARPHRD_CAN:
            up = _is_up(link)
            state = "up" if up else f"down; {link_up_command(link.name)}"
            links.append(Adapter(f"{SOCKETCAN}:{link.name}", f"SocketCAN interface, {state}", up))
    return links


VIRTUAL = "vcan"
"""Usual prefix of virtual interfaces."""


def link_up_command(channel: str, bitrate_bit_s: int = 1_000_000) -> str:
    """Return the command that brings a SocketCAN interface up."""
    if channel.startswith(VIRTUAL):
        return f"ip link add dev {channel} type vcan; ip link set {channel} up"
    return f"ip link set {channel} up type can bitrate {bitrate_bit_s}"


def _open_socketcan(spec: BusSpec, bitrate_bit_s: int, for_link: bool) -> can.BusABC:
    """Open a SocketCAN interface. Binding to one that is down succeeds and only sending fails: check its
    state first."""
    link = _NETWORK_LINKS / spec.channel
    if link.is_dir():
        if _attribute(link, "type") != _ARPHRD_CAN:
            raise BusDown(
                f"{spec.channel} is no CAN interface", "", "see 'hil doctor' for those of this machine"
            )
        if not _is_up(link):
            raise BusDown(f"{spec.channel} is down", "", link_up_command(spec.channel, bitrate_bit_s))
    return StampedSocketcanBus(channel=spec.channel, receive_own_messages=for_link)


def _open_hub(spec: BusSpec, bitrate_bit_s: int, for_link: bool) -> can.BusABC:
    return can.Bus(
        interface=HUB,
        channel=spec.channel,
        bitrate=bitrate_bit_s,
        receive_own_messages=for_link,
        batches=for_link,
        ignore_config=True,
    )


def _open_slcan(spec: BusSpec, bitrate_bit_s: int, _for_link: bool) -> can.BusABC:
    return SlcanBus(spec.channel, bitrate=bitrate_bit_s, tty_baudrate=spec.line_baud or LINE_BAUD)


def _open_serial(spec: BusSpec, bitrate_bit_s: int, _for_link: bool) -> can.BusABC:
    baud = spec.line_baud
    options: dict[str, Any] = {"bitrate": bitrate_bit_s} if baud is None else {"baudrate": baud}
    return can.Bus(interface=spec.interface, channel=spec.channel, ignore_config=True, **options)


def _open_other(spec: BusSpec, bitrate_bit_s: int, _for_link: bool) -> can.BusABC:
    channel: Any = spec.channel or None
    if spec.interface in _NUMBERED_CHANNELS and spec.channel.isdecimal():
        channel = int(spec.channel)
    return can.Bus(interface=spec.interface, channel=channel, bitrate=bitrate_bit_s, ignore_config=True)


_OPENERS: dict[str, Callable[[BusSpec, int, bool], can.BusABC]] = {
    SOCKETCAN: _open_socketcan,
    HUB: _open_hub,
    **dict.fromkeys(SERIAL_INTERFACES, _open_serial),
    SLCAN: _open_slcan,
}


def _remedy(spec: BusSpec, bitrate_bit_s: int, error: Exception) -> str:
    if spec.interface == SOCKETCAN:
        if getattr(error, "errno", None) == errno.EAFNOSUPPORT:
            return "this kernel has no SocketCAN: use hub:NAME"
        others = [link.spec for link in socketcan_links(_NETWORK_LINKS)]
        if getattr(error, "errno", None) == errno.ENODEV and others and not spec.channel.startswith(VIRTUAL):
            return f"plug it in; there is {', '.join(others)} (hil scan)"
        return link_up_command(spec.channel, bitrate_bit_s)
    if spec.interface in SERIAL_INTERFACES:
        return "check the port's name, and that you may open it (group dialout)"
    if spec.interface == HUB:
        return "leave the hub with all participants and start again, or use another name"
    return "check the channel's name and the adapter's driver"


def _example(interface: str) -> str:
    if interface in SERIAL_INTERFACES:
        return f"{interface}:/dev/ttyACM0@115200"
    return f"{interface}:{'bench' if interface == HUB else 'can0'}"


def _attribute(link: Path, name: str) -> str:
    try:
        return (link / name).read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _is_up(link: Path) -> bool:
    flags = _attribute(link, "flags")
    return bool(flags) and bool(int(flags, 16) & _IFF_UP)

"""Finds possible buses of this machine: the kernel's CAN interfaces, and USB serial ports. Opens none.

sysfs lists the interfaces and says which are up; bit rate and controller state come only by netlink, through
``ip -json -details link``. Without that program these two are unknown.

Finds the bit rate of a running bus by listening: nothing is sent, not even an acknowledgement.

A controller at another rate than the bus's sees errors and no frame; one at the right rate sees frames
without errors. So each rate is tried until frames come. A silent bus gives no result.
"""

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import can
from serial.tools import list_ports

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.timebase import NS_PER_MS, Clock, Duration, Instant
from servobench.drivers.wire.adapters import SLCAN, SOCKETCAN, BusSpec, socketcan_links
from servobench.drivers.wire.error_frames import anew_command
from servobench.drivers.wire.slcan import LINE_BAUD, SlcanBus
from servobench.drivers.wire.slcan_protocol import SlcanStatus

COMMAND = ("ip", "-json", "-details", "link", "show")
_TIMEOUT_S = 5.0
"""A program that lists a few interfaces needs milliseconds; one that hangs counts as absent."""
_SYSFS = Path("/sys/class/net")


_ADAPTER = "can"
_BUS_OFF = "BUS-OFF"
RESTART_MS = 100
"""Shorter than drives wait for a master's heartbeat, far above the 1.4 ms of a recovery at 1 Mbit/s."""
QUEUE_LENGTH_MIN = 10
"""Linux's default for an adapter: room for SYNC, the commands of three axes and their SDO requests."""
FAST_BIT_S = 800_000
SAMPLE_POINTS, SAMPLE_POINTS_FAST, SAMPLE_POINT = (0.85, 0.90), (0.75, 0.90), 0.875
"""Sample point of a bit (CiA 301, 5.3): valid range below and from 800 kbit/s, and the recommended value."""


class CanLink(NamedTuple):
    """One CAN interface of the kernel."""

    name: str
    up: bool
    kind: str
    """``can`` for an adapter, ``vcan`` and the like for a virtual one; empty if unknown."""
    bitrate_bit_s: int | None
    """None: virtual, not set, or unknown."""
    state: str
    """Controller state, e.g. ``ERROR-ACTIVE`` or ``BUS-OFF``; empty if unknown."""
    transmit_errors: int | None = None
    receive_errors: int | None = None
    listen_only: bool = False
    queue_length: int | None = None
    """Frames that its transmit queue holds (txqueuelen)."""
    restart_ms: int | None = None
    """Delay of the restart after bus-off; 0: no automatic restart; None: unknown, or unsupported by the
    driver."""
    sample_point: float | None = None
    """Position in a bit, 0 to 1."""

    @property
    def spec(self) -> str:
        """The value for --bus."""
        return f"{SOCKETCAN}:{self.name}"


def can_links(root: Path = _SYSFS, described: str | None = None) -> list[CanLink]:
    """Return the CAN interfaces of this machine, by name; ``described``: the output of ``ip``, which is
    called if None."""
    if described is None:
        described = _ask_ip()
    described_links = {link.name: link for link in parse_links(described)}
    links = []
    for adapter in socketcan_links(root):
        name = adapter.spec.removeprefix(f"{SOCKETCAN}:")
        links.append(described_links.pop(name, CanLink(name, adapter.usable, "", None, "")))
    return sorted([*links, *described_links.values()])


def parse_links(text: str) -> list[CanLink]:
    """Parse the output of ``ip -json -details link show`` into CAN interfaces; none if it is something
    else."""
    try:
        links = json.loads(text) if text.strip() else []
    except ValueError:
        return []
    if not isinstance(links, list):
        return []
    return [_link(link) for link in links if isinstance(link, dict) and link.get("link_type") == "can"]


def _link(link: dict[str, Any]) -> CanLink:
    info = link.get("linkinfo") or {}
    data = info.get("info_data") or {}
    counters = data.get("berr_counter") or {}
    # Drivers that know a few bit rates only, as that of serial adapters, tell no bit timing beside them. They
    # have no restart: what sets restart-ms and the bit rate at once would leave the interface down.
    bit = data.get("bittiming") or {"bitrate": data.get("bittiming_bitrate")}
    restarts = info.get("info_kind") == _ADAPTER and "bitrate_const" not in data
    return CanLink(
        str(link.get("ifname", "")),
        "UP" in link.get("flags", ()),
        str(info.get("info_kind", "")),
        bit.get("bitrate"),
        str(data.get("state", "")),
        counters.get("tx"),
        counters.get("rx"),
        "LISTEN-ONLY" in (data.get("ctrlmode") or ()),
        link.get("txqlen"),
        data.get("restart_ms", 0) if restarts else None,
        _real(bit.get("sample_point")),
    )


def _real(told: Any) -> float | None:
    try:
        return float(told)
    except (TypeError, ValueError):
        return None


def link_advice(link: CanLink, bitrate_bit_s: int | None = None) -> list[str]:
    """Say which settings of an adapter do not suit a bench, each with the command that fixes it; nothing for
    a virtual interface. ``bitrate_bit_s``: the intended bit rate; None: any."""
    if link.kind != _ADAPTER or not link.up:
        return []
    name, rate, found = link.name, bitrate_bit_s or link.bitrate_bit_s, []
    again = f"ip link set {name} down; ip link set {name} up type can"
    if bitrate_bit_s and link.bitrate_bit_s not in (None, bitrate_bit_s):
        found.append(
            f"{name} is set to {link.bitrate_bit_s} bit/s, the bench to {bitrate_bit_s} (bus.bitrate_bit_s): "
            f"{again} bitrate {bitrate_bit_s}"
        )
    if link.listen_only:
        found.append(f"{name} only listens: {again} bitrate {rate} listen-only off")
    if link.state == _BUS_OFF:
        found.append(f"{name} is bus-off: {anew_command(name)}")
    if link.restart_ms == 0:
        found.append(
            f"{name} stays bus-off once it is so (restart-ms 0): "
            f"{again} bitrate {rate} restart-ms {RESTART_MS}"
        )
    if link.queue_length is not None and link.queue_length < QUEUE_LENGTH_MIN:
        found.append(
            f"{name} has a queue of {link.queue_length} frames: "
            f"ip link set {name} txqueuelen {QUEUE_LENGTH_MIN}"
        )
    least, most = SAMPLE_POINTS_FAST if (rate or 0) >= FAST_BIT_S else SAMPLE_POINTS
    if link.sample_point is not None and not least <= link.sample_point <= most:
        found.append(
            f"{name} samples a bit at {100 * link.sample_point:g} %, CiA 301 has {100 * least:g} to "
            f"{100 * most:g} %: {again} bitrate {rate} sample-point {SAMPLE_POINT}"
        )
    return found


def advice_on(spec: BusSpec, bitrate_bit_s: int | None = None) -> list[str]:
    """Apply :func:`link_advice` to the interface of ``spec``; nothing for a bus that is not the kernel's."""
    links = can_links() if spec.interface == SOCKETCAN else []
    return [text for link in links if link.spec == str(spec) for text in link_advice(link, bitrate_bit_s)]


def _ask_ip() -> str:
    try:
        ended = subprocess.run(COMMAND, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return ended.stdout


KNOWN_USB = {
    (0x0403, 0xFFA8): "Lawicel CANUSB",
    (0x04D8, 0x000A): "USBtin, or another device with Microchip's CDC example",
    (0x0483, 0x5740): "STM32 virtual port, as of many SLCAN adapters",
    (0x16D0, 0x117E): "CANable with its slcan firmware",
    (0xAD50, 0x60C4): "CANable with its slcan firmware",
}
"""Vendor and product id -> device; ids of common converter chips say nothing and are left out."""


class SerialPort(NamedTuple):
    """One serial port with a USB device behind it."""

    device: str
    description: str
    usb_id: str
    """``vvvv:pppp``"""
    serial_number: str
    hint: str
    """Known device with this id; empty if none."""
    permitted: bool
    """True if this user may open it."""

    @property
    def spec(self) -> str:
        """The value for --bus, if an SLCAN adapter is behind it."""
        return f"slcan:{self.device}"


def serial_adapters() -> list[SerialPort]:
    """Return the USB serial ports, by name."""
    adapters = []
    for port in sorted(list_ports.comports(), key=lambda port: str(port.device)):
        if port.vid is None or port.pid is None:
            continue
        adapters.append(
            SerialPort(
                port.device,
                port.description if port.description not in (None, "n/a") else "",
                f"{port.vid:04x}:{port.pid:04x}",
                port.serial_number or "",
                KNOWN_USB.get((port.vid, port.pid), ""),
                os.access(port.device, os.R_OK | os.W_OK),
            )
        )
    return adapters


CANDIDATES_BIT_S = (1_000_000, 500_000, 250_000, 125_000, 800_000, 100_000, 50_000, 20_000, 10_000)
"""In the usual order of CANopen devices."""
FRAMES_NEEDED = 2
LISTEN_NS = Duration(400 * NS_PER_MS)
"""Time at each rate; most heartbeats are heard in one of two rounds."""
ROUNDS = 2
_LISTENING: dict[str, dict[str, Any]] = {
    SLCAN: {"listen_only": True},
    "pcan": {"state": can.BusState.PASSIVE},
    "kvaser": {"driver_mode": False},
}
"""Options that make an interface of python-can listen only. Others cannot, or not by python-can."""
_ERRORS = SlcanStatus.BUS_ERROR | SlcanStatus.ERROR_WARNING | SlcanStatus.ERROR_PASSIVE


class Heard(NamedTuple):
    """Frames and errors heard at one rate."""

    bitrate_bit_s: int
    frames: int
    errors: int


class Detection(NamedTuple):
    """The outcome of a search."""

    bitrate_bit_s: int | None
    """None: not found."""
    trials: tuple[Heard, ...]

    @property
    def silent(self) -> bool:
        """True if nothing was heard, neither frames nor errors."""
        return all(trial.frames == trial.errors == 0 for trial in self.trials)


def can_listen_only(spec: BusSpec) -> bool:
    """Return True if the bit rate can be searched through this adapter without disturbing the bus."""
    return spec.interface in _LISTENING


def open_listening(spec: BusSpec, bitrate_bit_s: int) -> can.BusABC:
    """Open the adapter at this rate in listen-only mode. Raises as opening does."""
    options = _LISTENING[spec.interface]
    if spec.interface == SLCAN:
        baud = spec.line_baud or LINE_BAUD
        return SlcanBus(spec.channel, bitrate=bitrate_bit_s, tty_baudrate=baud, **options)
    return can.Bus(
        interface=spec.interface, channel=spec.channel, bitrate=bitrate_bit_s, ignore_config=True, **options
    )


def detect_bitrate(
    spec: BusSpec,
    clock: Clock,
    open_at: Callable[[BusSpec, int], can.BusABC] = open_listening,
    candidates: Sequence[int] = CANDIDATES_BIT_S,
    listen: Duration = LISTEN_NS,
) -> Detection:
    """Listen at each rate until one gives frames without errors; the last attempt's trials are kept.

    Raises BadInput for an adapter without listen-only mode, BusDown if it cannot be opened.
    """
    if not can_listen_only(spec):
        known = ", ".join(sorted(_LISTENING))
        raise BadInput("--bus", "", str(spec), f"an adapter that can only listen: {known}", "give --bitrate")
    trials: list[Heard] = []
    for _ in range(ROUNDS):
        trials = []
        for bitrate in candidates:
            heard = _listen_at(spec, bitrate, clock, open_at, listen)
            if heard is None:
                continue  # an adapter need not have every rate
            trials.append(heard)
            if heard.frames >= FRAMES_NEEDED and heard.errors == 0:
                return Detection(bitrate, tuple(trials))
    return Detection(None, tuple(trials))


def _listen_at(
    spec: BusSpec,
    bitrate_bit_s: int,
    clock: Clock,
    open_at: Callable[[BusSpec, int], can.BusABC],
    listen: Duration,
) -> Heard | None:
    """Listen at one rate; None if the adapter does not support it."""
    try:
        bus = open_at(spec, bitrate_bit_s)
    except can.CanInitializationError as error:
        if "refuses" in str(error):
            return None
        raise BusDown(f"cannot open {spec}", str(error)) from error
    except OSError as error:
        raise BusDown(f"cannot open {spec}", str(error), "check the port's name") from error
    frames = errors = 0
    try:
        if isinstance(bus, SlcanBus):
            bus.status()  # what it has to tell of the time before
        deadline = Instant(clock.now() + listen)
        while clock.now() < deadline and frames < FRAMES_NEEDED and errors == 0:
            message = bus.recv(max(0, deadline - clock.now()) / 1e9)
            if message is not None:
                errors += message.is_error_frame
                frames += not message.is_error_frame
        if isinstance(bus, SlcanBus):
            errors += bool(bus.status() & _ERRORS) + bus.error_reports
    except can.CanError as error:
        raise BusDown(f"{spec} failed while it listened", str(error)) from error
    finally:
        bus.shutdown()
    return Heard(bitrate_bit_s, frames, errors)

"""Finds the bit rate of a running bus by listening: nothing is sent, not even an acknowledgement.

A controller at another rate than the bus's sees errors and no frame; one at the right rate sees frames
without errors. So each rate is tried until frames come. A silent bus gives no result.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import can

from servobench.drivers.errors import BadInput, BusDown
from servobench.drivers.timebase import NS_PER_MS, Clock, Duration, Instant
from servobench.drivers.wire.adapters import SLCAN, BusSpec
from servobench.drivers.wire.slcan import LINE_BAUD, SlcanBus
from servobench.drivers.wire.slcan_protocol import SlcanStatus

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

"""``hil adapter``: an emulated SLCAN adapter on a pseudo-terminal."""

from pathlib import Path
from typing import Annotated

from servobench.hil.terminal.options import bitrate_option, bus_option, seed_option, valued
from servobench.hil.terminal.output import say


def adapter(
    bus: Annotated[str, bus_option("Bus of its CAN side: hub:NAME, socketcan:vcan0, ...")],
    link: Annotated[
        Path | None, valued("--link", "PATH", "Create a symbolic link to its serial port.")
    ] = None,
    bitrate: Annotated[
        int | None, bitrate_option("Bit rate of the bus, bit/s; a running hub keeps its own.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        valued(
            "--fault",
            "NAME=VALUE",
            "A fault of the serial line, e.g. garble=0.01, truncate=0.01, baud=115200, refuse=0.1,"
            " unplug_after_s=3; repeatable.",
        ),
    ] = None,
    seed: Annotated[int, seed_option("Seed of the faults.", most=None)] = 0,
) -> None:
    """Emulate an SLCAN adapter: a serial port here, a CAN bus there, until Ctrl-C unplugs it.

    Prints the name of its serial port on stdout; use it with --bus slcan:PORT.

    Examples:
      hil adapter --bus hub:lab --link serial   # until Ctrl-C
    """
    from servobench.drivers.timebase import MonotonicClock
    from servobench.drivers.wire.adapters import shared_bus
    from servobench.hil.machine.realtime import realtime_process
    from servobench.hil.machine.stopping import stop_signals
    from servobench.virtual_bus.instruments.serial_line import LineFaults
    from servobench.virtual_bus.instruments.slcan_server import serve_adapter

    spec = shared_bus(bus)
    faults = LineFaults.parse(fault or [])
    with stop_signals() as stop, realtime_process() as refused:
        for request in refused:
            say(f"not granted by the kernel: {request}")
        serve_adapter(
            spec,
            bitrate_bit_s=bitrate,
            link=link,
            faults=faults,
            seed=seed,
            clock=MonotonicClock(),
            stop=stop,
            announce=_announce,
        )


def _announce(port: str, text: str) -> None:
    say(text)
    print(port, flush=True)

"""Frames a second and round trip on the hub, between two processes, beside python-can's ``virtual``.

``virtual`` stays within one process and takes no time for a frame: its other end is a thread. The hub at
1 Mbit/s gives every frame the time that it takes on a wire; at 100 Mbit/s what is left is what the hub costs.
"""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import can
import numpy as np

from servobench.drivers.timebase import NS_PER_S, NS_PER_US, MonotonicClock
from servobench.virtual_bus.bus.frame_image import INTERMISSION_BITS, frame_bits
from servobench.virtual_bus.frame import Frame

PING, PONG, FLOW, CREDIT, END = 0x100, 0x101, 0x200, 0x201, 0x7FF
DATA = bytes(range(8))
TRIPS, FRAMES, WARM_UP = 1_000, 4_000, 50
CREDIT_FRAMES, AHEAD_MAX = 16, 48
"""The other end acknowledges every so many frames; no more than so many are on their way."""
PATIENCE_S = 10.0
FAST_BIT_S = 100_000_000


def main() -> None:
    """Print a table."""
    print(f"{'':34} {'frames/s':>9}   round trip us: {'p50':>7} {'p99':>7} {'max':>7}   p50 x virtual")
    name = f"bench-{os.getpid()}"
    with virtual_pair() as bus:
        base = report("python-can virtual, two threads", bus)
    with hub_pair(f"{name}-slow", 1_000_000) as bus:
        report("hub, 1 Mbit/s, two processes", bus, base)
    with hub_pair(f"{name}-fast", FAST_BIT_S) as bus:
        report("hub, 100 Mbit/s, two processes", bus, base)
    bits = frame_bits(Frame(FLOW, DATA)) + INTERMISSION_BITS
    ping = sum(frame_bits(Frame(can_id, DATA)) + INTERMISSION_BITS for can_id in (PING, PONG))
    print(f"on the wire at 1 Mbit/s: at most {1e6 / bits:.0f} frames/s, a round trip of {ping} us")


def report(title: str, bus: can.BusABC, base: float | None = None) -> float:
    """One line; the median round trip, us."""
    rate, trips = frames_a_second(bus), round_trips_us(bus)
    p50, p99 = np.percentile(trips, [50, 99])
    ratio = "" if base is None else f"{p50 / base:8.1f}"
    print(f"{title:34} {rate:9.0f}   {'':14} {p50:7.0f} {p99:7.0f} {max(trips):7.0f}   {ratio}")
    return float(p50)


def round_trips_us(bus: can.BusABC) -> list[float]:
    """A frame to the other end and one back, us each."""
    clock, trips = MonotonicClock(), list[float]()
    for _ in range(WARM_UP + TRIPS):
        began = clock.now()
        bus.send(message(PING))
        await_frame(bus, PONG)
        trips.append((clock.now() - began) / NS_PER_US)
    return trips[WARM_UP:]


def frames_a_second(bus: can.BusABC) -> float:
    """As many frames in a row as the other end takes."""
    clock, credit = MonotonicClock(), AHEAD_MAX
    began = clock.now()
    for _ in range(FRAMES):
        while credit == 0:
            await_frame(bus, CREDIT)
            credit += CREDIT_FRAMES
        bus.send(message(FLOW))
        credit -= 1
    while credit < AHEAD_MAX:
        await_frame(bus, CREDIT)
        credit += CREDIT_FRAMES
    return FRAMES / ((clock.now() - began) / NS_PER_S)


def answer(bus: can.BusABC) -> None:
    """The other end."""
    taken = 0
    while (got := bus.recv(PATIENCE_S)) is not None and got.arbitration_id != END:
        if got.arbitration_id == PING:
            bus.send(message(PONG))
        elif got.arbitration_id == FLOW:
            taken += 1
            if taken % CREDIT_FRAMES == 0:
                bus.send(message(CREDIT))


def await_frame(bus: can.BusABC, can_id: int) -> None:
    """Raises RuntimeError if it does not come."""
    while True:
        got = bus.recv(PATIENCE_S)
        if got is None:
            raise RuntimeError(f"no frame {can_id:03X} within {PATIENCE_S} s")
        if got.arbitration_id == can_id:
            return


def message(can_id: int) -> can.Message:
    """Eight bytes under an 11-bit identifier."""
    return can.Message(arbitration_id=can_id, is_extended_id=False, data=DATA)


@contextmanager
def virtual_pair() -> Iterator[can.BusABC]:
    """One end here, the other in a thread."""
    here, there = (can.Bus(interface="virtual", channel="bench", ignore_config=True) for _ in range(2))
    thread = threading.Thread(target=answer, args=(there,))
    thread.start()
    try:
        yield here
        here.send(message(END))
    finally:
        thread.join()
        here.shutdown()
        there.shutdown()


@contextmanager
def hub_pair(name: str, bitrate_bit_s: int) -> Iterator[can.BusABC]:
    """One end here, the other in a process of its own."""
    here = hub_bus(name, bitrate_bit_s)
    command = [sys.executable, __file__, name, str(bitrate_bit_s)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout is not None
            other.stdout.readline()
            yield here
            here.send(message(END))
        finally:
            if other.wait(PATIENCE_S + 1.0):
                print("the other end failed", file=sys.stderr)
            here.shutdown()


def hub_bus(name: str, bitrate_bit_s: int) -> can.BusABC:
    """A participant of a hub."""
    return can.Bus(interface="hub", channel=name, bitrate=bitrate_bit_s, ignore_config=True)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        with hub_bus(sys.argv[1], int(sys.argv[2])) as joined:
            print("ready", flush=True)
            answer(joined)
    else:
        main()

"""Processor time of a 1 kHz cycle on the hub, beside the same traffic written plainly with python-canopen.

The cycle: a SYNC, the TPDO1 of each axis awaited, a command to each, rest until the next tick. The drives are
``hil simulate`` in another process. Ours is the link, the pump and the drive client. Theirs is canopen's
Network and PDO maps on the hub's client as it was before it was compiled (frozen_hub), without a thread,
which would cost more. Runs alternate; compared is the median of what the client's process took, user and
system.
"""

import gc
import io
import os
import resource
import statistics
import subprocess
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import can
import canopen
import numpy as np

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant, MonotonicClock
from servobench.drivers.wire.adapters import open_bus, parse_bus_spec
from servobench.drivers.wire.link import BusLink
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.benchmarks.frozen_hub import FrozenHubBus
from tests.motors import LING

ROOT = Path(__file__).parents[2]
PERIOD_NS = NS_PER_MS
WARM_UP, CYCLES, RUNS = 200, 3_000, 5
HEARTBEAT_CYCLES = 50
POSITION_EVERY_CYCLES = 10
"""As in examples/three_axes.toml: with the position in every cycle three axes ask 116 % of 1 Mbit/s, and a
transmit queue that is full ends the run."""
PATIENCE_NS = Duration(10 * NS_PER_S)
BITRATE_BIT_S = 1_000_000
CLOCK = MonotonicClock()


class Figures(NamedTuple):
    """Of one run."""

    cpu_us: float
    """A cycle."""
    latencies_us: list[float]
    """From SYNC to the last command, each cycle."""
    unanswered: int
    """Cycles in which a TPDO1 did not come."""


Cycle = Callable[[int, Instant], tuple[Duration, bool]]
"""One cycle, by its number and the instant of the next tick: SYNC to last command, whether all TPDO1 came."""


def main() -> None:
    """Print a table."""
    gc.disable()
    print(f"{'':32} {'CPU us':>8} {'ratio':>7}   SYNC to last command us: {'p50':>7} {'p99':>7} {'p99.9':>7}")
    for axes in (1, 3):
        compare(list(range(1, axes + 1)))


def compare(nodes: list[int]) -> None:
    """Two lines."""
    spec = f"hub:cycle-{os.getpid()}-{len(nodes)}"
    ours: list[Figures] = []
    theirs: list[Figures] = []
    with simulated_drives(spec, nodes):
        for _ in range(RUNS):
            gc.collect()  # here, as a drive minds a host that stands still once it is set up
            with our_cycle(spec, nodes) as cycle:
                ours.append(measure(cycle))
            gc.collect()
            with their_cycle(spec, nodes) as cycle:
                theirs.append(measure(cycle))
    base = statistics.median(run.cpu_us for run in theirs)
    for name, runs in (("canopen, frozen client", theirs), ("servobench", ours)):
        cpu_us = statistics.median(run.cpu_us for run in runs)
        latencies = np.concatenate([run.latencies_us for run in runs])
        p50, p99, p999 = np.percentile(latencies, [50, 99, 99.9])
        unanswered = sum(run.unanswered for run in runs)
        note = f"   {unanswered} cycles without a TPDO1" if unanswered else ""
        title = f"{len(nodes)} axes, {name}"
        print(
            f"{title:32} {cpu_us:8.1f} {cpu_us / base:7.2f} {'':16} {p50:7.0f} {p99:7.0f} {p999:7.0f}{note}"
        )


def measure(cycle: Cycle) -> Figures:
    """CYCLES on a grid of PERIOD_NS; a tick that was missed is left out."""
    latencies: list[float] = []
    unanswered = 0
    due = Instant(CLOCK.now() + PERIOD_NS)
    used_s = 0.0
    for number in range(WARM_UP + CYCLES):
        if number == WARM_UP:
            used_s = cpu_s()
        due = Instant(max(due + PERIOD_NS, CLOCK.now() + PERIOD_NS // 2))
        latency, answered = cycle(number, due)
        if number >= WARM_UP:
            latencies.append(latency / NS_PER_US)
            unanswered += not answered
    used_s = cpu_s() - used_s
    return Figures(used_s / CYCLES * 1e6, latencies, unanswered)


def cpu_s() -> float:
    """Processor time of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


@contextmanager
def our_cycle(spec: str, nodes: list[int]) -> Iterator[Cycle]:
    """By the link, the pump and the drive client."""
    opened = open_bus(parse_bus_spec(spec), BITRATE_BIT_S)
    link = BusLink(opened.bus, CLOCK, opened.stamps, opened.name)
    network = CanopenNetwork(link, CLOCK, writes=RIG)
    drives = [ServoDrive(network, node) for node in nodes]
    for drive in drives:
        drive.connect(network.deadline_after(PATIENCE_NS))
        # Patient with the host, so that other work on this machine does not stop the drives.
        drive.configure(
            DriveSettings(
                Duration(PERIOD_NS),
                position_every_cycles=POSITION_EVERY_CYCLES,
                host_heartbeat_timeout_ms=5_000,
            )
        )
    pump = network.frame_pump

    def cycle(number: int, due: Instant) -> tuple[Duration, bool]:
        started = CLOCK.now()
        pump.send_sync()
        waiting = {0x180 + node for node in nodes}
        while waiting and pump.pump_one(due):
            if not link.last_own:
                waiting.discard(link.last_id)
        command = Command(number, 0.001 * (number % 7), due, Instant(due + PERIOD_NS))
        for drive in drives:
            drive.take_readings()
            drive.write(command)
        latency = Duration(CLOCK.now() - started)
        pump.rest(due)
        return latency, not waiting

    try:
        yield cycle
    finally:
        opened.bus.shutdown()


@contextmanager
def their_cycle(spec: str, nodes: list[int]) -> Iterator[Cycle]:
    """By canopen's own means, with the PDOs that the drives were left with."""
    bus = FrozenHubBus(spec.partition(":")[2], bitrate=BITRATE_BIT_S)
    network = canopen.Network()
    network.bus = bus
    remotes = set_up(network, bus, nodes)
    notify = network.notify

    def receive(until: Instant) -> can.Message | None:
        message = bus.recv(max(0, until - CLOCK.now()) / NS_PER_S)
        if message is not None:
            notify(message.arbitration_id, message.data, message.timestamp)
        return message

    def cycle(number: int, due: Instant) -> tuple[Duration, bool]:
        started = CLOCK.now()
        network.sync.transmit()
        waiting = {0x180 + node for node in nodes}
        while waiting and (message := receive(due)) is not None:
            waiting.discard(message.arbitration_id)
        for remote in remotes:
            for pdo in remote.tpdo.values():
                for variable in pdo:
                    variable.raw  # noqa: B018
            remote.rpdo[1][0x6071].raw = number % 7
            remote.rpdo[1].transmit()
        latency = Duration(CLOCK.now() - started)
        if number % HEARTBEAT_CYCLES == 0:
            network.send_message(0x77F, b"\x05")
        while receive(due) is not None or CLOCK.now() < due:
            pass
        return latency, not waiting

    try:
        yield cycle
    finally:
        bus.shutdown()


def set_up(network: canopen.Network, bus: can.BusABC, nodes: list[int]) -> list[Any]:
    """The nodes, operational, with their PDO maps as they hold them; a thread reads meanwhile."""
    notifier = can.Notifier(bus, network.listeners, timeout=0.05)
    remotes = []
    for node in nodes:
        remote: Any = canopen.RemoteNode(node, data_sheet(node))
        network.add_node(remote)
        remote.sdo[0x1016][1].raw = 0  # no watch over a host's heartbeat
        remote.tpdo.read()
        remote.rpdo.read()
        for maps in (remote.tpdo, remote.rpdo):
            for number in [number for number, pdo in maps.items() if not pdo.enabled]:
                del maps.map.maps[number]
        remote.nmt.send_command(1)
        remotes.append(remote)
    notifier.stop()
    return remotes


def data_sheet(node: int) -> io.StringIO:
    """The EDS of a simulated servo."""
    text = io.StringIO(export_eds(SimulatedServo(node, LING).dictionary))
    text.name = "servo.eds"
    return text


@contextmanager
def simulated_drives(spec: str, nodes: list[int]) -> Iterator[None]:
    """``hil simulate`` in a process of its own."""
    motor = ROOT / "examples" / "motors" / "ling2012.toml"
    hil = str(Path(sysconfig.get_path("scripts"), "hil"))
    command = [hil, "simulate", "--bus", spec, "--motor", str(motor), "--node", *map(str, nodes)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        if not any("Ctrl-C ends it" in line for line in process.stderr):
            raise RuntimeError(f"hil simulate ended with {process.wait()}")
        try:
            yield
        finally:
            process.terminate()
            process.wait()


if __name__ == "__main__":
    main()

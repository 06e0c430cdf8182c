"""SYNCs of a bench on the hub while a crowd is at its door: 5000 sockets that say nothing, ten that join.

Three kinds of turns of a second, in an order drawn anew for each block of three, within one run:

    quiet       nobody
    elsewhere   the crowd is at the door of another hub: it takes as much of the machine
    crowded     the crowd is at the door of the bench's hub

What is compared is by how much the distance of two SYNCs differs from the period, by the hub's own stamps
as a third client has them. Other load of the machine strikes the turns of a block alike, now and then one of
them alone: so the quantiles of the two turns of each block are divided, and the median of the ratios is told,
with the 95 % interval of 2000 resamples of the blocks.
"""

import argparse
import os
import resource
import select
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.canopen.cob_ids import SYNC
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Instant, MonotonicClock
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.bus.hub_place import HubPlace
from tests.scenario.processes import changed_bench, hub_name, simulated_drive, start_run

PERIOD_NS: Final = NS_PER_MS
BENCH: Final = {"period_us": 1000, "decide_after_us": 700, "deadline_us": 900}
PATIENT: Final = {"dropouts_consecutive_max": 5000, "dropouts_percent_max": 100.0}
"""A busy machine is to end no run."""
BLOCKS: Final = 40
SECONDS: Final = 100.0
"""After so many no block begins: a crowded machine takes a while to start a run, and more for each block."""
TURN_NS: Final = NS_PER_S
SETTLING_NS: Final = NS_PER_S // 5
"""Of each turn, before it counts: a crowd comes, or the last one's sockets are closed."""
LOOK_EVERY_NS: Final = 100 * NS_PER_MS
PATIENCE_NS: Final = 10 * NS_PER_S
SOCKETS, JOINING = 5_000, 10
KINDS: Final = ("quiet", "elsewhere", "crowded")
RESAMPLES: Final = 2_000
CLOCK: Final = MonotonicClock()

Turns = dict[str, list[NDArray[np.float64]]]
"""Differences in us, by kind, of each block."""


def main() -> None:
    """Print two tables."""
    parser = argparse.ArgumentParser(prog=f"python -m {__spec__.name}", description=__doc__)
    parser.add_argument("--blocks", type=int, default=BLOCKS)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--crowd", help="be the crowd at the door of this hub")
    given = parser.parse_args()
    if given.crowd is not None:
        crowd(given.crowd)
        return
    turns = measured(given.blocks, given.seconds)
    print(f"{'us':10} {'SYNCs':>7} {'p50':>7} {'p99':>7} {'p99.9':>8} {'max':>8}")
    for kind in KINDS:
        found = np.concatenate(turns[kind])
        quantiles = np.percentile(found, [50, 99, 99.9, 100])
        print(f"{kind:10} {len(found):7}", "{:7.1f} {:7.1f} {:8.1f} {:8.1f}".format(*quantiles))
    print(f"\n{'median of the ratios':24} {'p50':>20} {'p99':>20} {'p99.9':>20}")
    for kind, base in (("crowded", "elsewhere"), ("crowded", "quiet"), ("elsewhere", "quiet")):
        ratios = (ratio(turns[kind], turns[base], percent) for percent in (50, 99, 99.9))
        print(
            f"{kind + ' / ' + base:24}",
            *(f"{value:6.2f} ({low:.2f} to {high:.2f})" for value, low, high in ratios),
        )


def ratio(
    turns: Sequence[NDArray[np.float64]], base: Sequence[NDArray[np.float64]], percent: float
) -> tuple[float, float, float]:
    """The median of the ratios of each block's quantiles, and the ends of its interval."""
    ratios = np.array(
        [np.percentile(a, percent) / np.percentile(b, percent) for a, b in zip(turns, base, strict=True)]
    )
    resampled = np.random.default_rng(1).choice(ratios, (RESAMPLES, len(ratios)))
    low, high = np.percentile(np.median(resampled, axis=1), [2.5, 97.5])
    return float(np.median(ratios)), float(low), float(high)


def measured(blocks: int, seconds: float) -> Turns:
    """One run, so many blocks of turns in it, or those that begin within ``seconds``."""
    ends_at = CLOCK.now() + seconds * NS_PER_S
    draw, turns = Random(1), Turns((kind, []) for kind in KINDS)
    bus = hub_name("crowd")
    name = bus.removeprefix("hub:")
    with (
        tempfile.TemporaryDirectory() as folder,
        simulated_drive(bus),
        HubBus(f"{name}-other"),
        crowd_at(f"{name}-other") as elsewhere,
        crowd_at(name) as crowded,
    ):
        duration_s = 60.0 + 10.0 * blocks
        bench = changed_bench(Path(folder), duration_s=duration_s, **BENCH, **PATIENT)
        run = start_run(bench, bus, Path(folder) / "run")
        with HubBus(name, batches=True) as listener:
            while (frame := listener.recv(10.0)) is None or frame.arbitration_id != SYNC:
                pass
            for block in range(blocks):
                if block and CLOCK.now() >= ends_at:
                    break
                for kind in draw.sample(KINDS, len(KINDS)):
                    there = {"elsewhere": elsewhere, "crowded": crowded}.get(kind)
                    turns[kind].append(turn(listener, there))
        run.terminate()
        run.communicate()
    return turns


def turn(listener: HubBus, there: subprocess.Popen[str] | None) -> NDArray[np.float64]:
    """Differences of one turn, us, with the crowd of ``there``."""
    if there is not None:
        _say(there, listener)
    begins = CLOCK.now() + SETTLING_NS
    stamps = list(_syncs(listener, begins, begins + TURN_NS))
    if there is not None:
        _say(there, listener)
    return np.abs(np.diff(np.array(stamps, dtype=np.int64)) - PERIOD_NS) / NS_PER_US


def _syncs(listener: HubBus, begins: int, ends: int) -> Iterator[Instant]:
    """Stamps of those in between; what a busy machine has left in the queue by ``ends`` is read as well."""
    port = listener.frame_port
    while CLOCK.now() < ends + PATIENCE_NS:
        frame = port.receive(Instant(CLOCK.now() + LOOK_EVERY_NS))
        if frame is not None and frame.can_id == SYNC and port.came_at >= begins:
            if port.came_at >= ends:
                return
            yield port.came_at
    raise RuntimeError(f"no SYNC for {PATIENCE_NS / NS_PER_S:.0f} s: the run has ended")


def _say(crowd: subprocess.Popen[str], listener: HubBus) -> None:
    """That it is to come, or to go; returns when it has heard. A listener that meanwhile takes no frames is
    dropped by the hub."""
    assert crowd.stdin is not None
    assert crowd.stdout is not None
    crowd.stdin.write("\n")
    crowd.stdin.flush()
    while not select.select([crowd.stdout], [], [], 0.0)[0]:
        listener.frame_port.receive(Instant(CLOCK.now() + LOOK_EVERY_NS))
    crowd.stdout.readline()


@contextmanager
def crowd_at(name: str) -> Iterator[subprocess.Popen[str]]:
    """A process that crowds the door of the hub ``name`` from one line to the next."""
    command = [sys.executable, "-m", __spec__.name, "--crowd", name]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def crowd(name: str) -> None:
    """Knock and join from one line of stdin to the next; a line says that each was heard."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    sockets = min(SOCKETS, most - 100)
    knocking: list[socket.socket] = []
    path = str(HubPlace(name).socket)
    here = False
    while True:
        if not here or select.select([0], [], [], 0.0)[0]:
            if not os.read(0, 1):
                return
            here = not here
            _close(knocking)
            os.write(1, b"\n")
            continue
        if len(knocking) == sockets:
            _close(knocking)
        if len(knocking) % (sockets // JOINING) == 0:
            HubBus(name).shutdown()
        knocking.append(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        knocking[-1].connect(path)


def _close(sockets: list[socket.socket]) -> None:
    while sockets:
        sockets.pop().close()


if __name__ == "__main__":
    main()

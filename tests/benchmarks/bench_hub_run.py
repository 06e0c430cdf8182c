"""Processor time of ``hil run`` whole on the hub, all its processes, beside a plain loop of python-canopen.

A cycle of 1 kHz of each, in turns, on the drives of one ``hil simulate``. ``hil run`` is looked at from
outside between two instants of its loop, so that start, set-up and end are left out: bench, logger and
terminal, user and system. The plain loop is that of bench_hub_cycle: SYNC, TPDOs awaited and read, commands;
without records, limits or a thread. The hub's broker and the drives are neither's.
"""

import gc
import os
import statistics
import subprocess
import sysconfig
import tempfile
from collections.abc import Iterator
from pathlib import Path

from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration, Instant
from servobench.hil.configuration.config_files import toml_text
from tests.benchmarks.bench_hub_cycle import (
    CLOCK,
    PERIOD_NS,
    POSITION_EVERY_CYCLES,
    ROOT,
    measure,
    our_cycle,
    simulated_drives,
    their_cycle,
)

RUNS = 3
SETTLED_NS, SEEN_NS = Duration(NS_PER_S), Duration(5 * NS_PER_S)
"""From the loop's begin on, what a first second costs once, and what is looked at."""
DURATION_S = 8.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
OPTIONS = {"hil run": "--record", "hil run --no-record": "--no-record"}


def main() -> None:
    """Print a table."""
    gc.disable()
    print(f"{'':32} {'CPU us':>8} {'ratio':>7}   of it by process")
    for axes in (1, 3):
        compare(list(range(1, axes + 1)))


def compare(nodes: list[int]) -> None:
    """Print three lines."""
    spec = f"hub:run-{os.getpid()}-{len(nodes)}"
    plain: list[float] = []
    whole: dict[str, list[list[float]]] = {title: [] for title in OPTIONS}
    with simulated_drives(spec, nodes), tempfile.TemporaryDirectory() as scratch:
        bench = Path(scratch, "bench.toml")
        bench.write_text(toml_text(_bench(nodes)), encoding="utf-8")
        with our_cycle(spec, nodes):
            pass  # maps the PDOs that the plain loop takes over
        for number in range(RUNS):
            gc.collect()
            with their_cycle(spec, nodes) as cycle:
                plain.append(measure(cycle).cpu_us)
            for title, option in OPTIONS.items():
                folder = [str(Path(scratch, str(number)))] if option == "--record" else []
                whole[title].append(_cycle_us(["run", str(bench), "--bus", spec, option, *folder]))
    base = statistics.median(plain)
    print(f"{f'{len(nodes)} axes, canopen':32} {base:8.1f} {1.0:7.2f}")
    for title, runs in whole.items():
        each = [statistics.median(costs) for costs in zip(*runs, strict=True)]
        parts = " ".join(f"{cost:.0f}" for cost in each)
        print(f"{f'{len(nodes)} axes, {title}':32} {sum(each):8.1f} {sum(each) / base:7.2f}   {parts}")


def _cycle_us(arguments: list[str]) -> list[float]:
    """Processor time of a cycle, by process."""
    hil = str(Path(sysconfig.get_path("scripts"), "hil"))
    with subprocess.Popen(
        [hil, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as run:
        assert run.stderr is not None
        if not any(line.startswith("running") for line in run.stderr):
            raise RuntimeError(f"hil {' '.join(arguments)} ended with {run.wait()}")
        began = CLOCK.now()
        CLOCK.sleep_until(Instant(began + SETTLED_NS))
        before = _spent_s(run.pid)
        CLOCK.sleep_until(Instant(began + SETTLED_NS + SEEN_NS))
        after = _spent_s(run.pid)
        run.stderr.read()
    cycles = SEEN_NS // PERIOD_NS
    return [(after[process] - spent) * NS_PER_S / NS_PER_US / cycles for process, spent in before.items()]


def _spent_s(process: int) -> dict[int, float]:
    """User and system time of a process and of those below it, the oldest first."""
    spent = {}
    for each in sorted(_below(process)):
        fields = Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()
        spent[each] = (int(fields[11]) + int(fields[12])) / TICKS_PER_S
    return spent


def _below(process: int) -> Iterator[int]:
    yield process
    for thread in Path(f"/proc/{process}/task").iterdir():
        for child in (thread / "children").read_text().split():
            yield from _below(int(child))


def _bench(nodes: list[int]) -> dict[str, object]:
    """Return a bench of these nodes, patient with the host: other work here is not to stop them."""
    motor = str(ROOT / "examples" / "motors" / "ling2012.toml")
    controller = {"kind": "pid", "proportional_nm_s_rad": 0.12, "integral_nm_rad": 2.0}
    limits = {"speed_max_rpm": 2500.0, "torque_max_nm": 5.0, "dropouts_consecutive_max": 2000}
    drive = {"motor": motor, "controller": controller, "limits": limits}
    step = {"at_s": 0.2, "kind": "step", "speed_rpm": 500.0}
    return {
        "bench": {"name": "hub", "duration_s": DURATION_S},
        "bus": {"spec": "simulated", "bitrate_bit_s": 1_000_000},
        "host": {"heartbeat_timeout_ms": 5_000},
        "loop": {
            "period_us": PERIOD_NS // NS_PER_US,
            "decide_after_us": 700,
            "deadline_us": 2_000,
            "position_every_cycles": POSITION_EVERY_CYCLES,
        },
        "drive": {f"axis{node}": {"node": node, **drive} for node in nodes},
        "reference": {f"axis{node}": [step] for node in nodes},
        "verdict": {"dropouts_percent_max": 100.0, "missed_percent_max": 100.0},
    }


if __name__ == "__main__":
    main()

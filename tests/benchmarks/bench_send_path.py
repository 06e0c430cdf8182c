"""Instructions that a cycle costs at the wire, here and in another checkout, by callgrind in turns.

    git worktree add ../before COMMIT
    python -m tests.benchmarks.bench_send_path ../before

A cycle: a SYNC is sent, its echo and a reading come, a command is sent, over a pair of sockets in the place
of an adapter's. Its instructions are those of a process with twice as many cycles less those of one with as
many. Each checkout counts as it is compiled: what is compared must be compiled in both, or in neither
(``SERVOBENCH_PURE=1``). Processor time is that of the same cycles without callgrind, the least of some runs.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parents[2]
CYCLES, TIMED_CYCLES = 500, 20_000
COUNTS, TURNS = 1, 5
PROGRAM: Final = """
import os, socket, sys, time
from importlib import import_module
from types import SimpleNamespace

house = "servobench." if os.path.isdir("servobench") else ""  # an older checkout has no such folder
BusLink = import_module(f"{house}drivers.wire.link").BusLink
SocketcanPort = import_module(f"{house}drivers.wire.socketcan").SocketcanPort
MonotonicClock = import_module(f"{house}drivers.timebase").MonotonicClock
assert import_module(f"{house}drivers").__path__[0].startswith(os.getcwd())

near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
clock = MonotonicClock()
named = ["can0"] if "channel" in SocketcanPort.__init__.__code__.co_varnames else []
port = SocketcanPort(near, clock, True, *named)
link = BusLink(SimpleNamespace(frame_port=port), clock, name="can0")
link.send(0x181, bytes(8))
reading = far.recv(16)


def cycles(count):
    for _ in range(count):
        link.send(0x080, b"")
        far.send(far.recv(16))
        assert link.fetch(clock.now() + 10**9)
        far.send(reading)
        assert link.fetch(clock.now() + 10**9)
        link.send(0x201, bytes(8))
        far.recv(16)


cycles(100)
began = time.process_time_ns()
cycles(int(sys.argv[1]))
print((time.process_time_ns() - began) / int(sys.argv[1]) / 1e3)
"""


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("other", type=Path, help="another checkout, with a link to this environment or none")
    checkouts = {"here": HERE, "there": parser.parse_args().other.resolve()}
    counts: dict[str, list[int]] = {name: [] for name in checkouts}
    times_us: dict[str, list[float]] = {name: [] for name in checkouts}
    with tempfile.TemporaryDirectory() as scratch:
        for turn in range(TURNS):
            for name, folder in checkouts.items():
                times_us[name].append(float(_run(folder, TIMED_CYCLES)))
                if turn < COUNTS:
                    sums = [_instructions(folder, number, Path(scratch)) for number in (CYCLES, 2 * CYCLES)]
                    counts[name].append((sums[1] - sums[0]) // CYCLES)
    print(f"{'':28}" + "".join(f"{name:>12}" for name in checkouts) + f"{'ratio':>12}")
    for title, values in (("instructions a cycle", counts), ("us of processor a cycle", times_us)):
        here, there = (min(values[name]) for name in checkouts)
        print(f"{title:28}{here:12,.6g}{there:12,.6g}{here / there:12.3f}")


def _instructions(folder: Path, cycles: int, scratch: Path) -> int:
    profile = scratch / "profile"
    _run(folder, cycles, "valgrind", "--tool=callgrind", f"--callgrind-out-file={profile}")
    found = re.search(r"^(?:summary|totals): (\d+)", profile.read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1])


def _run(folder: Path, cycles: int, *tool: str) -> str:
    environment = {**os.environ, "PYTHONHASHSEED": "0", "PYTHONPATH": str(folder)}
    command = [*tool, sys.executable, "-c", PROGRAM, str(cycles)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr)
    return done.stdout


if __name__ == "__main__":
    main()

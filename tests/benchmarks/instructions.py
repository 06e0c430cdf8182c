"""Instructions of a cycle, counted by callgrind around the loop alone, and whose they are.

The examples with one and three axes, recorded, in this checkout as it is compiled. The second from 0.5 s of
the loop on is counted: start, bring-up and what a first cycle finds once are left out. Beside it stands the
processor time of the same second without callgrind, the least of some runs. Counts of one build differ by
0.3 % from run to run.

Told is the rise against tests/benchmarks/instructions.json; status 1 where it is above 3 %. ``--keep`` writes
that file. Counts of two interpreters say nothing about a change of ours: of a file that was kept with another
one the rise is told, and no status comes of it.
"""

import json
import os
import platform
import re
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from servobench import run

ROOT: Final = Path(__file__).parents[2]
BASELINE: Final = Path(__file__).with_suffix(".json")
BENCHES: Final = {"1 axis": "ling2012.toml", "3 axes": "three_axes.toml"}
FROM_S, TO_S = 0.5, 1.5
CYCLES: Final = 1_000
REPEATS: Final = 3
RISE_MAX: Final = 0.03
OWNERS: Final = (
    (r"compiled_(\w+)__mypyc", r"compiled \1"),
    (r"(\w+)/core/native", r"core of \1"),
    (r"libpython|/bin/python", "libpython"),
    (r"/lib-dynload/", "Python's extensions"),
    (r"site-packages/(\w+)", r"\1"),
    (r"/lib(c|m|pthread)\.so|/ld-linux", "libc"),
    (r"^\?+$", "code made at run time"),
)
"""Pattern of a library's path, and whose its instructions are; the first that fits."""


def main() -> int:
    """Print a table; the exit status."""
    if "--loop" in sys.argv:
        bench, folder = sys.argv[sys.argv.index("--loop") + 1 :]
        _run_loop(bench, folder, counted="--counted" in sys.argv)
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        counts = {title: _count(bench, Path(scratch, title)) for title, bench in BENCHES.items()}
        times_us = {title: _time_us(bench, Path(scratch, title)) for title, bench in BENCHES.items()}
    _print(counts, times_us)
    made_with = f"Python {platform.python_version()}, {platform.python_compiler()}"
    if "--keep" in sys.argv:
        BASELINE.write_text(
            json.dumps({"made with": made_with, "instructions a cycle": counts}, indent=1) + "\n"
        )
        return 0
    return compare(counts, made_with, json.loads(BASELINE.read_text()))


def compare(counts: Mapping[str, Mapping[str, int]], made_with: str, kept: Mapping[str, Any]) -> int:
    """Print the rise against what was kept; 1 if it is too large, with the same interpreter."""
    same: bool = kept["made with"] == made_with
    print(f"\nagainst the kept ones{'' if same else ', made with ' + kept['made with']}")
    rises = {}
    for title, owners in counts.items():
        before = kept["instructions a cycle"][title]
        rises[title] = sum(owners.values()) / sum(before.values()) - 1.0
        moved = {owner: owners.get(owner, 0) - before.get(owner, 0) for owner in {*owners, *before}}
        most = sorted(moved, key=lambda owner: -abs(moved[owner]))[:3]
        print(
            f"{title:28} {rises[title]:+12.2%}   " + ", ".join(f"{owner} {moved[owner]:+,}" for owner in most)
        )
    if max(rises.values()) <= RISE_MAX:
        return 0
    print(f"The loop costs more than {RISE_MAX:.0%} more; if that is worth it: make instructions KEEP=1")
    return int(same)


def _print(counts: dict[str, dict[str, int]], times_us: dict[str, float]) -> None:
    print(f"{'instructions a cycle':28}" + "".join(f"{title:>20}" for title in counts))
    sums = {title: sum(owners.values()) for title, owners in counts.items()}
    all_owners = {owner for owners in counts.values() for owner in owners}
    most = {owner: max(owners.get(owner, 0) for owners in counts.values()) for owner in all_owners}
    for owner in sorted(most, key=lambda owner: -most[owner]):
        shares = [
            (owners.get(owner, 0), owners.get(owner, 0) / sums[title]) for title, owners in counts.items()
        ]
        print(f"{owner:28}" + "".join(f"{count:12,} {share:6.1%}" for count, share in shares))
    print(f"{'all':28}" + "".join(f"{sums[title]:12,}       " for title in counts))
    print(f"{'us of processor a cycle':28}" + "".join(f"{times_us[title]:12.1f}       " for title in counts))
    print(f"{'x real time':28}" + "".join(f"{1e3 / times_us[title]:12.1f}       " for title in counts))


def _count(bench: str, folder: Path) -> dict[str, int]:
    """Instructions of a cycle by owner."""
    profile = folder.with_suffix(".callgrind")
    tool = ["valgrind", "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={profile}"]
    _start(tool, ["--counted"], bench, folder)
    return by_owner(profile.read_text())


def _time_us(bench: str, folder: Path) -> float:
    """Processor time of a cycle."""
    return min(float(_start([], [], bench, Path(f"{folder}-{number}"))) for number in range(REPEATS))


def _start(tool: list[str], options: list[str], bench: str, folder: Path) -> str:
    """What the loop's process printed. Leaves the program if it failed."""
    # The order of a set of strings, and with it the way through the program, is that of every run.
    environment = {**os.environ, "PYTHONHASHSEED": "0", "CI": "1"}
    command = [sys.executable, "-m", __spec__.name, *options, "--loop", bench, str(folder)]
    done = subprocess.run(
        [*tool, *command], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(done.stderr)
    return done.stdout


def _run_loop(bench: str, folder: str, counted: bool) -> None:
    """One run; prints what a cycle took of the processor, us."""
    began_s = 0.0

    def watch(phase: str, elapsed_s: float) -> None:
        nonlocal began_s
        if phase == "running" and elapsed_s == FROM_S:
            began_s = processor_s()
            if counted:
                switch("on")
        elif phase == "running" and elapsed_s == TO_S:
            if counted:
                switch("off")
            print((processor_s() - began_s) * 1e6 / CYCLES)

    run(ROOT / "examples" / bench, record=folder, progress=watch)


def processor_s() -> float:
    """Time that this process has had of a processor."""
    spent = resource.getrusage(resource.RUSAGE_SELF)
    return spent.ru_utime + spent.ru_stime


def switch(state: str) -> None:
    """Have callgrind count from here on, or no longer."""
    command = ["callgrind_control", "--instr=" + state, str(os.getpid())]
    silent = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    # Not by subprocess: half of that would be counted.
    _, status = os.waitpid(os.posix_spawnp(command[0], command, os.environ, file_actions=silent), 0)
    if status:
        raise ChildProcessError(f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}")


def by_owner(profile: str) -> dict[str, int]:
    """Instructions of a cycle, from callgrind's format: a function's own, not those of what it calls."""
    names: dict[str, str] = {}
    sums: Counter[str] = Counter()
    owner, called = "", False
    for line in profile.splitlines():
        if named := re.match(r"c?ob=(\(\d+\))(?: (.*))?", line):
            number, path = named.groups()
            if path is not None:
                names[number] = _owner_of(path)
            if line.startswith("ob="):
                owner = names[number]
        elif line.startswith("calls="):
            called = True  # the next line has the costs of the call
        elif re.match(r"[\d+*-]", line):
            if not called:
                sums[owner] += int(line.split()[1])
            called = False
    return {owner: round(count / CYCLES) for owner, count in sums.most_common() if count >= CYCLES}


def _owner_of(path: str) -> str:
    """Whose the code of this library is."""
    for pattern, owner in OWNERS:
        if fits := re.search(pattern, path):
            return fits.expand(owner)
    return Path(path).name


if __name__ == "__main__":
    sys.exit(main())

"""``python -m tests.core_fuzz --seconds 60``: a sanitized core under drawn worlds; a seed replays one.

The core is built with AddressSanitizer, UndefinedBehaviorSanitizer and asserts into a folder of its own, and
a process with the sanitizer preloaded runs the worlds on it. What a sanitizer finds ends that process.
"""

import argparse
import os
import random
import subprocess
import sys
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from tempfile import TemporaryDirectory

from servobench.design.core.build import LIBRARY, ROOMS, SANITIZED, build, compiler
from servobench.drivers.timebase import NS_PER_S, MonotonicClock

PROGRAM = "tests.core_fuzz"


def preloaded() -> str | None:
    """The library that a process with the sanitized core loads first; None where the compiler has none."""
    command = compiler() or ["false"]
    asked = [*command, "-print-file-name=libasan.so"]
    found = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return found if Path(found).is_absolute() else None


def use(folder: str) -> None:
    """Let this process take the cores of that folder in the place of those beside their sources."""
    for room in ROOMS:
        name = f"servobench.{room}.core.native"
        spec = spec_from_loader(name, ExtensionFileLoader(name, str(Path(folder, room, LIBRARY))))
        assert spec is not None
        sys.modules[name] = module_from_spec(spec)


def run(cores: str, seed: int, worlds: int, seconds: float) -> int:
    """Worlds from ``seed`` on; how many there were."""
    use(cores)
    from tests.core_fuzz.worlds import WORLDS

    clock = MonotonicClock()
    until = clock.now() + seconds * NS_PER_S
    done = 0
    while done < worlds and clock.now() < until:
        print(seed + done, flush=True)
        WORLDS[(seed + done) % len(WORLDS)](random.Random(seed + done))
        done += 1
    return done


def main() -> int:
    """Build, run, and tell: the exit status."""
    parser = argparse.ArgumentParser(prog=f"python -m {PROGRAM}")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--worlds", type=int, default=1 << 40)
    parser.add_argument("--cores", default="")
    asked = parser.parse_args()
    if asked.cores:
        run(asked.cores, asked.first, asked.worlds, asked.seconds)
        return 0
    library = preloaded()
    if library is None:
        print("no libasan here: nothing was tried")
        return 3
    with TemporaryDirectory() as folder:
        for room in ROOMS:
            Path(folder, room).mkdir()
            build(room, Path(folder, room, LIBRARY), SANITIZED)
        environment = {**os.environ, "LD_PRELOAD": library, "ASAN_OPTIONS": "detect_leaks=0"}
        done = subprocess.run(
            [sys.executable, "-m", PROGRAM, "--cores", folder, *sys.argv[1:]],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
    seeds = done.stdout.split()
    said = "silent" if done.returncode == 0 else "NOT SILENT"
    print(f"{len(seeds)} worlds from seed {asked.first} on: {said}")
    if done.returncode:
        print(f"seed {seeds[-1] if seeds else '-'}:\n{done.stderr[-6000:]}")
    return int(done.returncode != 0)


if __name__ == "__main__":
    sys.exit(main())

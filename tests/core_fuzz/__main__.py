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

from design.core.build import LIBRARY, SANITIZED, build, compiler
from drivers.timebase import NS_PER_S, MonotonicClock

NATIVE = "virtual_bus.core.native"


def preloaded() -> str | None:
    """The library that a process with the sanitized core loads first; None where the compiler has none."""
    command = compiler() or ["false"]
    asked = [*command, "-print-file-name=libasan.so"]
    found = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return found if Path(found).is_absolute() else None


def use(core: str) -> None:
    """Let this process take that core in the place of the one beside its sources."""
    spec = spec_from_loader(NATIVE, ExtensionFileLoader(NATIVE, core))
    assert spec is not None
    sys.modules[NATIVE] = module_from_spec(spec)


def run(core: str, seed: int, worlds: int, seconds: float) -> int:
    """Worlds from ``seed`` on; how many there were."""
    use(core)
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
    parser = argparse.ArgumentParser(prog="python -m tests.core_fuzz")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--worlds", type=int, default=1 << 40)
    parser.add_argument("--core", default="")
    asked = parser.parse_args()
    if asked.core:
        run(asked.core, asked.first, asked.worlds, asked.seconds)
        return 0
    library = preloaded()
    if library is None:
        print("no libasan here: nothing was tried")
        return 3
    with TemporaryDirectory() as folder:
        core = Path(folder, LIBRARY)
        build("virtual_bus", core, SANITIZED)
        environment = {**os.environ, "LD_PRELOAD": library, "ASAN_OPTIONS": "detect_leaks=0"}
        done = subprocess.run(
            [sys.executable, "-m", "tests.core_fuzz", "--core", str(core), *sys.argv[1:]],
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

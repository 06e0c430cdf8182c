"""Builds the core, ``python virtual_bus/core/build.py``, and tells whether the one that is there is fresh.

With the machine's C compiler, or with the one that the package ziglang brings. It imports nothing of the
project's until something is amiss: it runs before anything is installed.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from hashlib import blake2b
from importlib.util import find_spec
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).resolve().parent
LIBRARY: Final = FOLDER / "native.abi3.so"
FLAGS: Final = (
    "-std=c17",
    "-O2",
    "-DNDEBUG",
    # A fused multiply-add, where the processor has it, would change the last bit of a result.
    "-ffp-contract=off",
    "-fPIC",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
    "-Wconversion",
)
SANITIZED: Final = (
    "-O1",
    "-g",
    "-UNDEBUG",
    "-fno-omit-frame-pointer",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
)
"""Added for ``build.py debug``; Python then wants libasan preloaded."""
PACKAGE: Final = "ziglang>=0.14"
"""Of a machine without a C compiler."""


def sources() -> list[Path]:
    """What is compiled, with its headers; empty in an installed package."""
    return sorted([*FOLDER.glob("*.c"), *FOLDER.glob("*.h")])


def digest() -> str:
    """What tells one version of the sources from another."""
    made = blake2b(" ".join(FLAGS).encode(), digest_size=16)
    for path in sources():
        made.update(path.name.encode() + path.read_bytes())
    return made.hexdigest()


def compiler() -> list[str] | None:
    """The command of a C compiler: ``CC``, the machine's, or that of the package; None if there is none."""
    if named := shlex.split(os.environ.get("CC", "")):
        return named
    for name in ("cc", "gcc", "clang"):
        if path := shutil.which(name):
            return [path]
    return [sys.executable, "-m", "ziglang", "cc"] if find_spec("ziglang") else None


def required() -> list[str]:
    """The packages that a build needs here."""
    return [] if compiler() else [PACKAGE]


def build(library: Path = LIBRARY, added: Sequence[str] = ()) -> None:
    """Compile the sources into ``library``, with flags ``added``. Leaves the program with what is amiss."""
    command = compiler()
    if command is None:
        sys.exit(f"The core: no C compiler was found; install one, or: pip install '{PACKAGE}'")
    part = library.with_name(f"{library.name}.{os.getpid()}.part")
    marked = f'-DSOURCES_DIGEST="{digest()}"'
    files = [str(path) for path in sources() if path.suffix == ".c"]
    done = subprocess.run([*command, *FLAGS, *added, marked, "-shared", "-o", str(part), *files, "-lm"])
    if done.returncode:
        part.unlink(missing_ok=True)
        sys.exit(f"The core does not compile: {shlex.join(command)} ended with status {done.returncode}")
    part.replace(library)


@cache
def check_built() -> None:
    """Error: BadInput where the core is missing, or was built from other sources than those beside it."""
    from drivers.errors import BadInput

    remedy = "make core" if sources() else "install servobench again"
    try:
        from virtual_bus.core.native import SOURCES_DIGEST
    except ImportError as error:
        raise BadInput("the native core", LIBRARY.name, str(error), f"one that is built: {remedy}") from error
    if sources() and digest() != SOURCES_DIGEST:
        raise BadInput("the native core", LIBRARY.name, "built from other sources", f"a fresh one: {remedy}")


def main(arguments: Sequence[str]) -> None:
    """``compiler``: status 1 if there is none; ``debug``: build with sanitizers; otherwise as it is used."""
    if arguments == ["compiler"]:
        sys.exit(compiler() is None)
    build(added=SANITIZED if arguments == ["debug"] else ())


if __name__ == "__main__":
    main(sys.argv[1:])

"""Builds the native code, ``python design/core/build.py``, and checks that an existing library is fresh.

A library for each room that computes in C: its own sources, and the headers beside this file. The machine's C
compiler builds it, or the one in the package ziglang. Nothing of the project is imported: this runs before
anything is installed.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from hashlib import blake2b
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Final

SHARED: Final = Path(__file__).resolve().parent
ROOMS: Final = ("design", "drivers", "virtual_bus", "hil")
LIBRARY: Final = "native.abi3.so"
FLAGS: Final = (
    "-std=c17",
    "-O3",
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
"""Compiler package for a machine without a C compiler."""


def folder_of(room: str) -> Path:
    """Return the folder of a room's sources and library."""
    return SHARED.parents[1] / room / "core"


def sources(room: str) -> list[Path]:
    """Return the sources with their headers; empty in an installed package."""
    folder = folder_of(room)
    return sorted({*folder.glob("*.c"), *folder.glob("*.h"), *SHARED.glob("*.h")})


def digest(room: str) -> str:
    """Return a digest that identifies this version of the sources."""
    made = blake2b(" ".join(FLAGS).encode(), digest_size=16)
    for path in sources(room):
        made.update(path.name.encode() + path.read_bytes())
    return made.hexdigest()


def compiler() -> list[str] | None:
    """Return the command of a C compiler: ``CC``, the machine's, or that of the package; None if there is
    none."""
    if named := shlex.split(os.environ.get("CC", "")):
        return named
    for name in ("cc", "gcc", "clang"):
        if path := shutil.which(name):
            return [path]
    return [sys.executable, "-m", "ziglang", "cc"] if find_spec("ziglang") else None


def required() -> list[str]:
    """Return the packages that a build needs here."""
    return [] if compiler() else [PACKAGE]


def build(room: str, library: Path | None = None, added: Sequence[str] = ()) -> None:
    """Compile a room's sources into ``library``, that of the room if None, with flags ``added``.

    Exits with a message on failure.
    """
    command = compiler()
    if command is None:
        sys.exit(f"The core: no C compiler was found; install one, or: pip install '{PACKAGE}'")
    library = library or folder_of(room) / LIBRARY
    part = library.with_name(f"{library.name}.{os.getpid()}.part")
    marked = (f'-DSOURCES_DIGEST="{digest(room)}"', f"-I{SHARED}")
    files = [str(path) for path in sources(room) if path.suffix == ".c"]
    done = subprocess.run([*command, *FLAGS, *added, *marked, "-shared", "-o", str(part), *files, "-lm"])
    if done.returncode:
        part.unlink(missing_ok=True)
        sys.exit(f"The core does not compile: {shlex.join(command)} ended with status {done.returncode}")
    part.replace(library)


def build_all(added: Sequence[str] = ()) -> None:
    """Build each room's library."""
    for room in ROOMS:
        build(room, added=added)


def check_built(room: str, refused: Callable[[str, str], Exception]) -> None:
    """Raise ``refused(found, expected)`` if the room's library is missing, or was built from other sources
    than those beside it."""
    checkout = bool(sources(room))
    remedy = "make core" if checkout else "install servobench again"
    try:
        built = import_module(f"servobench.{room}.core.native").SOURCES_DIGEST
    except ImportError as error:
        raise refused(str(error), f"one that is built: {remedy}") from error
    if checkout and digest(room) != built:
        raise refused("built from other sources", f"a fresh one: {remedy}")


def main(arguments: Sequence[str]) -> None:
    """Run a command: ``compiler``: status 1 if there is none; ``debug``: build with sanitizers; otherwise
    build normally."""
    if arguments == ["compiler"]:
        sys.exit(compiler() is None)
    build_all(SANITIZED if arguments == ["debug"] else ())


if __name__ == "__main__":
    main(sys.argv[1:])

"""A seeded sample of mutants over the lines of the product, held against the unit tests of their rooms.

A mutant is judged by those test files of its room that call the function that it is in; in a module that
numba compiles, whose calls nobody sees, by those that import it. Which they are is found out once for each
state of the tree, which takes some minutes, and kept in build/.
"""

import hashlib
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from random import Random
from typing import Final

from tests.code_mutants.mutations import Mutant, mutants_of
from tests.code_mutants.workshop import ROOT, Workshop

ROOMS: Final = ("design", "drivers", "hil", "virtual_bus")
KEPT: Final = ROOT / "build" / "code_mutants.json"
MAPPING_TIMEOUT_S: Final = 600.0

Calls = dict[str, list[tuple[str, int]]]
"""Of each test file: file and first line of the functions that it calls."""


def sample(seed: int) -> Iterator[Mutant]:
    """Lines of the product drawn without return, each with one of its mutants; the same for the same seed."""
    random = Random(seed)
    texts = {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
        for room in ROOMS
        for path in sorted((ROOT / room).rglob("*.py"))
    }
    lines = [(file, line) for file, text in texts.items() for line in range(1, text.count("\n") + 1)]
    random.shuffle(lines)
    mutants = cache(lambda file: mutants_of(file, texts[file]))
    for file, line in lines:
        here = [mutant for mutant in mutants(file) if mutant.line == line]
        if here:
            yield random.choice(here)


def room_of(mutant: Mutant) -> str:
    """The first folder of its file."""
    return mutant.place.file.partition("/")[0]


def unit_tests(room: str) -> list[str]:
    """The unit test files of a room."""
    paths = sorted((ROOT / "tests" / "unit" / room).rglob("test_*.py"))
    return [path.relative_to(ROOT).as_posix() for path in paths]


def calls_of(shop: Workshop, tests: list[str], kept: Path = KEPT) -> Calls:
    """Which functions each of the test files calls. Raises RuntimeError if one fails without a mutant."""
    digest = _digest()
    try:
        held = json.loads(kept.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        held = {}
    calls: Calls = held["calls"] if held.get("digest") == digest else {}
    for number, test in enumerate(tests, start=1):
        if test in calls:
            continue
        print(f"\r  what the unit tests call: {number} of {len(tests)} files", end="", flush=True)
        noted = shop.folder / "calls.json"
        noted.unlink(missing_ok=True)
        if shop.run(["-x", test], MAPPING_TIMEOUT_S, str(noted)) != 0:
            raise RuntimeError(f"without a mutant this fails: {test}\n{shop.said()}")
        calls[test] = [(file, line) for file, line in json.loads(noted.read_text(encoding="utf-8"))]
        kept.parent.mkdir(exist_ok=True)
        kept.write_text(json.dumps({"digest": digest, "calls": calls}), encoding="utf-8")
    print()
    return {test: [(file, line) for file, line in calls[test]] for test in tests}


def callers(mutant: Mutant, calls: Calls, room: str) -> list[str]:
    """The test files of a room that call the mutant's function; those that call least come first, as they
    are about it."""
    home = f"tests/unit/{room}/"
    file = mutant.place.file
    place = (file, 0 if file in _unseen() else mutant.function_line)
    found = [test for test, called in calls.items() if test.startswith(home) and place in called]
    return sorted(found, key=lambda test: len(calls[test]))


@cache
def _unseen() -> set[str]:
    """Modules whose functions numba compiles."""
    paths = (path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
    return {
        path.relative_to(ROOT).as_posix()
        for path in paths
        if "\nimport numba\n" in path.read_text(encoding="utf-8")
    }


def _digest() -> str:
    digest = hashlib.sha256()
    for folder in (*ROOMS, "tests"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()

"""A seeded sample of mutants over the lines of the product, and which tests are to judge each.

First those unit test files of its room that call the function that it is in. Then, of what these let pass,
the other rooms' unit tests that call it, and all other tests that reach its file by imports. Of both, what
takes too long is not waited for: the shares killed are lower bounds.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from threading import Lock
from typing import Any, Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.code_mutants.imports import ROOMS, digest, reached
from tests.code_mutants.mutations import Mutant, mutants_of
from tests.code_mutants.workshop import ROOT, SHORTEST_S, Fate, Workshop

KEPT: Final = ROOT / "build" / "code_mutants.jsonl"
MAPPING_TIMEOUT_S: Final = 180.0
"""Of a unit test file while its calls are noted. One that takes longer, as it runs whole commands, judges
what the others let pass."""
TEST_TIMEOUT_S: Final = 60.0
"""Of one unit test, which takes a few seconds: beyond that a loop has no end."""
FILE_TIMEOUT_S: Final = 120.0
"""Of one file of the other tests: beyond that the next is more likely to see the mutant."""
_BLIND: Final = tuple(
    f"tests/{part}" for part in ("unit/", "vcan/", "dask/", "code_mutants/", "scenario/test_compile")
)
"""What is judged by its calls, needs another machine, is about this tool, or fails for any edited module."""


class Kept:
    """Answers that cost time, in a file, so that a run goes on where the last was cut off."""

    def __init__(self, path: Path = KEPT) -> None:
        self._path = path
        self._lock = Lock()
        self._answers: dict[str, Any] = {}
        if path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                with suppress(ValueError):  # it was cut off
                    self._answers.update([json.loads(line)])

    def answer(self, question: list[str], tests: list[str], find: Callable[[], Any]) -> Any:
        """What was found before, of the same tests on the same files, or is found now."""
        whole = json.dumps([question, [[test, digest(test)] for test in tests]])
        key = hashlib.sha256(whole.encode()).hexdigest()
        if key not in self._answers:
            answer = find()
            with self._lock:
                self._answers[key] = answer
                self._path.parent.mkdir(exist_ok=True)
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(f"\n{json.dumps([key, answer])}")
        return self._answers[key]


@dataclass(frozen=True, slots=True)
class Called:
    """By a test file."""

    seconds: float
    lines: dict[str, list[int]]
    """Of each file the first lines of the functions called; 0 if it is imported."""

    @property
    def count(self) -> int:
        """Of functions."""
        return sum(map(len, self.lines.values()))


Calls = dict[str, Called]


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


def tests_in(folder: str) -> list[str]:
    """Those in it."""
    return [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / folder).rglob("test_*.py"))]


def called_by(shop: Workshop, test: str) -> Called:
    """What a test file calls; nothing if it takes too long. Raises RuntimeError if it fails."""
    noted = shop.folder / "calls.json"
    noted.unlink(missing_ok=True)
    clock = MonotonicClock()
    began = clock.now()
    status = shop.run(["-x", "--timeout=0", test], MAPPING_TIMEOUT_S, str(noted))
    if status not in (0, "timeout"):
        raise RuntimeError(f"without a mutant this fails: {test}\n{shop.said()}")
    lines = json.loads(noted.read_text(encoding="utf-8")) if status == 0 else {}
    return Called((clock.now() - began) / NS_PER_S, lines)


def callers(mutant: Mutant, calls: Calls) -> list[str]:
    """The unit test files that call the mutant's function; those that call least come first, as they are
    about it."""
    file = mutant.place.file
    found = [test for test, called in calls.items() if mutant.function_line in called.lines.get(file, ())]
    return sorted(found, key=lambda test: calls[test].count)


def slow(mutant: Mutant, calls: Calls) -> list[str]:
    """The unit test files whose calls are not known that reach the mutant's file."""
    file = mutant.place.file
    return [test for test, called in calls.items() if not called.lines and file in reached(test)]


def others(mutant: Mutant) -> list[str]:
    """The tests that are no unit tests and reach the mutant's file: the fewer imports away the sooner, then
    those that name it or its command, then those that reach least."""
    file = mutant.place.file
    found = [test for test in tests_in("tests") if not test.startswith(_BLIND) and file in reached(test)]

    def order(test: str) -> tuple[int, bool, int]:
        named = Path(file).stem in (ROOT / test).read_text(encoding="utf-8")
        return reached(test)[file], not named, len(reached(test))

    return sorted(found, key=order)


def judged(shop: Workshop, mutant: Mutant, tests: list[str], calls: Calls) -> Fate:
    """By unit tests, all in one process.

    Those that do not end in time have seen the mutant only if they do without it: the machine may be busy.
    """
    if not tests:
        return Fate.SURVIVED
    limit_s = max(SHORTEST_S, 10.0 * sum(calls[test].seconds for test in tests))
    each_s = TEST_TIMEOUT_S if all(calls[test].lines for test in tests) else MAPPING_TIMEOUT_S
    asked = [f"--timeout={each_s:.0f}", *tests]
    pure = not mutant.function_line  # a compiled module holds the constants of others
    status = shop.status_of(mutant, asked, limit_s, pure)
    late = status == "timeout" or "Timeout (>" in shop.said()
    killed = status != 0 and not (late and shop.run(["-x", *asked], limit_s, pure=pure) != 0)
    return Fate.KILLED if killed else Fate.SURVIVED


def killer(shop: Workshop, mutant: Mutant, tests: list[str], seconds: float) -> str:
    """The first of these test files that fails, and without the mutant does not; "" if none has in this time.

    A file that takes too long has seen nothing.
    """
    clock = MonotonicClock()
    ends_at = clock.now() + seconds * NS_PER_S
    pure = not mutant.function_line
    for test in tests:
        left_s = (ends_at - clock.now()) / NS_PER_S
        if left_s <= 0.0:
            break
        status = shop.status_of(mutant, [test], min(left_s, FILE_TIMEOUT_S), pure)
        if status not in (0, "timeout") and shop.run(["-x", test], 2.0 * FILE_TIMEOUT_S, pure=pure) == 0:
            return test
    return ""

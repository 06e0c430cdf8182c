"""A copy of the tree in which mutants are made and tested; the checkout itself is never touched."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from enum import StrEnum
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory
from typing import Final, TypeVar

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.code_mutants.mutations import Mutant

ROOT: Final = Path(__file__).parents[2]
_LEFT_OUT: Final = shutil.ignore_patterns(
    ".*", "__pycache__", "build", "dist", "runs", "recordings", "*.egg-info"
)
TIMEOUT_S: Final = 120.0
SHORTEST_S: Final = 10.0
"""A machine with other work keeps a process waiting for seconds."""
Item = TypeVar("Item")
Result = TypeVar("Result")


class Fate(StrEnum):
    """What became of a mutant."""

    KILLED = "killed"
    SURVIVED = "survived"


class Workshop:
    """One copy, and the process that runs tests in it, one run at a time."""

    def __init__(self, folder: Path, server: "subprocess.Popen[str]") -> None:
        self.folder = folder
        self._server = server

    def run(
        self, arguments: Sequence[str], timeout_s: float = TIMEOUT_S, calls: str = "", pure: bool = True
    ) -> int | str:
        """The exit status of pytest, or "timeout". ``calls``: a file for the functions called; ``pure``: all
        interpreted, else what is compiled from sources that are as they were runs compiled."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        run = {"arguments": list(arguments), "timeout_s": timeout_s, "calls": calls, "pure": pure}
        print(json.dumps(run), file=self._server.stdin, flush=True)
        answer = self._server.stdout.readline()
        if not answer:
            raise RuntimeError("the process that runs the tests has ended")
        status: int | str = json.loads(answer)
        return status

    def said(self) -> str:
        """The output of the last run."""
        return (self.folder / "said.txt").read_text(encoding="utf-8", errors="replace")

    def check(self, tests: Sequence[str]) -> float:
        """How long a mutant of these tests may take, s: ten times as long as they take without one.

        Raises RuntimeError if they fail without a mutant: then they could not judge one.
        """
        clock = MonotonicClock()
        began = clock.now()
        if self.run(["-x", *tests]) != 0:
            raise RuntimeError(f"without a mutant these fail: {' '.join(tests)}\n{self.said()}")
        return max(SHORTEST_S, 10.0 * (clock.now() - began) / NS_PER_S)

    def fate_of(self, mutant: Mutant, tests: Sequence[str], timeout_s: float = TIMEOUT_S) -> Fate:
        """Whether these tests see the mutant; a mutant that ends no more, or cannot be imported, is seen."""
        return Fate.SURVIVED if self.status_of(mutant, tests, timeout_s) == 0 else Fate.KILLED

    def status_of(
        self, mutant: Mutant, tests: Sequence[str], timeout_s: float, pure: bool = True
    ) -> int | str:
        """What :meth:`run` tells of these tests with the mutant."""
        path = self.folder / mutant.place.file
        original = path.read_text(encoding="utf-8")
        try:
            path.write_text(mutant.text(original), encoding="utf-8")
            return self.run(["-x", *tests], timeout_s, pure=pure)
        finally:
            path.write_text(original, encoding="utf-8")


@contextmanager
def workshop() -> Iterator[Workshop]:
    """A copy of the tree as it stands, uncommitted changes and all, for as long as the context lasts.

    Byte code is neither written nor read for the product: a mutant may be as long and as old as the original.
    """
    with TemporaryDirectory(prefix="code-mutants-") as name:
        folder = Path(name) / "tree"
        shutil.copytree(ROOT, folder, ignore=_LEFT_OUT, symlinks=True)
        server = subprocess.Popen(
            ["nice", "-n", "19", sys.executable, "tests/code_mutants/server.py"],
            cwd=folder,
            env=os.environ
            | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        with server:
            try:
                yield Workshop(folder, server)
            finally:
                server.terminate()


class Workshops:
    """Several of them, and as many threads that take what there is to do."""

    def __init__(self, shops: Sequence[Workshop], pool: ThreadPoolExecutor) -> None:
        self._free: SimpleQueue[Workshop] = SimpleQueue()
        for shop in shops:
            self._free.put(shop)
        self._pool = pool

    def map(self, work: Callable[[Workshop, Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """The results in the order of the items."""

        def one(item: Item) -> Result:
            shop = self._free.get()
            try:
                return work(shop, item)
            finally:
                self._free.put(shop)

        return self._pool.map(one, items)


@contextmanager
def workshops(number: int) -> Iterator[Workshops]:
    """So many workshops, for as long as the context lasts."""
    with ExitStack() as stack:
        shops = [stack.enter_context(workshop()) for _ in range(number)]
        yield Workshops(shops, stack.enter_context(ThreadPoolExecutor(number)))

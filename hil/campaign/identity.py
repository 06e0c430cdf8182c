"""Content on which the rows of a campaign depend: its sweep, every file that a run opened, the program.

    {"sweep": BLAKE2b of the sweep,
     "program": {"servobench": version, "source": BLAKE2b, "commit": ..., "python": ...,
                 PACKAGE: version, ...},
     "files": {path from the folder of the sweep file on: BLAKE2b}}

All of it is the same from any working directory, and in a tree that was moved as a whole.
"""

import os
import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, Final

from servobench.drivers.errors import BadInput
from servobench.hil.campaign.opened_files import ABSENT, DIGEST_BYTES, ROOMS, ROOT, digest_of, opened_files
from servobench.hil.recording.run_metadata import source_commit

Identity = dict[str, Any]
"""Plain values, as above."""
_RESTORE: Final = "restore it, or begin a campaign in a folder of its own with --out"
_NAME: Final = re.compile(r"[A-Za-z0-9._-]+")


class SourceFiles:
    """The files opened by the runs of a campaign: each has one content in all of its runs."""

    def __init__(self, sweep: Path, digests: Mapping[str, str] | None = None) -> None:
        """``sweep``: the sweep file; ``digests``: those already stored in the campaign."""
        self._folder = os.path.realpath(sweep.parent)
        self.digests = dict(digests or {})
        """Digests by path relative to the folder of the sweep."""
        self._fresh: dict[str, str] = {}

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Note the files opened inside. Raises BadInput for a file that has changed."""
        with opened_files() as opened:
            yield
        self.meet({os.path.relpath(path, self._folder): digest for path, digest in opened.digests.items()})
        for path, before, now in opened.changed():
            raise _changed(path, now, before)

    def meet(self, digests: Mapping[str, str]) -> None:
        """Take in files opened by others. Raises BadInput for one with other contents here."""
        for name, digest in digests.items():
            known = self.digests.get(name)
            if known is None:
                self.digests[name] = self._fresh[name] = digest
            elif known != digest:
                raise _changed(self._path(name), digest, known)

    def fresh(self) -> dict[str, str]:
        """Return files noted since the last call."""
        fresh, self._fresh = self._fresh, {}
        return fresh

    def require(self, digests: Mapping[str, str]) -> None:
        """Resume a campaign with these files. Raises BadInput for the first that has changed."""
        for name, digest in digests.items():
            now = self.digests.get(name) or digest_of(self._path(name))
            if now != digest:
                raise _changed(self._path(name), now, digest)
        self.meet(digests)

    def _path(self, name: str) -> str:
        return os.path.normpath(os.path.join(self._folder, name))


def _changed(path: str, now: str, before: str) -> BadInput:
    def shown(digest: str) -> str:
        return digest if digest == ABSENT else f"BLAKE2b {digest}"

    return BadInput(path, "", shown(now), f"{shown(before)}, as other runs of the campaign met it", _RESTORE)


@cache
def program() -> dict[str, str]:
    """Identify the program: servobench by content, its required packages by version."""
    digest = blake2b(digest_size=DIGEST_BYTES)
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*")):
            if path.suffix in (".py", ".toml", ".c", ".h") and path.is_file():
                digest.update(f"{path.relative_to(ROOT)}\0".encode())
                digest.update(path.read_bytes())
    told = {"source": digest.hexdigest(), "commit": source_commit(), "python": platform.python_version()}
    waiting = ["servobench"]
    while waiting:
        name = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
        if name in told:
            continue
        try:
            told[name] = version(name)
        except PackageNotFoundError:
            continue
        wanted = requires(name) or ()  # of its own extras too, as far as they are there
        needed = [each for each in wanted if name == "servobench" or "extra ==" not in each]
        waiting += [match[0] for each in needed if (match := _NAME.match(each))]
    return told


def require_program(before: Mapping[str, str], source: str) -> None:
    """Raise BadInput for another program than that of the campaign in the file ``source``."""
    now = program()
    for name in sorted((before.keys() | now.keys()) - {"commit"}):
        if before.get(name) == now.get(name):
            continue
        commits = f"; commit {before.get('commit')}, now {now['commit']}" if name == "source" else ""
        expected = f"{now.get(name, 'none')}, which is what runs here"
        raise BadInput(
            source, f"identity.program.{name}", before.get(name, "none"), expected + commits,
            "rows of two programs make no table: take that one, or a folder of its own with --out",
        )  # fmt: skip

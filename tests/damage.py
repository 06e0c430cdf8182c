"""``python -m tests.damage``: recordings damaged by seed, and what each reader of them says.

Whoever reads a damaged recording is told so by the name of the file, or is shown what can be shown: no reader
ends with a traceback (exit 70), nor takes memory without bounds. Prints a line for each damage, and leaves
with 1 if a reader did otherwise. ``--bits`` flips single bits, too, of which each recording has its own.
"""

import argparse
import contextlib
import random
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from typer.testing import CliRunner

from servobench.hil.cli import app

EXAMPLE: Final = Path(__file__).parents[1] / "examples" / "blackout.toml"
MEMORY_MAX_MB: Final = 900.0
_TOLD: Final = (0, 1, 2, 5)
"""Exit statuses of this run's readers: shown, not passed, refused, and not what was recorded."""
_REFUSED: Final = (2, 5)
Spoil = Callable[[bytes, random.Random], bytes]
Reader = Callable[[Path, Path, Path], Sequence[str]]
"""Arguments for a damaged recording, the whole one, and a folder to write into."""


def _cut(content: bytes, draw: random.Random) -> bytes:
    return content[: int(draw.random() * len(content))]


def _without_end(content: bytes, draw: random.Random) -> bytes:
    return content[: -draw.randint(1, 200)]


def _blotted(content: bytes, draw: random.Random) -> bytes:
    place, what = int(draw.random() * len(content)), draw.choice((b"\0", b"\xff", b"9"))
    blot = what * draw.randint(1, 64)
    return content[:place] + blot[: len(content) - place] + content[place + len(blot) :]


def _flipped(content: bytes, draw: random.Random) -> bytes:
    spoilt = bytearray(content)
    for _ in range(draw.randint(1, 5)) if content else ():
        spoilt[int(draw.random() * len(content))] ^= 1 << draw.randrange(8)
    return bytes(spoilt)


_KINDS: Final[dict[str, Spoil]] = {
    "empty": lambda _content, _draw: b"",
    "cut": _cut,
    "without its end": _without_end,
    "doubled": lambda content, _draw: content + content,
    "blotted": _blotted,
}
_READERS: Final[dict[str, Reader]] = {
    "review": lambda run, _whole, out: ("review", f"{run}", "--report", f"{out / 'review.html'}"),
    "why": lambda run, _whole, _out: ("why", f"{run}"),
    "trace": lambda run, _whole, _out: ("trace", f"{run}"),
    "window": lambda run, _whole, _out: ("trace", f"{run}", "--from", "0.1", "--to", "0.12"),
    "compare": lambda run, whole, _out: ("compare", f"{whole}", f"{run}"),
    "csv": lambda run, _whole, out: ("export", f"{run}", "--to", "csv", "--out", f"{out / 'rows.csv'}"),
    "asc": lambda run, _whole, out: ("export", f"{run}", "--to", "asc", "--out", f"{out / 'frames.asc'}"),
    "paper": lambda run, _whole, out: ("picture", f"{run}", f"{out / 'paper.svg'}", "--paper"),
}
_SEALED: Final = ("review", "window")
"""Read with their seal, too, which refuses for all readers alike; a window holds but a part against it."""


class Damaged(NamedTuple):
    """One file of a recording, spoilt."""

    seed: int
    file: str
    kind: str

    def __str__(self) -> str:
        return f"{self.seed}: {self.file} {self.kind}"


def damage(whole: Path, copy: Path, seed: int, kinds: dict[str, Spoil]) -> Damaged:
    """Make ``copy`` of a recording with one spoilt file."""
    draw = random.Random(seed)
    shutil.copytree(whole, copy)
    files = sorted(each.name for each in whole.iterdir() if each.stat().st_size)
    file = files[seed % len(files)]
    kind = draw.choice(sorted(kinds))
    (copy / file).write_bytes(kinds[kind]((whole / file).read_bytes(), draw))
    return Damaged(seed, file, kind)


def complaints(spoilt: Damaged, copy: Path, whole: Path) -> Iterator[str]:
    """What readers do that they must not."""
    with tempfile.TemporaryDirectory() as out:
        for name, arguments in _READERS.items():
            for sealed in (True, False) if name in _SEALED else (False,):
                asked = [*arguments(copy, whole, Path(out)), *(() if sealed else ("--unsealed",))]
                ended = CliRunner().invoke(app, asked)
                how = f"{name}{'' if sealed else ' --unsealed'}"
                if ended.exception and not isinstance(ended.exception, SystemExit):
                    yield f"{how}: {ended.exception!r}"
                elif ended.exit_code not in _TOLD:
                    yield f"{how}: exit {ended.exit_code}: {ended.output.strip()[-300:]}"
                elif ended.exit_code in _REFUSED and spoilt.file not in ended.output:
                    yield f"{how}: does not name {spoilt.file}: {ended.output.strip()[-300:]}"


def main() -> None:
    """Damage, read, and tell."""
    parser = argparse.ArgumentParser(prog="python -m tests.damage", description=__doc__)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--bits", action="store_true")
    asked = parser.parse_args()
    kinds = {**_KINDS, **({"flipped": _flipped} if asked.bits else {})}
    wrong = 0
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        whole = Path("whole")
        ran = CliRunner().invoke(app, ["run", str(EXAMPLE), "--record", str(whole)])
        assert ran.exit_code == 1, ran.output
        for seed in range(asked.first, asked.first + asked.count):
            copy = Path(f"damaged{seed}")
            spoilt = damage(whole, copy, seed, kinds)
            found = list(complaints(spoilt, copy, whole))
            print("; ".join((str(spoilt), *found)), flush=True)
            wrong += bool(found)
            shutil.rmtree(copy)
    # ru_maxrss would be that of the process which started this one, where that was larger
    peak_mb = int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[0]) / 1024
    print(f"{asked.count} recordings, {wrong} wrongly told; {peak_mb:.0f} MB at most")
    raise SystemExit(wrong > 0 or peak_mb > MEMORY_MAX_MB)


if __name__ == "__main__":
    main()

"""Sealed files altered: bits flipped, cut, bytes or blocks swapped, another file's content in their place.

Each is refused by file, soon and in little memory, by what every command asks first; and of one in
:data:`COMMAND_EACH` by a whole command of its own, sealed or with ``--unsealed``, in a process that is forked
from this one: what that took is told by the kernel.
"""

import gc
import os
import random
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import typer.main
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.hil import cli
from servobench.hil.rows.run_files import SEAL_FILE
from tests.mutants.evidence import Evidence, made_evidence
from tests.mutants.mutant import PROCESSOR_S_MAX, processor_s

MEMORY_MAX_KB: Final = 500_000
"""That one mutant may cost; of a command what its process has beyond the tests', of which it is a fork."""
COMMAND_EACH: Final = 50
"""Mutants for one that goes through a command too, which takes so many times as long."""
STATUSES: Final = (0, 1, 2, 3, 4, 5, 6)
"""docs/exit-status.md; 70 is a defect."""
REFUSED: Final = (2, 5)
LISTED: Final = "runs"
"""The command that refuses nothing, and says of each recording what is wrong with it."""
BLOCK: Final = 64
LIMIT_S: Final = 60
"""In which a command ends on the slowest machine; then its alarm does it."""


def mutated(data: bytes, others: Sequence[bytes], draw: random.Random) -> bytes:
    """Other bytes than ``data``, which is not empty; ``others``: files of the same folder."""
    other = bytearray(data)
    while other == data:
        kind, at, to = draw.randrange(6), draw.randrange(len(data)), draw.randrange(len(data))
        if kind == 0:
            other[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del other[at:]
        elif kind == 2:
            other[at], other[to] = other[to], other[at]
        elif kind == 3:
            begin, end = sorted((at, to))
            end = max(end, begin + BLOCK)
            first, second = other[begin : begin + BLOCK], other[end : end + BLOCK]
            other[end : end + BLOCK], other[begin : begin + BLOCK] = first, second
        elif kind == 4:
            other[at:at] = draw.randbytes(draw.randrange(1, BLOCK))
        else:
            other[:] = draw.choice(others)
    return bytes(other)


def seal_breaker(folder: Path) -> Callable[[int], list[str]]:
    """Makes recordings and campaigns in ``folder``; what is wrong with a mutant of one, by number."""
    folder.mkdir(parents=True)
    made = made_evidence(folder, in_a_process)
    for command in dict.fromkeys(command for evidence in made for command in evidence.commands):
        folders = [evidence.folder for evidence in made if command in evidence.commands]
        CliRunner().invoke(cli.app, [part.format(folders[0]) for part in command])  # imports what it needs
    typer.main.get_command = cache(typer.main.get_command)  # each process would build all commands anew
    typer.main.get_command(cli.app)
    gc.collect()
    gc.freeze()  # else the end of each command would look through all of it
    places = [(path, evidence) for evidence in made for path in evidence.files]
    wholes = {path: path.read_bytes() for path, _ in places}

    def broken(number: int) -> list[str]:
        draw = random.Random(number)
        path, evidence = draw.choice(places)
        mutant = mutated(wholes[path], [wholes[other] for other in evidence.files], draw)
        path.write_bytes(mutant)
        killed = path.name == SEAL_FILE and left_by_a_kill(mutant, wholes[path])
        try:
            found = [*_refused_wrongly(path, evidence)]
            if number % COMMAND_EACH == 0:
                found += _ended_wrongly(path, evidence, killed, draw, folder / "said")
        finally:
            path.write_bytes(wholes[path])
        return [f"seal, mutant {number} of {path}: {text}" for text in found]

    return broken


def left_by_a_kill(seal: bytes, whole: bytes) -> bool:
    """Whether a seal lacks its last line or a part of it, and nothing else: a campaign is resumed then."""
    kept, _, last = whole[:-1].rpartition(b"\n")
    rest = seal[len(kept) + 1 :]
    return seal.startswith(kept + b"\n") and b"\n" not in rest and len(rest) <= len(last) + 1


def _refused_wrongly(path: Path, evidence: Evidence) -> Iterator[str]:
    Path("/proc/self/clear_refs").write_text("5")  # from here on the most that this process has
    memory_kb, begun = _most_memory_kb(), processor_s()
    try:
        evidence.check()
        yield "it was accepted"
    except BadInput as error:
        unlisted = path.name == SEAL_FILE and f"no line of {SEAL_FILE} has it" in str(error)
        if error.source != str(path) and not unlisted:
            yield f"it was refused as {error}"
    yield from _beyond("it", processor_s() - begun, _most_memory_kb() - memory_kb)


def _ended_wrongly(
    path: Path, evidence: Evidence, killed: bool, draw: random.Random, said: Path
) -> Iterator[str]:
    command = [part.format(evidence.folder) for part in draw.choice(evidence.commands)]
    unsealed = evidence.can_be_unsealed and draw.random() < 0.5
    if unsealed:
        command.append("--unsealed")
    ended = in_a_process(command, said)
    told = re.search(rf"note: {path}: (no|an incomplete) last line", ended.text)
    goes_on = killed and command[-1] == "--resume" and told is not None
    if ended.status not in (STATUSES if unsealed else (0,) if command[0] == LISTED or goes_on else REFUSED):
        yield f"{command}: status {ended.status}: {ended.text[-1000:]}"
    whole = (
        command[0] == LISTED or path.name == SEAL_FILE
    )  # without a line of it another file is one too many
    if not unsealed and str(evidence.folder if whole else path) not in ended.text:
        yield f"{command}: names another file: {ended.text[-1000:]}"
    # What goes on replays a run, as it does where nothing was altered: 1.5 to 1.9 s of either, interpreted.
    yield from _beyond(f"{command}", 0.0 if goes_on else ended.processor_s, ended.memory_kb)


def _beyond(name: str, took_s: float, memory_kb: int) -> Iterator[str]:
    if took_s > PROCESSOR_S_MAX:
        yield f"{name} took {took_s:.1f} s"
    if memory_kb > MEMORY_MAX_KB:
        yield f"{name} took {memory_kb} kB"


class Ended(NamedTuple):
    """A command, and all processes that it has waited for."""

    status: int
    text: str
    processor_s: float
    memory_kb: int


def in_a_process(command: Sequence[str], said: Path) -> Ended:
    """A command line in a process that has nothing to import; ``said``: a file for what it prints."""
    ours_kb = int(Path("/proc/self/statm").read_text().split()[1]) * (os.sysconf("SC_PAGE_SIZE") // 1024)
    if not (process := os.fork()):
        _become(command, said)
    _, status, usage = os.wait4(process, 0)
    text = said.read_text(errors="replace")
    took_s = usage.ru_utime + usage.ru_stime
    return Ended(os.waitstatus_to_exitcode(status), text, took_s, usage.ru_maxrss - ours_kb)


def _become(command: Sequence[str], said: Path) -> None:
    stream = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    status: object = 70
    signal.alarm(LIMIT_S)
    try:
        sys.argv = ["hil", *command]
        cli.main()
    except SystemExit as leaving:
        status = leaving.code or 0
    finally:
        if sys.exc_info()[0] is not None:
            traceback.print_exc()
        for each in (sys.stdout, sys.stderr):
            with suppress(OSError):
                each.flush()
        os._exit(status if isinstance(status, int) else 70)


def _most_memory_kb() -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])

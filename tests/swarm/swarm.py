"""Runs cases whose processes or disk are struck, and holds each to the invariants.

A user does the same: with the command in a process of its own. What needs no processes: tests.swarm.members.

A case is forked from this process, which has imported everything, and forks its logger in turn
(:mod:`tests.swarm.warm`). The writing end of one pipe stays open in all of them: what the case has to say
comes through it, and when that ends they are all gone.
"""

import gc
import os
import pickle
import resource
import select
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final

from typer.testing import CliRunner

from servobench.drivers.timebase import NS_PER_S, Instant, MonotonicClock
from servobench.hil.cli import app
from servobench.hil.recording import run_metadata
from servobench.hil.terminal import report  # noqa: F401 - the command imports it when it is run
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.scenario.foreign_node import Act, beside_the_bench
from tests.swarm.cases import bench_text, case
from tests.swarm.invariants import broken
from tests.swarm.mishaps import STRIKE, Circumstances, Mishap, circumstances, disturbed
from tests.swarm.ran import Ran, Told
from tests.swarm.small_disk import small_disk
from tests.swarm.warm import ForkedProcess, forked_loggers
from tests.swarm.witness import DriveWitness, witnessed

PROCESSOR_S_MAX: Final = 60
WALL_S_MAX: Final = 180
"""A case takes a second or less; interpreted, and on a crowded machine, ten of them."""
NEVER_ENDS: Final = f"it has not ended after {WALL_S_MAX} s"


def warm() -> None:
    """Do what each case would do anew: load the compiled plant, ask for the commit, look through what there
    is for garbage, which would copy it all."""
    SimulatedServo(1, LING, DriveParameters(), 0)
    run_metadata.source_commit()
    gc.collect()
    gc.freeze()


def is_struck(number: int) -> bool:
    """Whether something befalls the processes of case ``number``, or its disk."""
    return _circumstances(number).mishap is not Mishap.NONE


def failures(number: int, folder: Path) -> list[str]:
    """What case ``number`` breaks; its files go below ``folder``."""
    ran = run_case(number, folder)
    found = [ran] if isinstance(ran, str) else broken(ran)
    return [f"case {number} ({_circumstances(number).mishap}): {text}" for text in found]


def run_case(number: int, folder: Path) -> Ran | str:
    """Case ``number``; in words why nothing came of it, if that is so."""
    place = folder / f"case-{number}"
    place.mkdir()
    told = in_child(partial(_run, number, place), place / "said")
    if isinstance(told, str):
        return told
    found = _circumstances(number)
    if found.mishap is Mishap.BOTH_KILLED and told.status is None:
        again = in_child(lambda _: _recover(place / "run"), place / "said")
        if isinstance(again, str):
            return f"hil recover: {again}"
        told = told._replace(recovered=again.status, said=again.said)
    return Ran(case(number), found, place / "run", told)


def in_child(do: Callable[[int], Told], log: Path) -> Told | str:
    """What ``do`` comes to in a process of its own, or why it comes to nothing; it and all its children are
    gone then. ``do`` is given a descriptor that stays open in them; ``log`` takes what they print."""
    receiving, sending = os.pipe()
    pid = os.fork()
    if not pid:
        os.close(receiving)
        _be_child(do, sending, log)
    os.close(sending)
    data = _until_all_are_gone(receiving, pid)
    os.close(receiving)
    os.waitpid(pid, 0)
    if data is None:
        return NEVER_ENDS
    if not data:
        return f"the process of the case ended without a word: {log.read_text(errors='replace')[-2000:]}"
    told: Told = pickle.loads(data)
    return told


def _be_child(do: Callable[[int], Told], sending: int, log: Path) -> None:
    status = 1
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_S_MAX, PROCESSOR_S_MAX))
        said = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for own in (1, 2):
            os.dup2(said, own)
        _send(sending, do(sending))
        status = 0
    finally:
        try:
            if status:
                traceback.print_exc(file=sys.__stderr__)
        finally:
            os._exit(status)


def _send(sending: int, told: Told) -> None:
    with open(sending, "wb", closefd=False) as pipe:
        pickle.dump(told, pipe)


def _until_all_are_gone(receiving: int, pid: int) -> bytes | None:
    """What came; None if they had to be killed."""
    clock = MonotonicClock()
    until = Instant(clock.now() + WALL_S_MAX * NS_PER_S)
    parts = []
    while select.select([receiving], [], [], max(0, until - clock.now()) / NS_PER_S)[0]:
        parts.append(os.read(receiving, 1 << 16))
        if not parts[-1]:
            return b"".join(parts)
    os.killpg(pid, signal.SIGKILL)
    return None


def _circumstances(number: int) -> Circumstances:
    config = case(number)
    return circumstances(number, config.bench.duration_s, len(config.axes))


def _run(number: int, place: Path, sending: int) -> Told:
    """In the process of the case."""
    found = _circumstances(number)
    bench = place / "bench.toml"
    bench.write_text(bench_text(number), encoding="utf-8")
    with ExitStack() as stack:
        disk = place
        if found.mishap is Mishap.DISK_FULL:
            disk = stack.enter_context(small_disk(place, found.count))
        started = stack.enter_context(forked_loggers(sending, partial(disturbed, found)))
        drives: list[DriveWitness] = []
        act = Act(found.at_s, partial(_kill, found.mishap, started, drives, sending))
        nodes: Sequence[Any] = [*found.strangers, *([act] if found.mishap in _KILLS else [])]
        stack.enter_context(beside_the_bench(*nodes))
        stack.enter_context(witnessed(drives))
        ran = CliRunner().invoke(app, ["run", str(bench), "--record", str(disk / "run"), "--json"])
    return Told(
        ran.exit_code,
        ran.stdout,
        ran.stderr,
        [drive.testimony() for drive in drives],
        logger_status=started[0].wait(0) if started else None,
    )


_KILLS: Final = (Mishap.LOGGER_KILLED, Mishap.HOST_KILLED, Mishap.BOTH_KILLED)


def _kill(
    mishap: Mishap, started: list[ForkedProcess], drives: list[DriveWitness], sending: int, now: Instant
) -> None:
    if mishap is not Mishap.HOST_KILLED:
        os.kill(started[0].pid, STRIKE)
        os.waitid(os.P_PID, started[0].pid, os.WEXITED | os.WNOWAIT)
    if mishap is not Mishap.LOGGER_KILLED:
        _send(sending, Told(None, "", "", [drive.testimony() for drive in drives], killed_at=now))
        os.kill(os.getpid(), signal.SIGKILL)


def _recover(run: Path) -> Told:
    ran = CliRunner().invoke(app, ["recover", str(run), "--json"])
    return Told(ran.exit_code, ran.stdout, ran.stderr, [])

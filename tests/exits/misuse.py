"""``python -m tests.exits.misuse --runs N --seed S``: commands whose user's code ends in every way.

Each is a whole ``hil run``, forked from a process that has imported all of it, with a way to end, a hook in
which it does, and streams to write to, drawn by its seed. Held against it: the status is a documented one; 0
only where the controller itself counted every planned cycle, and nothing was done that ends a run; stdout,
where it can be written, holds one object that says the same status, and nothing else.
"""

import argparse
import atexit
import gc
import json
import os
import select
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any, Final, NamedTuple

import servobench
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, MonotonicClock
from servobench.hil import cli
from servobench.hil.verdict.verdict import ExitStatus
from tests.scenario.processes import BENCH

CYCLES: Final = 60
LIMIT_S: Final = 30.0
"""Two seconds for threads that are left, and what shared cores take."""
HOOKS: Final = (
    *("__init__", "channels", "observer", "reset", "output", "update", "telemetry", "import"),
    *("observer.reset", "receive", "sent", "estimate"),
)

HARMLESS: Final = (
    "pass",
    "os.close(0)",
    "os.close(1); os.close(2)",
    "os.dup2(os.open('/dev/full', os.O_WRONLY), 1)",
    "os.dup2(os.open('/dev/null', os.O_WRONLY), 2)",
    "sys.stdout.close()",
    "sys.stderr.close()",
    "sys.stdout = sys.stderr = sys.stdin = None",
    "sys.stdout = sys.__stdout__ = open(os.devnull, 'w')",
    'print(\'{"verdict": {"exit_status": 0}}\', flush=True)',
    "os.write(1, b'{}'); os.write(2, b'{}')",
    "overflow()",
    "left_thread()",
    "held_pipes()",
    "os.fork()",
    "fork_and(lambda: print('twice'))",
    "thread(lambda: sys.exit(1))",
    "thread(lambda: 1 / 0)",
    "atexit.register(os._exit, 3)",
    "atexit.register(os.kill, os.getpid(), signal.SIGKILL)",
    "signal.signal(signal.SIGCHLD, signal.SIG_IGN)",
    "os.system('true')",
    "os.environ.clear()",
)
"""After these the run goes on to its end, and has passed."""
ENDING: Final = (
    "sys.exit()",
    "sys.exit(0)",
    "raise SystemExit('0')",
    "raise KeyboardInterrupt",
    "raise GeneratorExit",
    "raise BaseException",
    "raise RuntimeError",
    "raise StopIteration",
    "1 / 0",
    "os._exit(0)",
    "os._exit(1)",
    "os._exit(70)",
    "os._exit(255)",
    "thread(lambda: os._exit(0))",
    "ctypes.CDLL(None)._exit(0)",
    "ctypes.CDLL(None).exit(0)",
    "ctypes.string_at(0)",
    "ctypes.CDLL(None).abort()",
    "os.abort()",
    "os.kill(os.getpid(), signal.SIGKILL)",
    "os.kill(os.getpid(), signal.SIGSEGV)",
    "os.kill(os.getpid(), signal.SIGXCPU)",
    "os.kill(os.getpid(), signal.SIGINT)",
    "os.kill(os.getpid(), signal.SIGTERM)",
    "os.kill(os.getpid(), signal.SIGHUP)",
    "os.execv('/bin/true', ['true'])",
    "os.execlp('sleep', 'sleep', '100')",
    "thread(lambda: os.execv('/bin/true', ['true']))",
    "thread(lambda: os.execv('/bin/sleep', ['sleep', '100']))",
    "os.closerange(3, 300)",
    "os.closerange(0, 300)",
    "fork_and(lambda: 1 / 0)",
    "fork_and(lambda: os._exit(0))",
    "held_pipes(); os._exit(0)",
    "held_pipes(); ctypes.CDLL(None)._exit(0)",
    "left_thread(); raise SystemExit",
    "left_thread(); ctypes.string_at(0)",
    "atexit.register(os._exit, 0); raise SystemExit",
    "atexit.register(os._exit, 0); 1 / 0",
    "sys.stdout = sys.stderr = None; os._exit(0)",
    "os.close(1); os.close(2); raise RuntimeError",
    "setattr(sys, 'exit', lambda status=0: None); 1 / 0",
    "raise MemoryError",
    "raise type('Own', (Exception,), {'__str__': lambda _: sys.exit(0)})",
    "raise type('Own', (BaseException,), {'__str__': lambda _: 1 / 0})",
    "alarmed()",
    "stopped()",
)
"""After these no run has passed."""
TAMPERING: Final = (
    "sys.setrecursionlimit(40)",
    "sys.setrecursionlimit(70)",
    "sys.modules.clear()",
    "sys.modules.pop('json')",
    "sys.path.clear()",
    "sys.setprofile(lambda *_: 1 / 0)",
    "traced()",
    "put('builtins:open')",
    "put('builtins:__import__')",
    "put('json:dumps')",
    "put('json:loads', lambda *_, **__: {})",
    "put('json:dumps', lambda *_, **__: '{}')",
    "put('json:dumps', lambda *_, **__: '0')",
    "put('json:dumps.__code__', (lambda *_, **__: '[').__code__)",
    "put('json.encoder:JSONEncoder.encode')",
    "put('math:isfinite')",
    "put('pathlib:Path.read_text')",
    "put('sys:excepthook')",
    "put('sys:exit')",
    "put('threading:Thread.start')",
    "put('traceback:extract_tb', lambda *_: 1 / 0)",
    "put('traceback:print_exc', lambda *_, **__: 1 / 0); 1 / 0",
    "put('numpy:zeros')",
    "put('os:fsync', lambda _: 1 / 0)",
    "put('os:getpid', lambda: 1)",
    "put('os:write', os.read)",
    "put('os:write', lambda *_: 0)",
    "put('signal:signal')",
    "put('struct:Struct')",
    "put('time:monotonic_ns')",
    "put('time:sleep')",
    "put('typer:Exit')",
    "put('typer:echo')",
    "__import__('builtins').__dict__.pop('len')",
    "__import__('builtins').__dict__.clear()",
)
"""Of the interpreter itself: where the run survives it may pass, else it is the user's code that failed."""
REPLACEMENTS: Final = (
    "None",
    "0",
    "''",
    "os.read",
    "sys.exit",
    "lambda *_, **__: None",
    "lambda *_, **__: {}",
    "lambda *_, **__: 1 / 0",
    "property(lambda _: 1 / 0)",
)
"""What is put in the place of a function that a command calls."""
STREAMS: Final = ("file", "file", "file", "file", "closed", "/dev/full", "dead pipe")
"""What stdout and stderr lead to, each by itself."""


class Case(NamedTuple):
    """One command."""

    number: int
    way: str
    hook: str
    stdout: str
    stderr: str

    @property
    def harmless(self) -> bool:
        """The run goes on to its end."""
        return self.way in HARMLESS


class Ended(NamedTuple):
    """What came of it."""

    status: int
    """-N: by signal N."""
    text: str
    """On stdout, if that is a file."""
    said: str
    cycles: int
    """That the controller counted."""
    took_ms: float


def drawn(number: int, seed: int, called: Sequence[str]) -> Case:
    """The case of a number. In turns a replacement of one of the ``called`` functions and a listed way; of
    those all are there once before any is there again, in another order for each seed."""
    random = Random(f"{seed} {number}")
    ways = [*HARMLESS, *ENDING, *TAMPERING]
    Random(f"{seed} {number // (2 * len(ways))}").shuffle(ways)
    way = replacement(random, called) if number % 2 else ways[number // 2 % len(ways)]
    return Case(number, way, random.choice(HOOKS), random.choice(STREAMS), random.choice(STREAMS))


def replacement(random: Random, called: Sequence[str]) -> str:
    """A way that puts something in the place of a function of a module or of a class."""
    return f"put('{random.choice(called)}', {random.choice(REPLACEMENTS)})"


def called_functions(folder: Path) -> list[str]:
    """Those that a command calls which runs to its end, its own and Python's, as MODULE:NAME."""
    calls, names = folder / "calls", set[str]()

    def note(frame: FrameType, event: str, function: Any) -> None:
        if event == "call":
            names.add(f"{frame.f_globals.get('__name__')}:{frame.f_code.co_qualname}")
        elif event == "c_call":
            names.add(f"{function.__module__ or type(function.__self__).__module__}:{function.__qualname__}")

    def write() -> None:
        sys.setprofile(None)
        calls.write_text("\n".join(sorted(filter(_can_be_replaced, names))), encoding="utf-8")

    if not (process := os.fork()):
        atexit.register(write)
        sys.setprofile(note)
        bench = folder / "bench.toml"
        case = Case(0, "pass", "output", "file", "file")
        bench.write_text(bench_of(case, folder / "tally").config.resolved_text(), encoding="utf-8")
        _become(case, bench, folder / "stdout", folder / "stderr")
    status_of(process)
    return calls.read_text(encoding="utf-8").splitlines()


def _can_be_replaced(name: str) -> bool:
    module, _, path = name.partition(":")
    *owners, key = path.split(".")
    owner: object = sys.modules.get(module)
    for each in owners:
        owner = getattr(owner, each, None)
    try:
        setattr(owner, key, vars(owner)[key])
    except (AttributeError, KeyError, TypeError):
        return False
    return True


def run_case(case: Case, folder: Path) -> Ended:
    """Run it in a process of its own; its files go into ``folder``."""
    bench, tally = folder / "bench.toml", folder / "tally"
    out, said = folder / "stdout", folder / "stderr"
    for left in (tally, out, said):
        left.unlink(missing_ok=True)
    bench.write_text(bench_of(case, tally).config.resolved_text(), encoding="utf-8")
    clock = MonotonicClock()
    began = clock.now()
    if not (process := os.fork()):
        _become(case, bench, out, said)
    status = status_of(process)
    text, told = (path.read_text(errors="replace") if path.exists() else "" for path in (out, said))
    cycles = tally.stat().st_size if tally.exists() else 0
    return Ended(status, text, told, cycles, (clock.now() - began) / NS_PER_MS)


def bench_of(case: Case, tally: Path) -> servobench.Bench:
    """Return a bench whose controller does the way of the case, and counts its cycles in ``tally``."""
    hooks = f"{Path(__file__).with_name('misused_hooks.py')}:Hooks"
    parameters = {"where": case.hook, "way": case.way, "tally": str(tally)}
    return servobench.Bench.load(BENCH).changed(
        {
            "bench.duration_s": 0.01 * CYCLES,
            "bus.spec": "simulated",
            "drive.axis1.controller": {"kind": "python", "object": hooks, "parameters": parameters},
            "reference.axis1": [{"at_s": 0.0, "kind": "ramp", "speed_rpm": 0.0, "over_s": 0.2}],
            "load": {},
            "verdict": {"dropouts_percent_max": 100.0},
        }
    )


def _become(case: Case, bench: Path, out: Path, said: Path) -> None:
    """``hil run`` with the streams of the case; leaves by SystemExit, as the command does."""
    streams = ((1, case.stdout, stream_to(case.stdout, out)), (2, case.stderr, stream_to(case.stderr, said)))
    for place, kind, stream in streams:
        os.dup2(stream, place)
        os.close(stream)
        if kind == "closed":
            os.close(place)
    if case.hook == "import":
        os.environ["HOOKS_AT_IMPORT"] = case.way
    sys.argv = ["hil", "run", str(bench), "--no-record", "--json"]
    cli.main()


def stream_to(kind: str, path: Path) -> int:
    if kind == "dead pipe":
        reading, writing = os.pipe()
        os.close(reading)
        return writing
    return os.open(kind if kind.startswith("/") else path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)


def status_of(process: int, limit_s: float = LIMIT_S) -> int:
    """Wait for it and return its exit status; -9 after ``limit_s``."""
    watched = os.pidfd_open(process)
    if not select.select([watched], [], [], limit_s)[0]:
        os.kill(process, signal.SIGKILL)
    os.close(watched)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def findings(case: Case, ended: Ended) -> Iterator[str]:
    """What is not as it has to be."""
    if ended.status not in set(ExitStatus):
        yield f"status {ended.status}"
    if ended.status == ExitStatus.DEFECT:
        yield "a defect of the program"
    spoilt = case.way in ENDING or ended.cycles < CYCLES
    if ended.status == ExitStatus.PASSED and spoilt:
        yield f"passed, and the controller counted {ended.cycles} cycles"
    writable = case.stdout == "file"
    fair = (ExitStatus.PASSED,) if writable or case.stdout == "closed" else (ExitStatus.NOT_RECORDED,)
    if case.harmless and ended.status not in fair:
        yield f"status {ended.status}, and it was to pass"
    if not writable:
        return
    try:
        told = json.loads(ended.text)["verdict"]["exit_status"]
    except (ValueError, KeyError, TypeError) as error:
        yield f"no object on stdout: {error}"
        return
    if told != ended.status:
        yield f"status {ended.status}, the object says {told}"


def main() -> int:
    """Run them, and print what was wrong, and how many there were of each status."""
    parser = argparse.ArgumentParser(prog="python -m tests.exits.misuse", description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e6)
    parser.add_argument("--replacing", action="store_true", help="replacements of called functions alone")
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp())  # no context: a command that is forked in here leaves through it
    # imports and compiles all
    servobench.run(bench_of(Case(0, "pass", "output", "file", "file"), folder / "tally"))
    called = called_functions(folder)
    gc.freeze()  # else the end of each command would look through all of it
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup has it ignored, and & of a script the other one
    signal.signal(signal.SIGINT, signal.default_int_handler)
    clock = MonotonicClock()
    ends_at = clock.now() + asked.seconds * NS_PER_S
    statuses: Counter[int] = Counter()
    broken = 0
    for number in range(asked.runs):
        if clock.now() > ends_at:
            break
        if asked.replacing and not number % 2:
            continue
        case = drawn(number, asked.seed, called)
        ended = run_case(case, folder)
        statuses[ended.status] += 1
        found = list(findings(case, ended))
        broken += bool(found)
        for text in found:
            print(f"{case}: {text}; {ended.took_ms:.0f} ms; {ended.said[-300:]!r}", flush=True)
    shutil.rmtree(folder)
    counts = ", ".join(f"{count} with {status}" for status, count in sorted(statuses.items()))
    print(f"{statuses.total()} commands ended: {counts}; {broken} of them wrongly")
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())

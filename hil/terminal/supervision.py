"""The thin parent of a command: it ends as documented, whatever happens to the command's process.

hil            forks before anything heavy is imported, hands signals on, passes text to the terminal, and
               leaves with the status that the command told it. A status of 0 needs a proof
  the command  loop, drives and the user's code
    logger ... the command's own processes

A command that ends without a result (``os._exit(0)``, a crash, another program in its place) has its drives
stopped, its recording finished and its object printed by :mod:`servobench.hil.terminal.taken_over`.
"""

import errno
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, NoReturn

from servobench.drivers.timebase import NS_PER_S, Duration, Instant, MonotonicClock
from servobench.hil.machine.parent_process import (
    KeptBuffer,
    Pipes,
    StreamEnd,
    Terminals,
    live_under,
    messages,
)
from servobench.hil.machine.refusals import as_refusal
from servobench.hil.machine.stopping import heard_signals
from servobench.hil.terminal.relay import Relay, write_all
from servobench.hil.terminal.taken_over import Ended, concluded, lost, not_begun
from servobench.hil.verdict.verdict import ExitStatus

SUPERVISED: Final = ("run", "campaign", "measure", "commission", "jog", "homing", "brake")
"""Commands that move drives in a loop, or execute the user's code."""
_FROM_KERNEL: Final = 0x80
"""SI_KERNEL of <asm-generic/siginfo.h>: a key of the terminal, which its whole foreground group has heard."""
_GRACE: Final = Duration(2 * NS_PER_S)
"""Time from a command's result to its end: threads left by user code would keep it for ever."""
_DYING: Final = Duration(NS_PER_S // 2)
"""Time from the end of its reports to its own end: writing a core, returning memory."""


_WITH_RESULTS: Final = (ExitStatus.PASSED, ExitStatus.FAILED, ExitStatus.INCOMPLETE)
"""Statuses that describe the results."""


def is_supervised(arguments: Sequence[str]) -> bool:
    """Return True for a command line of :data:`SUPERVISED` that does not ask for help."""
    return len(arguments) > 1 and arguments[0] in SUPERVISED and "--help" not in arguments


def supervised(work: Callable[[], None], arguments: Sequence[str]) -> NoReturn:
    """Run ``work``, which leaves by SystemExit, in a child process, and leave with the status that it
    reports.

    If the machine refuses such a process, the command ends as after a later refusal.
    """
    try:
        child, relay, watched = _begin(work)
    except (OSError, RuntimeError) as error:
        if (refusal := as_refusal(error)) is None:
            raise
        status, text = not_begun(refusal, arguments)
        print(f"hil: error: {refusal}", file=sys.stderr)
        print(text, end="", flush=True)
        os._exit(status)  # a child that has just begun dies with this process
    ended = _watch(child, relay, watched)
    # at once: nothing here has to be cleaned up, and to take the interpreter down takes longer than all else
    os._exit(_leave(relay, ended, arguments))


def _begin(work: Callable[[], None]) -> tuple[int, Relay, set[int]]:
    """Fork; return the child, the relay of its output, and the signals to watch for. Returns only in the
    parent."""
    _open_standard_descriptors()
    pipes = [os.pipe() for _ in Pipes._fields]
    terminals = Terminals(os.isatty(1), os.isatty(2))
    watched: set[int] = {*heard_signals(), signal.SIGQUIT, signal.SIGCHLD}
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, watched)
    parent, child = os.getpid(), os.fork()
    mine = 0 if child else 1
    for ends in pipes:
        os.close(ends[1 - mine])
    own = Pipes(*(ends[mine] for ends in pipes))
    if not child:
        _work(work, own, terminals, parent, before)
    return child, Relay(own, threading.get_ident()), watched


def unsupervised(work: Callable[[], None]) -> NoReturn:
    """Run ``work``, which leaves by SystemExit, in this process, to its end even if nobody reads its output.

    A stdout that does not accept its results turns a status of 0, 1 or 6 into 5.
    """
    _open_standard_descriptors()
    out, messages = StreamEnd(1, os.isatty(1)), StreamEnd(2, os.isatty(2))
    encoding = sys.stdout.encoding if sys.stdout else "utf-8"
    sys.stdout, sys.stderr = (
        io.TextIOWrapper(KeptBuffer(end), encoding, "backslashreplace", line_buffering=end is messages)
        for end in (out, messages)
    )
    status: Any = 0
    try:
        work()
    except SystemExit as leaving:
        status = leaving.code
    sys.stdout.flush()
    if out.trouble is not None and status in (None, *_WITH_RESULTS):
        if out.trouble.errno != errno.EPIPE:  # who reads has enough, as of `| head`
            print(f"hil: error: stdout: {out.trouble.strerror}", file=sys.stderr)
        status = ExitStatus.NOT_RECORDED
    raise SystemExit(status)


def is_read() -> bool:
    """Return True while stdout has accepted everything written: a command with very much output may stop
    otherwise."""
    end = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    return not (isinstance(end, StreamEnd) and end.trouble)


def _open_standard_descriptors() -> None:
    """Open standard descriptors closed by the caller on nothing: else a pipe of ours would get their
    numbers."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)


def _work(
    work: Callable[[], None], pipes: Pipes, terminals: Terminals, parent: int, before: set[int]
) -> NoReturn:
    """Run in the child. It ends as a program does, since user code may have registered exit handlers."""
    if terminals.stdout and "COLUMNS" not in os.environ:
        os.environ["COLUMNS"] = str(os.get_terminal_size(1).columns)
    living = live_under(pipes, terminals, parent)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    status: Any = 0
    try:
        work()
    except SystemExit as leaving:
        status = 0 if leaving.code is None else leaving.code
    except KeyboardInterrupt:
        status = ExitStatus.INTERRUPTED
    except BaseException:  # noqa: BLE001 - top of the process
        status = ExitStatus.DEFECT
        with suppress(Exception):  # code of the user's may have put something in its place
            traceback.print_exc(file=messages())
    living.tell_result(status if isinstance(status, int) else ExitStatus.FAILED)
    raise SystemExit(status)


def _watch(child: int, relay: Relay, watched: set[int]) -> Ended:
    """Watch until the child is gone, or is no longer a program of ours."""
    clock = MonotonicClock()
    limit: Instant | None = None
    killed = False
    while True:
        seen = signal.sigtimedwait(watched, 0.2 if limit is not None else 3600.0)
        if seen is not None and seen.si_signo != signal.SIGCHLD:
            # the leader of a session hears alone that its terminal is gone
            if seen.si_code != _FROM_KERNEL or seen.si_signo == signal.SIGHUP:
                os.kill(child, seen.si_signo)
            os.kill(child, signal.SIGCONT)  # a process that is stopped heeds no signal
            continue
        gone, status = os.waitpid(child, os.WNOHANG)
        if gone:
            returncode = os.waitstatus_to_exitcode(status)
            return Ended(returncode, killed and returncode == -signal.SIGKILL)
        if limit is None and (relay.result is not None or relay.told_ended):
            patience = _GRACE if relay.result is not None else _DYING
            limit = Instant(clock.now() + patience)
        if limit is not None and clock.now() >= limit:
            os.kill(child, signal.SIGKILL)
            killed, limit = True, Instant(clock.now() + _GRACE)


def _leave(relay: Relay, ended: Ended, arguments: Sequence[str]) -> int:
    """Print the results; return the status to leave with."""
    relay.finish()
    if relay.result is None:
        status, text = lost(relay.known, ended, arguments, relay.say)
    else:
        status, text = concluded(relay.known, relay.result, arguments, relay.say)
    relay.settle()
    try:
        write_all(1, text.encode(sys.stdout.encoding if sys.stdout else "utf-8", "backslashreplace"))
    except OSError as error:
        relay.say(f"hil: error: stdout: {error.strerror}")
        if status in _WITH_RESULTS:
            status = ExitStatus.NOT_RECORDED
    relay.drain()
    return status

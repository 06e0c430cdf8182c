"""Errors that are no defect of the program: the machine refuses files, memory or processes, user code raised
outside its calls, or replaced the program's functions."""

import errno
import traceback
from pathlib import Path
from typing import Final

from servobench.drivers.errors import BenchError
from servobench.hil.machine.held_process import OWN_FILES, replaced, told
from servobench.hil.machine.parent_process import tell_parent

_WITH_REMEDY: Final = {
    errno.EMFILE: "raise the limit of ulimit -n",
    errno.ENFILE: "end other programs: the files of the whole machine are used up",
    errno.ENOMEM: "end other programs, or raise the limit of ulimit -v",
}
_MAKING_PROCESSES: Final = ("_execute_child", "_launch", "_begin")
"""Functions of subprocess, multiprocessing and the command's parent, in which EAGAIN means that no further
process is allowed; elsewhere it is a defect."""
_NOT_TOLD: Final = "the process failed, and failed again when reporting the cause"
_MORE_PROCESSES: Final = "raise the limits of ulimit -u and -v"


class MachineRefused(BenchError):
    """The machine refuses the process a resource."""

    exit_status = 6


class OwnCodeRaised(BenchError):
    """A user's signal handler, trace function or the like raised in the midst of the bench, or a function
    that it replaced made the bench fail."""


def explained(error: BaseException) -> BenchError | None:
    """Return ``error`` as the machine's or the user's; None: it is a defect of the program, whose functions
    are unchanged."""
    try:
        known = as_refusal(error) or raised_by_own_code(error) or _as_replaced(error)
    except Exception:
        if OWN_FILES:
            return OwnCodeRaised(f"your own code has run here, and afterwards {_NOT_TOLD}")
        raise
    if known is None:
        tell_parent(intact=True)
    return known


def _as_replaced(error: BaseException) -> OwnCodeRaised | None:
    if not (names := replaced()):
        return None
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(last.filename).name}:{last.lineno} in {last.name}"
    return OwnCodeRaised(f"your own code has replaced {names}; then {place} failed: {told(error)}")


def raised_by_own_code(error: BaseException) -> OwnCodeRaised | None:
    """Return ``error`` if a line of the user's raised it; None: it did not."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if frame.filename in OWN_FILES:
            place = f"{Path(frame.filename).name}:{frame.lineno} in {frame.name}"
            return OwnCodeRaised(f"your own code raised outside of its calls: {place}: {told(error)}")
    return None


def as_refusal(error: BaseException) -> MachineRefused | None:
    """Return the refusal by the machine behind ``error``; None: there is none."""
    seen: BaseException | None = error
    while seen is not None:
        if remedy := _remedy(seen):
            return MachineRefused(f"the machine refuses: {_one_line(seen)}; {remedy}")
        seen = seen.__cause__ or seen.__context__
    return None


def _remedy(error: BaseException) -> str:
    if isinstance(error, OSError) and error.errno in _WITH_REMEDY:
        return _WITH_REMEDY[error.errno]
    if isinstance(error, BlockingIOError) and _last_function(error) in _MAKING_PROCESSES:
        return _MORE_PROCESSES
    if isinstance(error, RuntimeError) and "start new thread" in told(error):
        return _MORE_PROCESSES
    if isinstance(error, MemoryError):
        return _WITH_REMEDY[errno.ENOMEM]
    return ""


def _last_function(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return frames[-1].name if frames else ""


def _one_line(error: BaseException) -> str:
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {words[:200]}" if words else type(error).__name__

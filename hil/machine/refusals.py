"""What the machine refuses a process: files, memory, processes. It is no defect of the program."""

import errno
import traceback
from typing import Final

from drivers.errors import BenchError

_WITH_REMEDY: Final = {
    errno.EMFILE: "raise the limit of ulimit -n",
    errno.ENFILE: "end other programs: the files of the whole machine are used up",
    errno.ENOMEM: "end other programs, or raise the limit of ulimit -v",
}
_MAKING_PROCESSES: Final = ("_execute_child", "_launch", "_begin")
"""Functions of subprocess, multiprocessing and the command's parent, in which EAGAIN says that there may be
no further process; elsewhere it is a defect."""
_MORE_PROCESSES: Final = "raise the limits of ulimit -u and -v"


class MachineRefused(BenchError):
    """The machine does not give the process what it asked for."""

    exit_status = 6


def as_refusal(error: BaseException) -> MachineRefused | None:
    """What ``error``, or what it came of, says of the machine; None: nothing."""
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
    if isinstance(error, RuntimeError) and "start new thread" in str(error):
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

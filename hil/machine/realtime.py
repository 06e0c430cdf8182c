"""Requests of a process to the kernel before it runs a loop in real time.

Each request may be refused (it needs privileges); the refusals are recorded, since they explain the lateness
of the run.
"""

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager

FIFO_PRIORITY = 50
"""Priority of the kernel's interrupt threads: above every ordinary process, and not above the frames it waits
for."""
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
"""<asm-generic/mman.h>. On fault: touched pages stay, and no others are loaded. Without that the loop's
process has 530 MB instead of 230: partly used libraries, and OpenBLAS's work space."""
_PR_SET_TIMERSLACK = 29
"""<linux/prctl.h>"""


@contextmanager
def quiet_garbage_collector() -> Iterator[None]:
    """Prevent collections inside: one takes up to 100 ms, and the loop makes no cyclic garbage."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextmanager
def realtime_process() -> Iterator[tuple[str, ...]]:
    """Set SCHED_FIFO, lock touched memory, exact timers, no garbage collection; yield refusals."""
    libc = ctypes.CDLL(None, use_errno=True)
    refused: list[str] = []
    if libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0) != 0:
        refused.append("timer slack of 1 ns (prctl)")
    locked = libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0
    if not locked:
        refused.append("locked memory (mlockall; raise the limit memlock)")
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except PermissionError:
        refused.append("SCHED_FIFO (raise the limit rtprio)")
    try:
        gc.collect()
        with quiet_garbage_collector():
            yield tuple(refused)
    finally:
        os.sched_setscheduler(0, policy, parameter)
        if locked:
            libc.munlockall()


@contextmanager
def timing_conditions(real_time: bool, privileged: bool = True) -> Iterator[tuple[str, ...]]:
    """Yield the kernel's refusals, if ``privileged``; otherwise, and in simulated time, request nothing.

    Enter it before any drive begins to watch the host's heartbeat: locking a large memory, and a garbage
    collection, take up to a second.
    """
    if real_time and privileged:
        with realtime_process() as refused:
            yield refused
        return
    if real_time:
        gc.collect()
    with quiet_garbage_collector():
        yield ()

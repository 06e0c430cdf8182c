"""A machine that does not give its processes their time: they stand still, one at a time or together.

What a loaded or shared machine does at its worst, drawn from a seed, so that a run beside it meets what it
would else meet by chance. The run's processes are stopped by signal, so none of them can know.
"""

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from random import Random

from servobench.drivers.timebase import NS_PER_MS, Instant, MonotonicClock

TOGETHER = 0.25
"""How often all stand still at once, as they do when the machine itself is kept waiting."""


@dataclass(frozen=True, slots=True)
class Stalls:
    """How often and for how long."""

    seed: int
    every_ms: float = 60.0
    """On average, from the end of one to the begin of the next."""
    longest_ms: float = 15.0
    """Drawn evenly, down to none."""


@contextmanager
def stalling(stalls: Stalls | None, processes: Sequence[int]) -> Iterator[None]:
    """Stop ``processes`` as drawn while the context lasts; None: never."""
    ended = threading.Event()

    def stall(drawn: Stalls) -> None:
        draw, clock = Random(drawn.seed), MonotonicClock()
        while not ended.wait(draw.expovariate(1.0) * drawn.every_ms / 1e3):
            chosen = processes if draw.random() < TOGETHER else [draw.choice(processes)]
            try:
                _signal(chosen, signal.SIGSTOP)
                lasts = round(draw.random() * drawn.longest_ms * NS_PER_MS)
                clock.sleep_until(Instant(clock.now() + lasts))
            finally:
                _signal(chosen, signal.SIGCONT)

    if stalls is None:
        yield
        return
    thread = threading.Thread(target=stall, args=(stalls,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _signal(processes: Sequence[int], number: signal.Signals) -> None:
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process, number)

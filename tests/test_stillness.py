"""The witness of the machine, which decides whether a test in real time may be tried again."""

import os
import signal
from collections.abc import Iterator

import pytest

from drivers.timebase import NS_PER_MS, Instant, MonotonicClock
from tests.stillness import EXCUSED_MS, Witness

STOOD_STILL_MS = 40
PATIENCE_MS = 5_000
CLOCK = MonotonicClock()


@pytest.fixture
def witness() -> Iterator[Witness]:
    made = Witness()
    yield made
    made.stop()


def rest(milliseconds: int) -> None:
    CLOCK.sleep_until(Instant(CLOCK.now() + milliseconds * NS_PER_MS))


def test_a_process_that_waited_is_told_until_the_next_test_begins(witness: Witness) -> None:
    os.kill(witness.process_id, signal.SIGSTOP)
    rest(STOOD_STILL_MS)
    os.kill(witness.process_id, signal.SIGCONT)
    deadline = CLOCK.now() + PATIENCE_MS * NS_PER_MS
    while not witness.late_ms() and CLOCK.now() < deadline:
        rest(1)
    assert witness.late_ms() >= STOOD_STILL_MS - EXCUSED_MS
    witness.begin()
    os.kill(witness.process_id, signal.SIGSTOP)  # it cannot tell anything meanwhile
    assert witness.late_ms() == 0
    os.kill(witness.process_id, signal.SIGCONT)


def test_one_that_has_ended_says_so(witness: Witness) -> None:
    os.kill(witness.process_id, signal.SIGKILL)
    os.waitid(os.P_PID, witness.process_id, os.WEXITED | os.WNOWAIT)
    with pytest.raises(AssertionError, match="nobody watches"):
        witness.late_ms()

"""A process that asks to run first must give that up when it stops sleeping."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.xdist_group("real time")

SCRIPT = """
import os
from servobench.drivers.timebase import MonotonicClock, instant_after
from servobench.virtual_bus.bus.hub_process import ask_for_punctuality
ask_for_punctuality()
clock = MonotonicClock()
deadline = instant_after(clock.now(), 10.0)
while os.sched_getscheduler(0) != os.SCHED_OTHER and clock.now() < deadline:
    pass
print(os.sched_getscheduler(0) == os.SCHED_OTHER)
"""


def test_busy_process_is_put_back_among_the_others() -> None:
    """At once where SCHED_FIFO is refused, and after a tenth of a second of work where it is granted."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    assert done.stdout == "True\n"

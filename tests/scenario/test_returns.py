"""A drive that leaves its commands for a while and comes back makes no overspeed, whoever commands it.

Drawn: what the drive did meanwhile, what was asked of it, and its load. More: ``python -m tests.returns``.
"""

from typing import Final

import pytest

from servobench.hil.testing.bench_runs import BenchRunner
from tests.returns.drawn import AXES, POSITIONS, returned

CASES: Final = [(axis, number) for axis in AXES for number in range(2 if axis in POSITIONS else 1)]


@pytest.mark.parametrize(("axis", "number"), [*CASES, ("csv position", 19), ("ip", 9056)])
def test_a_drive_that_comes_back_makes_no_overspeed(servo_bench: BenchRunner, axis: str, number: int) -> None:
    found = returned(axis, number, servo_bench)
    assert not found.wrong, found

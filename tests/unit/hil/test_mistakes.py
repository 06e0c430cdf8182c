"""A sample of ``python -m tests.mistakes``, which draws a thousand: none is believed with a wrong inertia."""

import random
from pathlib import Path

import pytest

from tests.mistakes.drawn import drawn_mistake
from tests.mistakes.outcome import RightPlate, outcome_of

pytestmark = pytest.mark.long

DRIVES = (1011, 1015)
"""One whose drive tells a wrong rated torque, and one that tells the truth."""
EACH = 1


@pytest.mark.parametrize("seed", DRIVES)
def test_mistakes_at_a_nameplate(seed: int, tmp_path: Path) -> None:
    right = RightPlate(seed, tmp_path)
    draw = random.Random(seed)
    for _ in range(EACH):
        mistake = drawn_mistake(seed, draw)
        result = outcome_of(seed, mistake, draw.random() < 0.5, right, tmp_path)
        assert result.verdict in ("refused", "named", "harmless", "unproven"), (mistake.text, result)
    assert right.refusal == ""

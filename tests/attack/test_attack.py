"""A few loops of the attack: nothing certified is exceeded, and a claim slightly too low would be."""

from collections.abc import Callable, Iterator
from functools import cache

import pytest

from servobench.hil.studies.speed.loss_peaks import peak_of
from tests.attack.__main__ import Attack, Attacked, attacked
from tests.attack.drawn import drawn_loop
from tests.draws import few_of

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def attack() -> Iterator[Attack]:
    own = Attack()
    yield own
    own.close()


@pytest.fixture(scope="module")
def found_of(attack: Attack) -> Callable[[int], Attacked | None]:
    return cache(lambda seed: attacked(seed, attack))


@pytest.mark.parametrize(
    ("seed", "kind"),
    few_of(
        [
            (16, "fused"),
            (8, "hinf"),
            (7, "predictor"),
            (5, "static"),
            (1, "hinf"),
            (11, "predictor"),
            (18, "fused"),
            (24, "fused"),
        ],
        3,
    ),
)
def test_no_attack_exceeds_what_is_certified(
    found_of: Callable[[int], Attacked | None], seed: int, kind: str
) -> None:
    found = found_of(seed)
    assert found is not None
    assert found.kind == kind
    assert not found.violated
    assert found.ratio < 1.06
    assert found.attacked > 0.94 * found.certified


def test_a_false_claim_is_told(found_of: Callable[[int], Attacked | None]) -> None:
    found = found_of(16)
    assert found is not None
    assert found._replace(certified=0.99 * found.attacked).violated


def test_a_claim_for_one_inertia_alone_does_not_bear_a_range(attack: Attack) -> None:
    drawn = drawn_loop(24)
    assert drawn is not None
    assert drawn.inertias[0] < 0.75
    alone = peak_of(drawn.controller, drawn.readings, drawn.commands)
    assert attack.on(drawn.told) > 1.1 * alone.certified

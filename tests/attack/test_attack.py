"""A few loops of the attack: nothing certified is exceeded, and a claim slightly too low would be."""

from collections.abc import Iterator

import pytest

from tests.attack.__main__ import Attack, attacked

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def attack() -> Iterator[Attack]:
    own = Attack()
    yield own
    own.close()


@pytest.mark.parametrize(
    ("seed", "kind"), [(1, "hinf"), (5, "static"), (7, "predictor"), (11, "predictor"), (16, "fused")]
)
def test_no_attack_exceeds_what_is_certified(attack: Attack, seed: int, kind: str) -> None:
    found = attacked(seed, attack)
    assert found is not None
    assert found.kind == kind
    assert not found.violated
    assert found.ratio < 1.06
    assert found.attacked > 0.94 * found.certified


def test_a_false_claim_is_told(attack: Attack) -> None:
    found = attacked(16, attack)
    assert found is not None
    assert found._replace(certified=0.99 * found.attacked).violated

"""Objects told for the recording alone: in which PDOs, and what a drive that cannot is said to lack."""

import random

import pytest

from servobench.drivers.canopen.pdo import PdoDirection, PdoEntry, PdoMap, PdoPlan
from servobench.drivers.cia402.drive_setup import NUMBERS, Observed, with_observed

SIZES = {"b": 8, "h": 16, "i": 32, "q": 64}


def plan_of(*numbers: int) -> PdoPlan:
    """The loop's own TPDOs of these numbers."""
    word = (PdoEntry(0x6041, 0, "H"),)
    sent = PdoDirection.TRANSMIT
    return PdoPlan(tuple(PdoMap(sent, n, sent.default_cob_id(n, 5), word) for n in numbers), ())


def entries_of(codes: str) -> tuple[PdoEntry, ...]:
    return tuple(PdoEntry(0x2100, sub, code) for sub, code in enumerate(codes, 1))


def test_they_are_packed_in_their_order_into_what_the_loop_leaves() -> None:
    draw = random.Random(3)
    for _ in range(300):
        used = draw.sample(list(NUMBERS), draw.randint(0, 4))
        codes = "".join(draw.choice("bhiq") for _ in range(draw.randint(1, 14)))
        entries, every = entries_of(codes), draw.randint(1, 20)
        needed, bits = 1, 0
        for code in codes:
            if bits + SIZES[code] > 64:
                needed, bits = needed + 1, 0
            bits += SIZES[code]
        plan = with_observed(plan_of(*used), 5, Observed(entries, every))
        if needed > 4 - len(used):
            assert plan is None
            continue
        assert plan is not None
        assert plan.tpdos == plan_of(*used).tpdos
        assert len(plan.observed) == needed
        assert tuple(entry for pdo in plan.observed for entry in pdo.entries) == entries
        numbers = [pdo.number for pdo in plan.observed]
        assert numbers == sorted(set(NUMBERS) - set(used))[:needed]
        for pdo in plan.observed:
            assert pdo.bits <= 64
            assert pdo.cob_id == (0x180, 0x280, 0x380, 0x480)[pdo.number - 1] + 5
            assert pdo.transmission_type == every


@pytest.mark.parametrize("codes", ["q", "iiii", "bbbbbbbb", "hhhhb"])
def test_a_full_pdo_is_full_to_the_last_bit(codes: str) -> None:
    plan = with_observed(plan_of(1, 2, 3), 5, Observed(entries_of(codes)))
    assert (plan is not None) == (sum(SIZES[code] for code in codes) <= 64)

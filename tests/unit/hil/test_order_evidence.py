"""Which SYNCs readings follow, as what is uneven in both tells."""

import pytest

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.order_evidence import OrderEvidence
from servobench.hil.loop.syncs import SyncLog
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TRANSIT

READINGS = 16
SOON, AGE = TRANSIT // 2, PERIOD + 3 * TRANSIT


@pytest.mark.parametrize(("too_soon", "lag"), [(2, None), (4, None), (8, None), (10, 0)])
def test_a_lag_for_which_half_come_too_soon_is_possible_yet(too_soon: int, lag: int | None) -> None:
    """SYNCs at equal distances tell nothing: readings answer the SYNC before or that before it, until more
    than half of them would have come sooner than their frame can."""
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    evidence = OrderEvidence(log, TRANSIT)
    evidence.begin(AGE)
    for number in range(1, READINGS + 3):
        log.heard(number, Instant(number * PERIOD))
    for number in range(1, READINGS + 1):
        delay = PERIOD + SOON if number <= too_soon else AGE
        assert evidence.add(Instant(number * PERIOD + delay)) == number
    assert evidence.verdict(-1, 1, deviation_ns=PERIOD // 8, untidy=False) == lag


def test_the_first_of_two_readings_that_came_too_soon_says_nothing() -> None:
    """It was held up until just before that SYNC; of others the second one is a copy."""
    log, held = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS), 8
    evidence = OrderEvidence(log, TRANSIT)
    evidence.begin(2 * TRANSIT)
    for number in range(1, READINGS + 1):
        log.heard(number, Instant(number * PERIOD))
        if number == held + 1:
            assert evidence.add(Instant(number * PERIOD - TRANSIT)) == number
        came = evidence.add(Instant(number * PERIOD + 2 * TRANSIT))
        assert came == (0 if number == held + 1 else number)
        if number == 2:  # a copy of it
            assert evidence.add(Instant(number * PERIOD + 3 * TRANSIT)) == 0
    assert set(evidence.delays(0)) == {2 * TRANSIT}
    assert len(evidence) == READINGS - 1

"""Bounds of samples without a stamp where an adapter stamps frames any time after their end."""

from random import Random

import pytest

from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.beats import Beats
from servobench.hil.loop.order_attribution import OrderAttribution
from servobench.hil.loop.syncs import SyncLog
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TRANSIT, reading_at

SPACING = Duration(2 * PERIOD)
LATE_MOST = SPACING * 3 // 8
SYNCS = 1500


@pytest.mark.parametrize("seed", [0, 1, 19, 35])
def test_the_bound_holds_an_echo_that_is_later_than_any_before(seed: int) -> None:
    """A frame is stamped no sooner than those before it, so a reading behind a late echo has that one's
    stamp: the least delay is nothing, however late echoes are, and only long delays tell."""
    draw = Random(seed)
    log = SyncLog(SYNC_LATENCY, SPACING, EchoBasis.KERNEL)
    order = OrderAttribution(log, SPACING, TRANSIT, lambda _: None, Beats(SPACING, Duration(0)))
    outside = certain = stamped_at = 0
    for number in range(1, SYNCS):
        ended = number * SPACING
        echo = stamped_at = max(stamped_at, ended + draw.randrange(LATE_MOST))
        received = stamped_at = max(stamped_at, ended + TRANSIT + draw.randrange(LATE_MOST))
        log.heard(number, Instant(echo))
        reading = reading_at(Instant(received), velocity_rad_s=float(number))
        if number < 30:
            order.learn(reading, log.marks[-1])
        elif (sample := order.place(reading)) is not None and sample.certain:
            certain += 1
            outside += abs(sample.sampled_at - ended) > sample.sampled_at_error_ns
    assert certain > SYNCS // 2
    assert outside == 0

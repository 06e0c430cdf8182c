"""Delay compensation: the state from which a command is computed.

sampled      x0        x1        x2        x3
received        x0        x1        --        x3
arrival      use the newest sample as soon as it is there; its age varies
stamp        use the sample that is exactly the agreed delay old when the command acts
"""

from collections import deque

from servobench.drivers.timebase import Duration
from servobench.hil.loop.protocol import Compensator, Context
from servobench.hil.loop.samples import AT_REST, Sample, StateEstimate


def _as_estimate(sample: Sample) -> StateEstimate:
    reading = sample.reading
    return StateEstimate(
        reading.position_rad, reading.velocity_rad_s, reading.torque_nm, sample.sampled_at, sample.sequence
    )


class Arrival(Compensator):
    """Uses the newest sample at once; through a dropout the last one is held."""

    def __init__(self) -> None:
        self._held = AT_REST

    def receive(self, sample: Sample) -> None:
        if sample.sequence > self._held.sequence:
            self._held = _as_estimate(sample)

    def estimate(self, context: Context) -> StateEstimate:  # noqa: ARG002
        return self._held


class Stamp(Compensator):
    """Postponed actuation by time stamps, [Ling2012] 2.3.

    A sample taken at t acts at t + delay, whatever it took to arrive, if it took
    less; then the loop sees one constant delay. As the input is held between
    cycles, its age runs from ``delay`` to ``delay`` plus one period, and grows by
    a period for each sample missing at its time.

    Drives sample at SYNCs, and act at SYNCs (``actuation = "on_sync"``); so ``delay`` is a whole number of
    periods, and is rounded to one: a sample of a SYNC that came late is no other sample. Its age is ``delay``
    but for the lateness of the two SYNCs on the bus, and for what a drive takes from a SYNC to acting, which
    is not measured.
    """

    def __init__(self, delay: Duration, period: Duration) -> None:
        self._youngest = Duration(delay - period // 2)
        self._waiting: deque[StateEstimate] = deque()
        self._held = AT_REST

    def receive(self, sample: Sample) -> None:
        estimate = _as_estimate(sample)
        waiting = self._waiting
        if waiting and estimate.valid_at < waiting[-1].valid_at:
            waiting.append(estimate)
            self._waiting = deque(sorted(waiting, key=lambda waiting_estimate: waiting_estimate.valid_at))
        else:
            waiting.append(estimate)

    def estimate(self, context: Context) -> StateEstimate:
        ripe_at = context.acts_at - self._youngest
        waiting = self._waiting
        while waiting and waiting[0].valid_at <= ripe_at:
            ripe = waiting.popleft()
            if ripe.sequence > self._held.sequence:
                self._held = ripe
        return self._held

"""The predictor that knows count and speed of each sample, 6064h and 606Ch of one SYNC, by constant gains."""

from collections.abc import Sequence
from typing import Final

from servobench.design.speed.predictor_plant import PredictorPlant
from servobench.drivers.timebase import Duration
from servobench.hil.control.motion import ShaftMotion
from servobench.hil.control.predictor import PER_NS, Predicting
from servobench.hil.loop.samples import Sample

STRAYS: Final = 6.0
"""A count so many standard deviations beyond what the speed explains is of another instant."""
_STEADILY: Final = 0.5
"""How far a speed that has changed steadily has moved a count, of the change times the time."""
_REGULAR: Final = 32
"""A SYNC that is off its place by less than such a part of a tick is on it."""


class FusedPredictor(Predicting):
    """``gains``: of the sample after 0, 1 .. lost ones: (speed, filtered speed, angle, load) each for the
    count and for the filtered speed; ``speed_gains``: of a sample without a count that is of use; ``tick``:
    at which the drive samples its encoder, 0: not known.

    A drive tells the count of its last tick. Where SYNCs come at equal distances, which a period of whole
    ticks keeps, the tick is always as long before. A SYNC that comes later within a period finds the same
    tick, or the next: that which count and speed speak for.

    A load moves a count from where it was expected by no more than the speed has changed, times the time
    since the last sample. What lies further off, by :data:`STRAYS` times ``spread_rad``, is of another
    instant: the ticks have drifted past a SYNC, or it was placed at another SYNC than its own. The angle then
    begins anew at that count, and the state is corrected by the speed alone.
    """

    def __init__(
        self,
        plant: PredictorPlant,
        gains: Sequence[Sequence[Sequence[float]]],
        speed_gains: Sequence[float],
        spread_rad: float,
        tick: Duration,
        dead_time: Duration,
        period: Duration,
    ) -> None:
        self._of_count = [[rows[0] for rows in each] for each in gains]
        self._of_speed = [[rows[1] for rows in each] for each in gains]
        self._alone = list(speed_gains)
        self._strays_rad = STRAYS * spread_rad
        self._tick = tick
        super().__init__(plant, dead_time, period)

    def _begin(self) -> None:
        super()._begin()
        self._ticked_at = 0
        """On the grid of ticks, as long behind one as the SYNCs are that come at equal distances."""
        self._before = 0
        """Instant of the sample before."""

    def _correct(self, motion: ShaftMotion, sample: Sample, periods: int) -> None:
        innovation, counted_rad = self.innovation_rad_s, sample.reading.counted_rad
        told_rad = innovation * (self._period * PER_NS) * periods
        beyond = self._beyond(motion, counted_rad, sample.sampled_at, _STEADILY * told_rad)
        explained = abs(told_rad) + self._strays_rad * periods
        if abs(beyond) <= explained:
            after = min(periods, len(self._of_count)) - 1
            of_count, of_speed = self._of_count[after], self._of_speed[after]
            motion.speed_rad_s += of_count[0] * beyond + of_speed[0] * innovation
            motion.filtered_rad_s += of_count[1] * beyond + of_speed[1] * innovation
            motion.angle_rad += of_count[2] * beyond + of_speed[2] * innovation
            self.load_nm += of_count[3] * beyond + of_speed[3] * innovation
            return
        speed, filtered, load = self._alone
        motion.speed_rad_s += speed * innovation
        motion.filtered_rad_s += filtered * innovation
        motion.angle_rad, self._ticked_at = counted_rad, sample.sampled_at
        self.load_nm += load * innovation

    def _beyond(self, motion: ShaftMotion, counted_rad: float, at: int, told_rad: float) -> float:
        """Return how far the count of a sample is beyond the expected one; NaN without a count.

        ``told_rad``: how far by what the speed tells, so that a load's step is not taken for a tick.
        """
        tick, beyond = self._tick, counted_rad - motion.angle_rad
        if tick == 0:
            return beyond
        off, apart, near = (at - self._ticked_at) % tick, (at - self._before) % tick, tick // _REGULAR
        self._before = at
        if min(off, tick - off) < near or min(apart, tick - apart) < near:
            self._ticked_at = at
            return beyond
        same = beyond + motion.speed_rad_s * (off * PER_NS)
        following = beyond - motion.speed_rad_s * ((tick - off) * PER_NS)
        if abs(same - told_rad) <= abs(following - told_rad):
            self._ticked_at = at - off
            return same
        self._ticked_at = at + tick - off
        return following

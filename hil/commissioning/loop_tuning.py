"""What is known of a drive's speed loop, from one measurement on the other: its behaviour with any gains."""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from servobench.design.hinf.margins import Response
from servobench.design.speed.drive_loop import DrivePi, LoopBehaviour, closed_by, figures_of
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.timebase import NS_PER_S
from servobench.drivers.vendors.gain_objects import LoopGains
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.loop_excitation import excite
from servobench.hil.commissioning.loop_response import Excited, Gains, NotFound, loop_plant
from servobench.hil.commissioning.session import Session

RANGE_HZ: Final = (0.05, 5000.0)
_MISFIT_MAX: Final = 0.15
"""Rigid shafts with coarse encoders are within 0.06, those behind couplings off by 0.3 and more."""
_UNCERTAIN_DEG: Final = 5.0
"""Phase margin by which a figure may be off, k = 2."""
_UNCERTAIN: Final = 0.07
"""The same of the bandwidth, as a share: with what is left of a demand it is within a tenth."""
_NOISE_SHARE: Final = 0.2
"""Share of the torque limit: more noise than this rms reaches the limit again and again, and the loop is no
linear one."""
_SHARE_SEEN: Final = 0.2
"""With more uncertainty than this (k = 2) a response does not show what the gains do."""
_SHARE_OFF: Final = 0.15
"""What gains do may differ so much from what they should: more is another unit, or a limit in the drive."""


class LoopTuning:
    """What is known of a loop, from one measurement on the other."""

    plant: Response
    known_to_hz: float
    told: str
    lag_error_s: float
    """Of the delay and lag in :attr:`plant`, k = 2."""

    def __init__(
        self,
        session: Session,
        outcome: StepOutcome,
        loop: LoopGains,
        factor: float,
        held: Mapping[str, float],
    ) -> None:
        """``factor``: N m of one unit of the loop's output; ``held``: its gains, raw.

        Measures. Raises StepFailed as :meth:`look`.
        """
        self.session, self.outcome, self.loop = session, outcome, loop
        self._factor = factor
        self._excited: list[Excited] = []
        self.look(held)

    def look(self, held: Mapping[str, float]) -> None:
        """Measure the loop with the gains that it holds. Raises StepFailed where no rigid shaft answers."""
        session, way = self.session, (-1.0) ** len(self._excited)
        gains = Gains(*(self._factor * value for value in self.loop.parallel(held).values()))
        mechanics = session.mechanics
        try:
            self._excited.append(excite(session, gains, way))
            found = session.meanwhile(
                loop_plant,
                self._excited,
                mechanics.inertia_kg_m2,
                max(0.0, mechanics.viscous_friction_nm_s),
                session.found.period / NS_PER_S,
            )
        except NotFound as error:
            why = self._noise(gains) or "give more speed (--rpm) or torque (--torque-max-percent)"
            raise StepFailed("the response of the loop is lost in noise", str(error), why) from error
        if found.misfit > _MISFIT_MAX:
            raise StepFailed(
                f"the loop does not answer as one around a rigid shaft: {100 * found.misfit:.0f} % off",
                f"most at {found.worst_hz:.0f} Hz",
                self._noise(gains) or self._cause(),
            )
        if found.share_error < _SHARE_SEEN and abs(found.share - 1.0) > _SHARE_OFF + 2.0 * found.share_error:
            raise StepFailed(
                f"the gains act as {found.share:.2f} times what was written: they are taken back",
                f"+- {found.share_error:.2f} (k = 2)",
                "is there a limit or a filter in the drive, or another unit than its maker's file says?",
            )
        self.plant, self.lag_error_s = found.response(), found.lag_error_s
        self.known_to_hz = float(self._excited[0].made.frequency_hz[-1])
        self.told = (
            f"inside the loop are {found.lag_in_all_s * 1e6:.0f} us of delay and lag, "
            f"+- {found.lag_error_s * 1e6:.0f} (k = 2); its response differs by "
            f"{100 * found.misfit:.2g} % from that of a rigid shaft"
        )
        self.outcome.figures |= {
            "lag_us": found.lag_in_all_s * 1e6,
            "lag_error_us": found.lag_error_s * 1e6,
            "misfit": found.misfit,
        }

    def _noise(self, gains: Gains) -> str:
        """Return what is wrong with a speed whose noise takes all the torque; empty: it does not."""
        session = self.session
        noise_nm = gains.proportional * (session.found.speed_noise_rad_s or 0.0)
        share = noise_nm / session.limits.torque_nm
        if share < _NOISE_SHARE:
            return ""
        return (
            f"P makes {noise_nm:.3g} N m rms of the speed's noise, {100 * share:.0f} % of the torque limit: "
            "take a lower P or a speed filter first"
        )

    def _cause(self) -> str:
        """Return what else than noise may be behind a response that is not a rigid shaft's."""
        if self.session.port.mode is Mode.PROFILE_VELOCITY:
            return "in profile velocity the drive plans its own way to each set-point; in csv it does not"
        return "is there a coupling between motor and load? Tune it with the maker's tool"

    def uncertain(self, held: Mapping[str, float]) -> str:
        """Return why the figures with raw gains do not hold well enough; empty: they do."""
        figures = self.figures(held)
        lag_s = self.lag_error_s
        off_deg = 360.0 * figures.crossover_hz * lag_s
        others = [self._behaviour(held, late_s).bandwidth_hz for late_s in (-lag_s, lag_s)]
        off = max(abs(other / figures.bandwidth_hz - 1.0) for other in others)
        if not (off_deg > _UNCERTAIN_DEG or off > _UNCERTAIN):
            return ""
        return (
            f"the lag inside the loop is uncertain by {lag_s * 1e6:.0f} us (k = 2), which is "
            f"{off_deg:.0f} degrees of phase margin and {100 * off:.0f} % of the bandwidth"
        )

    def figures(self, held: Mapping[str, float]) -> LoopBehaviour:
        """Return the loop's behaviour with raw gains."""
        return self._behaviour(held, 0.0)

    def _behaviour(self, held: Mapping[str, float], late_s: float) -> LoopBehaviour:
        gains = self.loop.parallel(held)
        low, high = (math.tau * each for each in RANGE_HZ)
        closed = closed_by(
            lambda omega: self.plant(omega) * np.exp(-1j * omega * late_s),
            self._factor * gains["p"],
            self._factor * gains["i"],
        )
        return figures_of(closed, low, high)

    def raw(self, made: DrivePi) -> dict[str, float]:
        """Return gains as the objects hold them."""
        return self.loop.raw({"p": made.proportional / self._factor, "i": made.integral / self._factor})

    def tell(self, when: str, figures: LoopBehaviour) -> None:
        """Say what the loop does."""
        margins = figures.margins
        self.outcome.say(
            f"{when}: bandwidth {figures.bandwidth_hz:.3g} Hz, phase margin {margins.phase_margin_deg:.3g} "
            f"degrees, gain margin {margins.gain_margin_db:.3g} dB"
        )
        self.outcome.figures[when] = {
            "bandwidth_hz": figures.bandwidth_hz,
            "crossover_hz": figures.crossover_hz,
            "phase_margin_deg": margins.phase_margin_deg,
            "gain_margin_db": margins.gain_margin_db,
        }

"""The covariance of a predictor's Kalman filter: speed, filtered speed and load torque, in scalars.

    x = [omega, w, T_L]     y = w + noise     T_L: a random walk

The torque is known from the commands and has no variance of its own.

A second filter runs beside it, whose load walks faster. An innovation beyond what the first one explains is
taken for a step of the load: the first goes on from the covariance of the second, whose gains follow a step
at once, and calms down by itself. So the torque is quiet where nothing happens.

The shaft as a predictor sees it: torque, speed and the drive's filtered speed, in closed form.

    T' = a (u - T)     J omega' = T - B omega - T_L     w' = f (omega - w)     angle' = omega

u: the command in force; T_L: the load torque, both constant over a piece; w: what 606Ch tells.
"""

import math
from dataclasses import dataclass
from typing import Final

from servobench.design.speed.predictor_plant import PredictorPlant

_APART: Final = 1e-3
"""Part of its rate by which the speed's filter is moved away from the current loop's, where they are equal:
the closed form divides by their difference."""
_COASTS: Final = 1e-6
"""1/s. A shaft that coasts longer has practically no friction."""


class ShaftMotion:
    """State at one instant; it knows no clock, pieces come with their length."""

    __slots__ = (
        "_coasted",
        "_coasting_rate",
        "_current_left",
        "_current_rate",
        "_driven_s",
        "_filter_left",
        "_filter_rate",
        "_lag",
        "_length_s",
        "_per_inertia",
        "_resonance",
        "angle_rad",
        "filtered_rad_s",
        "speed_rad_s",
        "torque_nm",
    )

    def __init__(self, plant: PredictorPlant) -> None:
        self.torque_nm = 0.0
        self.speed_rad_s = 0.0
        self.filtered_rad_s = 0.0
        self.angle_rad = 0.0
        self._per_inertia = 1.0 / plant.inertia_kg_m2
        self._coasting_rate = plant.viscous_friction_nm_s * self._per_inertia
        self._current_rate = plant.current_rate_rad_s
        rate = plant.filter_rate_rad_s
        if abs(rate - self._current_rate) < _APART * self._current_rate:
            rate = (1.0 + _APART) * self._current_rate
        self._filter_rate = rate
        self._resonance = rate / (rate - self._current_rate)
        self._lag = self._per_inertia / (self._current_rate - self._coasting_rate)
        """Speed that a missing N m costs until the current loop has made it, rad/s."""
        self._length_s = 0.0
        self._coasted = 1.0
        self._driven_s = 0.0
        self._current_left = 1.0
        self._filter_left = 1.0

    def copy(self, other: "ShaftMotion") -> None:
        """Take the state of ``other``."""
        self.torque_nm = other.torque_nm
        self.speed_rad_s = other.speed_rad_s
        self.filtered_rad_s = other.filtered_rad_s
        self.angle_rad = other.angle_rad

    def advance(self, command_nm: float, load_nm: float, length_s: float) -> None:
        """Advance by ``length_s`` under a constant command and load, N m.

        Torque and speed are exact; filter and angle take the speed's drift for a straight line within the
        piece.
        """
        if length_s <= 0.0:
            return
        if length_s != self._length_s:
            self._length_s = length_s
            self._current_left = math.exp(-self._current_rate * length_s)
            self._filter_left = math.exp(-self._filter_rate * length_s)
            self._coasted = math.exp(-self._coasting_rate * length_s)
            rate = self._coasting_rate
            self._driven_s = (1.0 - self._coasted) / rate if rate > _COASTS else length_s
        left, filter_left, coasted = self._current_left, self._filter_left, self._coasted
        speed, missing = self.speed_rad_s, command_nm - self.torque_nm
        lag = missing * self._lag
        drifted = speed * coasted + (command_nm - load_nm) * self._per_inertia * self._driven_s
        drifted += lag * (1.0 - coasted)
        behind = (drifted - speed) / (self._filter_rate * length_s)
        turned = lag * self._resonance
        self.torque_nm = command_nm - missing * left
        self.angle_rad += 0.5 * (speed + drifted) * length_s - lag * (
            length_s - (1.0 - left) / self._current_rate
        )
        self.speed_rad_s = drifted - lag * (1.0 - left)
        self.filtered_rad_s = (
            drifted
            - behind
            - lag
            + turned * left
            + filter_left * (self.filtered_rad_s - speed + behind + lag - turned)
        )


STEP_SIGMAS: Final = 1.5
"""An innovation so many times its standard deviation is taken for a step of the load. By chance one in seven
is, which the design reckons with; at 3 a step that comes late in a period is often seen a period later."""
_PANELS: Final = 64
"""Panels of Simpson's rule over a period; its error is far below a double's resolution of a covariance."""
_SETTLING_STEPS: Final = 5000
"""Updates after which the covariance has settled; a load that walks slowly takes as many periods."""


@dataclass(frozen=True, slots=True)
class FilterNoise:
    """Noise data of the filter."""

    speed_rad_s: float
    """Rms of the noise on each reading of the speed."""
    torque_nm: float
    """Rms difference between a period's torque and its command."""
    load_nm_sqrt_s: float
    """The load's random walk: rms of its change over a second."""
    load_max_nm_sqrt_s: float
    """The same after an innovation that indicates a step."""


class Covariance:
    """P of [omega, w, T_L] under one intensity of the load's walk: its upper triangle."""

    __slots__ = (
        "_noise",
        "_q_ff",
        "_q_fl",
        "_q_ll",
        "_q_sf",
        "_q_sl",
        "_q_ss",
        "_t_ff",
        "_t_fl",
        "_t_fs",
        "_t_sl",
        "_t_ss",
        "ff",
        "filtered_gain",
        "fl",
        "ll",
        "load_gain",
        "sf",
        "sl",
        "speed_gain",
        "ss",
    )

    def __init__(self, plant: PredictorPlant, noise: FilterNoise, walk: float, period_s: float) -> None:
        """``walk``: of the load, N m per root of s."""
        self.ss = self.sf = self.sl = self.ff = self.fl = self.ll = 0.0
        self.speed_gain = self.filtered_gain = self.load_gain = 0.0
        """rad/s, rad/s and N m per rad/s of innovation."""
        self._noise = noise.speed_rad_s * noise.speed_rad_s
        self._transition(plant, period_s)
        self._process(plant, noise.torque_nm, walk, period_s)
        for _ in range(_SETTLING_STEPS):
            self.predict()
            self.correct()

    def _transition(self, plant: PredictorPlant, period_s: float) -> None:
        """Compute the effect of each state on the others within a period."""
        speed, filtered = ShaftMotion(plant), ShaftMotion(plant)
        speed.speed_rad_s = 1.0
        filtered.filtered_rad_s = 1.0
        speed.advance(0.0, 0.0, period_s)
        filtered.advance(0.0, 0.0, period_s)
        load = _loaded(plant, period_s)
        self._t_ss, self._t_fs = speed.speed_rad_s, speed.filtered_rad_s
        self._t_ff = filtered.filtered_rad_s
        self._t_sl, self._t_fl = load.speed_rad_s, load.filtered_rad_s

    def _process(self, plant: PredictorPlant, torque_nm: float, walk: float, period_s: float) -> None:
        """Compute the variance added by the walk within a period, by Simpson's rule, and by the torque's
        noise."""
        ss = sf = sl = ff = fl = ll = 0.0
        for k in range(_PANELS + 1):
            weight = 1.0 if k in (0, _PANELS) else 4.0 if k % 2 else 2.0
            loaded = _loaded(plant, period_s * k / _PANELS)
            speed, filtered = loaded.speed_rad_s, loaded.filtered_rad_s
            ss += weight * speed * speed
            sf += weight * speed * filtered
            sl += weight * speed
            ff += weight * filtered * filtered
            fl += weight * filtered
            ll += weight
        share = walk * walk * period_s / (3.0 * _PANELS)
        loaded = _loaded(plant, period_s)
        speed, filtered = torque_nm * loaded.speed_rad_s, torque_nm * loaded.filtered_rad_s
        self._q_ss = share * ss + speed * speed
        self._q_sf = share * sf + speed * filtered
        self._q_ff = share * ff + filtered * filtered
        self._q_sl, self._q_fl, self._q_ll = share * sl, share * fl, share * ll

    @property
    def spread(self) -> float:
        """Variance of the innovation, before it arrives."""
        return self.ff + self._noise

    def copy(self, other: "Covariance") -> None:
        """Take the covariance of ``other``."""
        self.ss, self.sf, self.sl = other.ss, other.sf, other.sl
        self.ff, self.fl, self.ll = other.ff, other.fl, other.ll

    def predict(self) -> None:
        """Advance by a period."""
        t_ss, t_fs, t_ff, t_sl, t_fl = self._t_ss, self._t_fs, self._t_ff, self._t_sl, self._t_fl
        ss, sf, sl, ff, fl, ll = self.ss, self.sf, self.sl, self.ff, self.fl, self.ll
        # rows of Phi P: speed and filtered speed against each state; the load stays
        s_s = t_ss * ss + t_sl * sl
        s_f = t_ss * sf + t_sl * fl
        s_l = t_ss * sl + t_sl * ll
        f_s = t_fs * ss + t_ff * sf + t_fl * sl
        f_f = t_fs * sf + t_ff * ff + t_fl * fl
        f_l = t_fs * sl + t_ff * fl + t_fl * ll
        self.ss = s_s * t_ss + s_l * t_sl + self._q_ss
        self.sf = s_s * t_fs + s_f * t_ff + s_l * t_fl + self._q_sf
        self.ff = f_s * t_fs + f_f * t_ff + f_l * t_fl + self._q_ff
        self.sl = s_l + self._q_sl
        self.fl = f_l + self._q_fl
        self.ll = ll + self._q_ll

    def correct(self) -> None:
        """Correct by a reading; set its gains."""
        sf, ff, fl = self.sf, self.ff, self.fl
        per_spread = 1.0 / (ff + self._noise)
        self.speed_gain = speed_gain = sf * per_spread
        self.filtered_gain = filtered_gain = ff * per_spread
        self.load_gain = load_gain = fl * per_spread
        self.ss -= speed_gain * sf
        self.sl -= speed_gain * fl
        self.sf -= speed_gain * ff
        self.ll -= load_gain * fl
        self.fl -= load_gain * ff
        self.ff -= filtered_gain * ff


class LoadFilter:
    """The gains of each correction; they depend on the readings that are lost, and on steps of the load."""

    __slots__ = ("_bold", "_threshold", "quiet")

    def __init__(self, plant: PredictorPlant, noise: FilterNoise, period_s: float) -> None:
        self.quiet = Covariance(plant, noise, noise.load_nm_sqrt_s, period_s)
        """Whose gains are used."""
        self._bold = Covariance(plant, noise, noise.load_max_nm_sqrt_s, period_s)
        self._threshold = STEP_SIGMAS * STEP_SIGMAS

    def predict(self, periods: int) -> None:
        """Advance by whole periods; all but the last without a reading."""
        for _ in range(periods):
            self.quiet.predict()
            self._bold.predict()

    def correct(self, innovation: float) -> None:
        """Take a reading with this innovation, rad/s."""
        quiet, bold = self.quiet, self._bold
        if innovation * innovation > self._threshold * quiet.spread:
            quiet.copy(bold)
        quiet.correct()
        bold.correct()


def _loaded(plant: PredictorPlant, length_s: float) -> ShaftMotion:
    """Return the motion of a shaft at rest under 1 N m of load within ``length_s``, without
    counter-torque."""
    motion = ShaftMotion(plant)
    motion.advance(0.0, 1.0, length_s)
    return motion

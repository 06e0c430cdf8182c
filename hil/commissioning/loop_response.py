"""What a drive's own speed loop controls, found from the speeds that it is given, tells and makes.

    told    V/R = e^(-s Ts) H(s) (C + K s) G/(1 + C G)        C = P + I/s + D s, the drive's gains
    made    W/R = e^(-s Tw) H(s) (C + K s) G/F/(1 + C G)      by the positions, which no filter delays
    G     = F(s) e^(-s Td)/((1 + Tl s)(J s + B))              from the loop's output to the speed it compares
    F     = 1/(1 + Tf s), or 1/(1 + Tf s/2)^2                 from the shaft's speed to that one
    H     = sinc or sinc^2, behind 1/(1 + Tr s)               from the samples of the set-point to the loop

Ts and Tw, from the host to the loop and back, K, a feed-forward of the acceleration, and Tr, a filter of the
set-point, are found and forgotten: what is kept is G, with all delay and lag inside the loop: of the current
loop, of the computing, of the speed's filter. With K = J neither V nor W tells J: it is that of the ramps. F
is a filter or an observer; a drive holds its set-point until the next one, or goes there in a straight line;
what fits better. Responses with different gains are fitted together.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import scipy.optimize

from servobench.design.hinf.margins import Response
from servobench.design.speed.drive_loop import shaft_plant
from servobench.hil.commissioning.excitation import ComplexArray, FrequencyResponse
from servobench.hil.commissioning.identify import Array

BLOCKS: Final = 8
"""Periods of the sines over which a response is the mean."""

_FEED_MAX: Final = 2.0
"""Of the inertia."""
_LAG_MAX_S: Final = 0.05
_TRANSPORT_PERIODS: Final = 8.0
_STARTS_S: Final = (0.0005, 0.004)
"""Lags with which the search begins."""
_FEED: Final = 0.5
"""Feed-forward with which it does, of the inertia."""
_SHARE_MAX: Final = 10.0
"""Factor by which gains may act as others."""
_STEPS_MAX: Final = 60
"""The fits that matter need some twenty."""
_COHERENT: Final = 0.8
"""A line below this is left out: over so few blocks its noise is not known."""
_MODEL: Final = 0.003
"""Relative error of the model itself, beside a line's noise."""
_SMOOTHED: Final = 0.04
"""Misfit from which on Tr is looked for: beside no filter it makes the lag less certain."""
_CLEARER: Final = 0.5
"""With a true Tr the misfit all but vanishes; noise leaves it as it is."""
_PINNED_S: Final = 1e-9
"""A Tr of none, which has to lie within bounds."""
_OUTLYING: Final = 3.0
"""Standard deviations beyond which an error counts by itself and no more by its square."""
_LINES_MIN: Final = 8
"""More than the unknowns."""


class Gains(NamedTuple):
    """Gains that a loop holds, parallel, N m for rad/s."""

    proportional: float
    integral: float
    differential: float = 0.0

    def response(self, omega: Array) -> ComplexArray:
        """Return C."""
        s = 1j * omega
        return np.asarray(self.proportional + self.integral / s + self.differential * s, dtype=complex)


class Excited(NamedTuple):
    """One measurement, and the gains at that time."""

    told: FrequencyResponse
    """The speed told, 606Ch, over the one given."""
    made: FrequencyResponse
    """The derivative of the position over the speed given."""
    gains: Gains


@dataclass(frozen=True, slots=True)
class LoopPlant:
    """G, and how well it fits."""

    inertia_kg_m2: float
    viscous_nm_s: float
    delay_s: float
    lag_s: float
    filter_s: float
    filter_order: int
    feed_share: float
    """K over the inertia."""
    misfit: float
    """Relative error that is not noise, rms; without one line a measurement, which something else may have
    disturbed."""
    worst_hz: float
    """Line of the largest error of the others."""
    lag_error_s: float
    """Of delay and lags together, k = 2."""
    share: float
    """What the gains of the last measurement did, over what they should; those of the first one count as
    true."""
    share_error: float
    """Of it, k = 2."""

    @property
    def lag_in_all_s(self) -> float:
        """Delay and lags together, s."""
        return self.delay_s + self.lag_s + self.filter_s

    def response(self) -> Response:
        """Return G."""
        shaft = shaft_plant(self.inertia_kg_m2, self.viscous_nm_s, self.delay_s, self.lag_s)
        return lambda omega: shaft(omega) * _filtered(1j * omega, self.filter_s, self.filter_order)


Hold = Callable[[Array, float], ComplexArray]
"""H, of frequencies, rad/s, and the period of the set-points, s."""


class NotFound(ValueError):
    """The responses do not show the loop."""


class _Lines(NamedTuple):
    """The coherent lines of one response."""

    omega: Array
    response: ComplexArray
    noise: Array
    """Standard deviation over the response, of both parts together."""
    gains: Gains
    told: bool
    """False: made."""


class _Unknowns(NamedTuple):
    """What is fitted, beside Ts or Tw of each response: between two measurements the grids of host and drive
    part."""

    delay_s: float
    lag_s: float
    filter_s: float
    feed_share: float
    smooth_s: float
    """Tr."""
    filter_order: int

    def filtered(self, s: ComplexArray) -> ComplexArray:
        """Return F."""
        return _filtered(s, self.filter_s, self.filter_order)


_SHARED: Final = len(_Unknowns._fields) - 1
_SMOOTH: Final = _Unknowns._fields.index("smooth_s")


def _filtered(s: ComplexArray, filter_s: float, order: int) -> ComplexArray:
    return np.asarray((1.0 + s * filter_s / order) ** -order, dtype=complex)


def loop_plant(
    excited: Sequence[Excited], inertia_kg_m2: float, viscous_nm_s: float, period_s: float
) -> LoopPlant:
    """Fit G to responses. ``period_s``: of the set-points. Raises NotFound for too few coherent lines."""
    sets = list(dict.fromkeys(each.gains for each in excited))
    both = [
        _coherent(response, each.gains, told)
        for each in excited
        for response, told in ((each.told, True), (each.made, False))
    ]
    lines = [each for each in both if len(each.omega) >= _LINES_MIN]
    if not lines:
        raise NotFound(f"fewer than {_LINES_MIN} lines are coherent")

    def errors(x: Array, hold: Hold, order: int) -> ComplexArray:
        found = _unknowns(x, order)
        model = partial(_sampled, found, inertia_kg_m2, viscous_nm_s, period_s, hold)
        shares = dict(zip(sets, (1.0, *x[_SHARED + len(lines) :]), strict=True))
        return np.concatenate(
            [
                model(each, float(way_s), float(shares[each.gains])) / each.response - 1.0
                for each, way_s in zip(lines, x[_SHARED:], strict=False)
            ]
        )

    noise = np.concatenate([each.noise for each in lines])
    weight = 1.0 / np.hypot(noise, _MODEL)

    def residuals(x: Array, hold: Hold, order: int) -> Array:
        error = weight * errors(x, hold, order)
        return np.concatenate([error.real, error.imag])

    def judged(best: Any, hold: Hold, order: int) -> _Judgement:
        return _judged(np.abs(errors(best.x, hold, order)), noise, weight, len(excited))

    fit = partial(_fitted, residuals, lines, len(sets) - 1, period_s)
    best, hold, order = fit(smooth_s=0.0)
    judgement, smoothed = judged(best, hold, order), False
    if judgement.misfit > _SMOOTHED:
        other = fit(smooth_s=_LAG_MAX_S)
        smoothed = (look := judged(*other)).misfit < _CLEARER * judgement.misfit
        if smoothed:
            (best, hold, order), judgement = other, look
    others = len(sets) > 1
    found = _unknowns(best.x, order)
    jacobian = best.jac if smoothed else np.delete(best.jac, _SMOOTH, axis=1)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * judgement.over
    together = np.array([1.0, 1.0, 1.0, *[0.0] * (jacobian.shape[1] - 3)])
    frequency = np.concatenate([each.omega for each in lines]) / math.tau
    return LoopPlant(
        inertia_kg_m2,
        viscous_nm_s,
        found.delay_s,
        found.lag_s,
        found.filter_s,
        order,
        found.feed_share,
        misfit=judgement.misfit,
        worst_hz=float(frequency[judgement.worst]),
        lag_error_s=2.0 * math.sqrt(max(0.0, float(together @ covariance @ together))),
        share=float(best.x[-1]) if others else 1.0,
        share_error=2.0 * math.sqrt(max(0.0, float(covariance[-1, -1]))) if others else 0.0,
    )


class _Judgement(NamedTuple):
    """How well a fit explains the lines."""

    misfit: float
    worst: int
    """Place of the line that is furthest off."""
    over: float
    """Mean square of the errors over that of the noise, 1 at the least."""


def _judged(error: Array, noise: Array, weight: Array, left_out: int) -> _Judgement:
    """Judge a fit by its errors, without the worst ``left_out``."""
    kept = np.argsort(weight * error)[:-left_out]
    beyond = float(np.mean(error[kept] ** 2 - noise[kept] ** 2))
    over = float(np.mean((weight[kept] * error[kept]) ** 2))
    return _Judgement(math.sqrt(max(0.0, beyond)), int(kept[-1]), max(1.0, over))


def _fitted(
    residuals: Callable[[Array, Hold, int], Array],
    lines: Sequence[_Lines],
    others: int,
    period_s: float,
    smooth_s: float,
) -> tuple[Any, Hold, int]:
    """Return the best fit, with its H and order of F. ``others``: sets of gains beside the first;
    ``smooth_s``: the longest Tr."""
    most_s = _TRANSPORT_PERIODS * period_s
    bounds = (
        [*[0.0] * (_SHARED + len(lines)), *[1.0 / _SHARE_MAX] * others],
        [
            *[_LAG_MAX_S] * 3,
            _FEED_MAX,
            max(smooth_s, _PINNED_S),
            *[most_s] * len(lines),
            *[_SHARE_MAX] * others,
        ],
    )
    scale = [1e-4, 1e-4, 1e-4, 0.1, 1e-4, *[1e-3] * len(lines), *[0.1] * others]
    late_s = [_late_s(each) for each in lines]
    fits = []
    for hold, order, lag_s in itertools.product((_stepped, _straight), (1, 2), _STARTS_S):
        ways = [min(max(late - lag_s, 0.1 * period_s), 0.9 * most_s) for late in late_s]
        start = [
            lag_s / 3.0,
            lag_s / 3.0,
            lag_s / 3.0,
            _FEED,
            max(0.5 * _PINNED_S, min(1e-3, smooth_s)),
            *ways,
            *[1.0] * others,
        ]
        fit = scipy.optimize.least_squares(
            residuals,
            start,
            bounds=bounds,
            x_scale=scale,
            args=(hold, order),
            max_nfev=_STEPS_MAX,
            loss="soft_l1",
            f_scale=_OUTLYING,
        )
        fits.append((float(fit.cost), fit, hold, order))
    _, best, hold, order = min(fits, key=lambda each: each[0])
    return best, hold, order


def _unknowns(x: Array, order: int) -> _Unknowns:
    delay_s, lag_s, filter_s, feed_share, smooth_s = (float(each) for each in x[:_SHARED])
    return _Unknowns(delay_s, lag_s, filter_s, feed_share, smooth_s, order)


def _late_s(lines: _Lines) -> float:
    """Return the slope of the phase: all delay of a response together, s."""
    phase = np.unwrap(np.angle(lines.response))
    return -float(np.polyfit(lines.omega, phase, 1)[0])


def _coherent(response: FrequencyResponse, gains: Gains, told: bool) -> _Lines:
    good = response.coherence > _COHERENT
    coherence = response.coherence[good]
    return _Lines(
        math.tau * response.frequency_hz[good],
        response.response[good],
        np.sqrt((1.0 - coherence) / (BLOCKS * coherence)),
        gains,
        told,
    )


def _stepped(omega: Array, period_s: float) -> ComplexArray:
    """Return H of a set-point that stays until the next one."""
    turned = np.exp(-0.5j * omega * period_s)
    return np.asarray(turned * np.sinc(omega * period_s / math.tau), dtype=complex)


def _straight(omega: Array, period_s: float) -> ComplexArray:
    """Return H of straight lines between set-points; how late they begin is in Ts."""
    return np.asarray(np.sinc(omega * period_s / math.tau) ** 2, dtype=complex)


def _sampled(
    found: _Unknowns,
    inertia_kg_m2: float,
    viscous_nm_s: float,
    period_s: float,
    hold: Hold,
    lines: _Lines,
    way_s: float,
    share: float,
) -> ComplexArray:
    """Return the response as samples show it: with a line's images, from the corners of the set-point."""
    together = np.zeros(len(lines.omega), dtype=complex)
    for image in (-1, 0, 1):
        omega = lines.omega + image * math.tau / period_s
        way = hold(omega, period_s) * np.exp(-1j * omega * way_s)
        part = way * _model(found, inertia_kg_m2, viscous_nm_s, lines, omega, share)
        together += part if lines.told else part * lines.omega / omega
    return together


def _model(
    found: _Unknowns, inertia_kg_m2: float, viscous_nm_s: float, lines: _Lines, omega: Array, share: float
) -> ComplexArray:
    s = 1j * omega
    controller, filtered = share * lines.gains.response(omega), found.filtered(s)
    forward = shaft_plant(inertia_kg_m2, viscous_nm_s, found.delay_s, found.lag_s)(omega)
    driven = (controller + found.feed_share * inertia_kg_m2 * s) / (1.0 + s * found.smooth_s)
    if lines.told:
        driven = driven * filtered
    return np.asarray(driven * forward / (1.0 + controller * forward * filtered), dtype=complex)

"""Iron that saturates: inductances are constant up to a current, and beyond it both axes lose together.

The currents are the gradient of an energy in the fluxes of d and q, so that none is made or lost:

    W = (psi_d^2 / L_d + psi_q^2 / L_q) / 2 + s over^3 / 6,   over = max(0, psi_d^2 + psi_q^2 - knee)
    i_d = psi_d (1 / L_d + s over^2) - phi / L_d,             i_q = psi_q (1 / L_q + s over^2)

Torque is k n_p (psi_d i_q - psi_q i_d).
"""

import math
from dataclasses import dataclass
from typing import Final

_TRIES_MAX: Final = 60
_HALVINGS: Final = 80
"""Steps of a bisection: to rounding."""


@dataclass(frozen=True, slots=True)
class Iron:
    """The coefficients of W."""

    per_inductance_d: float
    per_inductance_q: float
    magnet_a: float
    """phi / L_d."""
    knee_wb2: float
    strength: float
    """s, A/Wb^5."""

    def _over(self, flux_d: float, flux_q: float) -> float:
        return max(0.0, flux_d * flux_d + flux_q * flux_q - self.knee_wb2)

    def currents(self, flux_d: float, flux_q: float) -> tuple[float, float]:
        """d and q currents, A, of two fluxes, Wb."""
        more = self.strength * self._over(flux_d, flux_q) ** 2
        return (
            flux_d * (self.per_inductance_d + more) - self.magnet_a,
            flux_q * (self.per_inductance_q + more),
        )

    def fluxes(self, current_d: float, current_q: float) -> tuple[float, float]:
        """d and q fluxes, Wb, of two currents, A: W is convex, and Newton's method finds its one solution."""
        d, q = (current_d + self.magnet_a) / self.per_inductance_d, current_q / self.per_inductance_q
        for _ in range(_TRIES_MAX):
            over = self._over(d, q)
            if over == 0.0:
                break
            found_d, found_q = self.currents(d, q)
            off_d, off_q = found_d - current_d, found_q - current_q
            dd, dq, qq = self.stiffness(d, q)
            per = 1.0 / (dd * qq - dq * dq)
            step_d, step_q = per * (qq * off_d - dq * off_q), per * (dd * off_q - dq * off_d)
            d, q = d - step_d, q - step_q
            if step_d**2 + step_q**2 <= 1e-30 * (d * d + q * q):
                break
        return d, q

    def stiffness(self, flux_d: float, flux_q: float) -> tuple[float, float, float]:
        """Slopes of the currents over the fluxes, 1/H: dd, dq and qq; the inverse of what a small change
        sees as inductances."""
        over = self._over(flux_d, flux_q)
        more, steep = self.strength * over**2, 4.0 * self.strength * over
        return (
            self.per_inductance_d + more + steep * flux_d**2,
            steep * flux_d * flux_q,
            self.per_inductance_q + more + steep * flux_q**2,
        )


def iron_of(
    inductance_d_h: float,
    inductance_q_h: float,
    flux_linkage_wb: float,
    *,
    linear_to_a: float,
    at_a: float,
    torque_share: float,
) -> Iron:
    """Iron whose torque over the q current, without d current, is linear up to ``linear_to_a``, and at
    ``at_a`` the share ``torque_share`` of that. Error: ValueError for what no iron of this kind does."""
    if not linear_to_a < at_a:
        raise ValueError(f"linear_to_a below current_max_a = {at_a:g}")
    knee_wb2 = flux_linkage_wb**2 + (inductance_q_h * linear_to_a) ** 2
    least = math.sqrt(knee_wb2 / (flux_linkage_wb**2 + (inductance_q_h * at_a) ** 2))
    if torque_share <= least:
        raise ValueError(f"torque_percent above {100.0 * least:.4g}, where the flux stays at its knee")

    def of(strength: float) -> Iron:
        magnet_a = flux_linkage_wb * (1.0 / inductance_d_h)
        return Iron(1.0 / inductance_d_h, 1.0 / inductance_q_h, magnet_a, knee_wb2, strength)

    def share(strength: float) -> float:
        return of(strength).fluxes(0.0, at_a)[0] / flux_linkage_wb

    high = 1.0 / (inductance_q_h * knee_wb2**2)
    while share(high) > torque_share:
        high *= 4.0
    low = 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if share(middle) > torque_share else (low, middle)
    return of(high)

/* Fluxes of given currents by Newton's method. The energy is convex, so there is one solution, and from the
   linear one the steps lead to it. Only +, -, * and /. */
#include "saturation.h"

enum { TRIES_MAX = 60 };
/* Of the flux, squared: then the next step is below rounding. */
static const double FOUND = 1e-30;

static double dot(Pair a, Pair b) { return a[0] * b[0] + a[1] * b[1]; }

Pair flux_of_currents(const Saturation *p, Pair current)
{
    Pair flux = {(current[0] + p->magnet_a) / p->per_d, current[1] / p->per_q};
    for (int tries = 0; tries < TRIES_MAX; tries++) {
        double over = over_knee(p, flux);
        if (over == 0.0)
            break;
        Pair residual = currents_of_flux(p, flux) - current;
        double more = p->strength * over * over, steep = 4.0 * p->strength * over;
        double dd = p->per_d + more + steep * flux[0] * flux[0];
        double qq = p->per_q + more + steep * flux[1] * flux[1];
        double dq = steep * flux[0] * flux[1];
        double per = 1.0 / (dd * qq - dq * dq);
        Pair step = {per * (qq * residual[0] - dq * residual[1]), per * (dd * residual[1] - dq * residual[0])};
        flux -= step;
        if (dot(step, step) <= FOUND * dot(flux, flux))
            break;
    }
    return flux;
}

double saturated_energy(const Saturation *p, Pair flux)
{
    double over = over_knee(p, flux);
    double linear = 0.5 * (p->per_d * flux[0] * flux[0] + p->per_q * flux[1] * flux[1]);
    return linear + p->strength * over * over * over / 6.0 - p->magnet_a * flux[0];
}

/* Iron that saturates: the currents of d and q as a function of their fluxes, of both together. */
#ifndef CORE_SATURATION_H
#define CORE_SATURATION_H

#include "pairs.h"

/* The gradient of the energy (psi_d^2 / L_d + psi_q^2 / L_q) / 2 + strength over^3 / 6 with
   over = |psi|^2 - knee, or 0 below it; the magnet is a current of the d axis. */
typedef struct Saturation {
    int active; /* 0: constant inductances */
    double per_d, per_q;
    double magnet_a; /* that makes the magnet's flux */
    double knee_wb2;
    double strength; /* A/Wb^5 */
} Saturation;

Pair flux_of_currents(const Saturation *p, Pair current);
/* J over the torque factor, but for a constant. */
double saturated_energy(const Saturation *p, Pair flux);

/* Wb^2 above the knee. */
static inline double over_knee(const Saturation *p, Pair flux)
{
    double over = flux[0] * flux[0] + flux[1] * flux[1] - p->knee_wb2;
    return over > 0.0 ? over : 0.0;
}

static inline Pair currents_of_flux(const Saturation *p, Pair flux)
{
    double over = over_knee(p, flux);
    double more = p->strength * over * over;
    Pair per = {p->per_d + more, p->per_q + more}, magnet = {p->magnet_a, 0.0};
    return flux * per - magnet;
}

#endif

/* The drive's own filters between the torque demand and the current loops: a low pass and a notch. */
#ifndef CORE_TORQUE_PATH_H
#define CORE_TORQUE_PATH_H

typedef struct TorquePath {
    int active;     /* 0: the demand is made as it is */
    double step_nm;  /* that a torque set-point goes in a tick at most; 0: at once */
    double low_gain; /* of the low pass, Euler's backward rule; 1: there is none */
    double notch_b0, notch_b1, notch_b2, notch_a1, notch_a2; /* of the notch, over a0 */
} TorquePath;

/* N m; in and out of the notch at the last two ticks. */
typedef struct TorquePathState {
    double low_nm, in_nm[2], out_nm[2];
} TorquePathState;

/* What is made of a demand at this tick, N m. */
static inline double shaped_torque(TorquePathState *state, const TorquePath *p, double demand_nm)
{
    state->low_nm += p->low_gain * (demand_nm - state->low_nm);
    double in = state->low_nm;
    double out = p->notch_b0 * in + p->notch_b1 * state->in_nm[0] + p->notch_b2 * state->in_nm[1];
    out -= p->notch_a1 * state->out_nm[0] + p->notch_a2 * state->out_nm[1];
    state->in_nm[1] = state->in_nm[0];
    state->in_nm[0] = in;
    state->out_nm[1] = state->out_nm[0];
    state->out_nm[0] = out;
    return out;
}

#endif

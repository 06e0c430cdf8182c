"""Whether speed designs for random motors are quiet on the simulated drive: ``--seconds`` at most.

Each motor is run twice: with the drive's own encoder, whose noise the torque must have, and with one whose
noise is nothing, where a limit cycle would be left alone.
"""

import argparse

import numpy as np

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.random_motors import FINE_ENCODER, designed, torque_rms_nm

MOTORS = 100
QUIET_NM = 0.15


def main() -> None:
    """A line for each motor, then the figures of all."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--seconds", type=float, default=600.0)
    seconds = arguments.parse_args().seconds
    clock = MonotonicClock()
    until = clock.now() + seconds * NS_PER_S
    found = []
    print(
        "seed  inertia  torque rms by the encoder  of its noise alone  with a fine encoder, N m", flush=True
    )
    for seed in range(1, MOTORS + 1):
        if clock.now() > until:
            break
        own = designed(np.random.default_rng(seed))
        rms_nm = torque_rms_nm(own.motor, own.gain)
        fine_nm = torque_rms_nm(own.motor, own.gain, encoder_counts_per_revolution=FINE_ENCODER)
        inertia = own.motor["mechanics"]["inertia_kg_m2"]
        print(f"{seed:4} {inertia:8.2e} {rms_nm:12.4f} {own.noise_nm:25.4f} {fine_nm:20.4f}", flush=True)
        found.append((rms_nm, rms_nm / own.noise_nm, fine_nm))
    told = np.array(found)
    print(f"{len(told)} of {MOTORS} motors")
    for name, column in zip(("by the encoder, N m", "over its noise", "fine, N m"), told.T, strict=True):
        print(f"{name:20} p50 {np.median(column):.4f}  max {column.max():.4f}")
    loud, fine = (int((told[:, column] > QUIET_NM).sum()) for column in (0, 2))
    print(f"above {QUIET_NM} N m: {loud}, with a fine encoder {fine}")


if __name__ == "__main__":
    main()

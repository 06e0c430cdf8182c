"""A speed design for the drive's current loop is quiet on it; one for R/L limit-cycles."""

import numpy as np
import pytest

from hil.configuration.motor_file import LING2012
from tests.random_motors import steady_torque_rms_nm, torque_rms_nm

QUIET_NM = 0.15
"""Of Ling's motor, 2 N m rated."""
RANDOM_QUIET_NM = 0.2
"""Of a random one: the noise of its speed alone may be 0.17 N m. A limit cycle is 1 N m and more."""


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_design_for_the_drives_bandwidth_is_quiet(seed: int) -> None:
    assert steady_torque_rms_nm(np.random.default_rng(seed)) < RANDOM_QUIET_NM


def test_the_least_gain_at_one_millisecond_is_quiet_for_800_hz_and_not_for_54() -> None:
    """Both designed by `hil design speed --target sampled` for 1 ms without loss and up to 1 ms of delay."""
    motor = LING2012.model_dump(mode="json")
    assert torque_rms_nm(motor, [-0.277584, -1.152695]) < QUIET_NM
    assert torque_rms_nm(motor, [-1.881, -1.757]) > 1.0

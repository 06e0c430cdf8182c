"""The compiled kernel does the arithmetic that its source says, bit for bit."""

import os
import subprocess
import sys

PROGRAM = """
from drivers.timebase import Instant
from tests.motors import AZAIZ
from virtual_bus.drive import motor_kernel as kernel
from virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from dataclasses import replace

firmware = Firmware(replace(AZAIZ, coulomb_friction_nm=0.1), FirmwareParameters())
now = 0
for step in range(30):
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque((-1.0) ** step * 9.0)
    firmware.demand[kernel.D_LOAD] = 0.3 * (step % 3)
    if step % 7 == 6:
        firmware.ramp_to_speed(0.0, 4000.0)
    if step % 11 == 10:
        firmware.control(InnerControl.OFF)
    now += 4_000_000
    firmware.advance_to(Instant(now))
    print(firmware.state.tobytes().hex())
"""


def states(**environment: str) -> list[str]:
    """The drive's state after each of some steps, as hex, computed in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
    )
    return done.stdout.split()


def test_compiled_and_interpreted_runs_agree_to_the_last_bit() -> None:
    """No fused product, no reordered sum, no library function: so the bits are the same on any machine."""
    compiled, interpreted = states(), states(NUMBA_DISABLE_JIT="1")
    assert len(compiled) == 30
    assert len(set(compiled)) == 30
    assert compiled == interpreted

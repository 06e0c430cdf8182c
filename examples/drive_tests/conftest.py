"""What the tests share."""

from pathlib import Path

import pytest
from spindle_control import SpindleController

HERE = Path(__file__).parent


@pytest.fixture
def bench() -> Path:
    """The bench file of the spindle."""
    return HERE / "spindle.toml"


@pytest.fixture
def controller() -> SpindleController:
    """The controller as it is delivered."""
    return SpindleController(proportional=0.008, integral=0.06, friction=0.0004, period_s=0.005)


@pytest.fixture
def spindle(servo_drive):
    """The spindle's drive, enabled, with a master beside it."""
    rig = servo_drive(node=3, motor=HERE / "motor.toml", seed=1)
    rig.enable()
    return rig

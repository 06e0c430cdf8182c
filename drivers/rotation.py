"""Speeds in everyday units: SI uses rad/s, a nameplate r/min."""

import math
from typing import Final

RAD_PER_REVOLUTION: Final = 2.0 * math.pi
RAD_S_PER_RPM: Final = RAD_PER_REVOLUTION / 60.0
RPM_PER_RAD_S: Final = 60.0 / RAD_PER_REVOLUTION

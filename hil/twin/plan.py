"""Plan the motion that a fit wants to see: a bench file, within the limits of the bench that it is made from.

    slow      a turn each way at 3 % of the speed        friction at low speed, a weight
    levels    speeds both ways, held                     friction that grows with speed, both kinds
    swings    sines at 2, 4 and 8 Hz                     inertia, dead time, the filter of the speed

Ramps and swings take a part of the torque that the drive may make, reckoned with the inertia of its motor
file. A run ends at rest. A coast-down is no part: in each window the shaft follows torques, zero among them.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from servobench.drivers.bounded_file import read_toml
from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.twin.twin_drive import check_mode

_TORQUE_SHARE: Final = 0.3
"""Of what the drive may make: the file's inertia may be half of the shaft's, and friction comes on top."""
_SLOW: Final = 0.03
"""Of the speed; a filter of some ms and the quantum of a coarse encoder still tell it from rest."""
_SLOW_S: Final = 1.0
_LEVELS: Final = (0.3, -0.3, 0.8, -0.8)
"""Of the speed: two magnitudes tell viscous from Coulomb friction, two signs a weight from both."""
_LEVEL_S: Final = 0.6
_SWINGS_HZ: Final = (2.0, 4.0, 8.0)
_SWING_S: Final = 1.5
_SWING: Final = 0.4
"""Of the speed; less where the torque does not reach."""
_LEAST_RAMP_S: Final = 0.1
_FIRST_S: Final = 0.1


def excitation_text(path: Path, config: BenchConfig, axis: str) -> str:
    """Return the bench file ``path``, read as ``config``, with the motion that a fit of ``axis`` wants.

    It has no load, no faults and no limits of the verdict. Raises BadInput for an axis whose set-points are
    not of torque.
    """
    drive = config.drive[axis]
    check_mode(str(path), axis, drive.mode)
    tables = read_toml(path, "bench file")
    for name in ("reference", "load", "load_machine", "faults", "verdict"):
        tables.pop(name, None)
    entries = list(_entries(drive))
    last = entries[-1]
    tables["reference"] = {axis: entries}
    tables["bench"] |= {
        "name": f"{config.bench.name}-excited",
        "duration_s": round(last["at_s"] + last["over_s"] + _FIRST_S, 3),
    }
    head = f"# The motion that hil fit wants to see, on the bench of {path.name}: hil fit --plan.\n\n"
    return head + toml_text(tables)


def _entries(drive: DriveConfig) -> Iterator[dict[str, Any]]:
    """Yield the entries of the reference, one behind the other."""
    motor, limits = drive.motor.parameters, drive.limits
    speed = min(motor.rated_speed_rad_s * RPM_PER_RAD_S, limits.set_speed_rpm)
    torque = _TORQUE_SHARE * min(motor.rated_torque_nm, limits.torque_max_nm)
    slew = torque / drive.motor.mechanics.inertia_kg_m2 * RPM_PER_RAD_S
    at, level = _FIRST_S, 0.0
    for share, held_s in (*((each, _SLOW_S) for each in (_SLOW, -_SLOW)), *((s, _LEVEL_S) for s in _LEVELS)):
        over = max(_LEAST_RAMP_S, abs(share * speed - level) / slew)
        level = round(share * speed, 3)
        yield {"at_s": round(at, 3), "kind": "ramp", "speed_rpm": level, "over_s": round(over, 3)}
        at += over + held_s
    over = max(_LEAST_RAMP_S, abs(level) / slew)
    yield {"at_s": round(at, 3), "kind": "ramp", "speed_rpm": 0.0, "over_s": round(over, 3)}
    at += over + _LEAST_RAMP_S
    for frequency in _SWINGS_HZ:
        amplitude = min(_SWING * speed, slew / (math.tau * frequency))
        yield {
            "at_s": round(at, 3),
            "kind": "sine",
            "amplitude_rpm": round(amplitude, 3),
            "frequency_hz": frequency,
        }
        at += _SWING_S
    yield {"at_s": round(at, 3), "kind": "ramp", "speed_rpm": 0.0, "over_s": _LEAST_RAMP_S}

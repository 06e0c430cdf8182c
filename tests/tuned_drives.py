"""``python -m tests.tuned_drives --count 200``: drawn drives, whose speed loops ``hil tune --apply`` sets.

Each drive has its own rates, encoder, way of sensing speed, inertia, friction, gains before, filters, maker's
objects and, one in eight, a coupling. The loop that it then has is opened by brute force
(:mod:`tests.drive_loops`). Prints a line for each and leaves with 1 if a demand was missed by 10 % of the
bandwidth or by 5 degrees, or if a refusal left an object changed.
"""

import argparse
import math
import random
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from servobench.design.mechanism import Coupling, Mechanism
from servobench.design.motor import PmsmParameters
from servobench.drivers.vendors.families import quirks_for
from servobench.hil.commissioning.steps_tune import TuneRequest, tune_limits, tune_steps
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.drive.data_sheet import tell_motor
from servobench.virtual_bus.drive.encoder import SpeedMethod, SpeedSensing
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.set_point_path import SetPointPath
from tests.drive_loops import OpenLoop, opened
from tests.motors import LING
from tests.unit.hil.test_manual_motion import Moved, moved
from tests.unit.virtual_bus.test_loop_gains import epos4

BANDWIDTH_OFF = 0.10
MARGIN_OFF_DEG = 5.0
"""By the issue that asked for the command."""


@dataclass(frozen=True)
class DrawnDrive:
    """A drive and a demand."""

    motor: PmsmParameters
    parameters: DriveParameters
    makers: bool
    """True: it is an EPOS4 by its objects."""
    demand: dict[str, float]

    @property
    def text(self) -> str:
        """What was drawn, in a line."""
        each, speed = self.parameters, self.parameters.speed
        inertia = self.motor.inertia_kg_m2 / LING.inertia_kg_m2
        filters = f"filters {each.path.filter_hz}, {each.path.torque_filter_hz} Hz"
        demand = ", ".join(f"{key} {value:.1f}" for key, value in self.demand.items())
        coupled = "coupled " if self.motor.mechanism is not None else ""
        maker = "EPOS4 " if self.makers else ""
        return (
            f"{maker}{coupled}{speed.method.name.lower()} {speed.filter_hz} Hz, {each.inner_rate_hz} Hz, "
            f"{each.encoder_counts_per_revolution} counts, J x {inertia:.1f}, {filters}: "
            f"{demand}"
        )

    def servo(self) -> SimulatedServo:
        """Return the drive."""

        def vendor(dictionary: ObjectDictionary) -> None:
            epos4(dictionary)
            tell_motor(dictionary, self.motor)

        return SimulatedServo(1, self.motor, self.parameters, vendor=vendor if self.makers else None)


def drawn(seed: int) -> DrawnDrive:
    """Return the drive of a seed."""
    draw = random.Random(seed)
    motor = replace(
        LING,
        coulomb_friction_nm=draw.uniform(0.0, 0.15),
        viscous_friction_nm_s=draw.uniform(0.0, 0.003),
        inertia_kg_m2=LING.inertia_kg_m2 * draw.uniform(1.0, 8.0),
    )
    rate = draw.choice([4000, 8000, 10_000, 16_000, 20_000])
    parameters = DriveParameters(
        gain_objects=True,
        inner_rate_hz=rate,
        current_bandwidth_hz=draw.uniform(0.02, 0.08) * rate,
        speed_bandwidth_hz=draw.uniform(8.0, 40.0),
        encoder_counts_per_revolution=draw.choice([4096, 8192, 65_536, 1 << 20]),
        speed=SpeedSensing(
            method=draw.choice(list(SpeedMethod)),
            filter_hz=draw.choice([None, 150.0, 300.0, 500.0, 1000.0]),
            bandwidth_rad_s=draw.uniform(600.0, 1000.0),
        ),
    )
    if draw.random() < 0.6:
        demand = {"bandwidth_hz": math.exp(draw.uniform(math.log(20.0), math.log(140.0)))}
    else:
        demand = {"phase_margin_deg": draw.uniform(45.0, 75.0)}
    makers = draw.random() < 0.3
    if makers:
        parameters = replace(parameters, makers_units=quirks_for(0xFB, 0, "EPOS4"))
    if draw.random() < 0.125:
        load = motor.inertia_kg_m2 * draw.uniform(0.3, 0.75)
        stiffness = load * (math.tau * draw.uniform(30.0, 150.0)) ** 2  # by the antiresonance, Hz
        coupling = Coupling(motor.inertia_kg_m2 - load, load, stiffness, damping_ratio=0.02)
        motor = replace(motor, mechanism=Mechanism(coupling=coupling))
    path = SetPointPath(
        filter_hz=draw.choice([None, None, None, 50.0, 200.0]),
        torque_filter_hz=draw.choice([None, None, None, 300.0]),
    )
    return DrawnDrive(motor, replace(parameters, path=path), makers, demand)


def tuned(each: DrawnDrive, servo: SimulatedServo, out: Path) -> Moved:
    """Have ``hil tune`` meet the demand."""
    return moved(
        out,
        lambda: tune_steps(TuneRequest(apply=True, **each.demand)),
        tune_limits(600.0, 50.0, 40.0),
        purpose="tune",
        servo=servo,
        also=["30A2h:01", "30A2h:02"] if each.makers else [],
    )


def missed(each: DrawnDrive, loop: OpenLoop) -> str:
    """Return what of the demand the loop misses; empty: nothing."""
    if "bandwidth_hz" in each.demand:
        off = loop.bandwidth_hz / each.demand["bandwidth_hz"] - 1.0
        return f"bandwidth {100 * off:+.1f} %" if abs(off) > BANDWIDTH_OFF else ""
    off = loop.phase_margin_deg - each.demand["phase_margin_deg"]
    return f"margin {off:+.1f} degrees" if abs(off) > MARGIN_OFF_DEG else ""


def verdict(each: DrawnDrive) -> tuple[str, str]:
    """Tune it; return what came of it, and what is wrong with that: empty if nothing is."""
    servo = each.servo()
    with tempfile.TemporaryDirectory() as out:
        done = tuned(each, servo, Path(out))
    if done.result.exit_status:
        why = next((text for text in done.told if "failed:" in text), done.told[-1]).strip().split(";")[0]
        changed = [
            f"{key[0]:04X}h:{key[1]:02X}" for key, held in done.before.items() if done.after[key] != held
        ]
        confessed = any(
            "NOT confirmed at rest" in text for text in done.told
        )  # its own loop never came to rest
        return why, f"left {', '.join(changed)}" if changed and not confessed else ""
    inner = servo.drive.firmware.inner
    loop = opened(each.motor, each.parameters, inner.speed_gain, inner.speed_integral_gain)
    told: dict[str, Any] = done.result.records[-1].outcome.figures.get("measured with them", {})
    text = (
        f"{loop.bandwidth_hz:.1f} Hz and {loop.phase_margin_deg:.1f} degrees, told "
        f"{told.get('bandwidth_hz', math.nan):.1f} and {told.get('phase_margin_deg', math.nan):.1f}"
    )
    return text, missed(each, loop)


def main() -> int:
    """Print the lines."""
    parser = argparse.ArgumentParser(prog="python -m tests.tuned_drives")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first drive")
    given = parser.parse_args()
    wrong = refused = 0
    for seed in range(given.seed, given.seed + given.count):
        each = drawn(seed)
        text, what = verdict(each)
        wrong += bool(what)
        refused += text.startswith("failed")
        print(f"{seed}: {each.text}: {text}{f'  WRONG: {what}' if what else ''}", flush=True)
    print(f"{given.count} drives, {refused} refused with their reason, {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())

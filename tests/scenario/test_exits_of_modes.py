"""Every way out of a run ends at rest, whatever the drive is given: torques, speeds or positions.

The witness is the shaft of the simulated plant, while the run lasts and a second longer, in which nobody
commands the drive any more.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Final

import pytest

from servobench import run
from servobench.drivers.canopen.nmt_states import NmtCommand
from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import BenchError, DriveInFault, LimitExceeded, PeerFault, PowerLost
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.control.own_code import OwnCodeFailed
from servobench.hil.machine.stopping import StopRequest
from servobench.virtual_bus.frame import Frame
from tests.draws import few_of, few_pairs
from tests.exits.written_witness import SYNC_ID
from tests.scenario.processes import EXAMPLES
from tests.swarm.witness import DriveWitness, witnessed

TURNING_RAD_S: Final = 30.0
STILL_RAD_S: Final = 0.5
STRUCK_S: Final = 0.25
REST_WITHIN_NS: Final = 500 * NS_PER_MS
"""From the end of the run: the drive's heartbeat consumer waits for 150 ms, a quick stop lasts 0.1 s."""
LEVELS: Final = {
    "cst": [{"kind": "ramp", "at_s": 0.02, "speed_rpm": 400.0, "over_s": 0.1}],
    "csv": [{"kind": "ramp", "at_s": 0.02, "position_rad": 40.0, "over_s": 1.0}],
    "csp": [{"kind": "ramp", "at_s": 0.02, "position_rad": 40.0, "over_s": 1.0}],
    "ip": [{"kind": "ramp", "at_s": 0.02, "position_rad": 40.0, "over_s": 1.0}],
    "vl": [{"kind": "ramp", "at_s": 0.02, "speed_rpm": 350.0, "over_s": 0.1}],
}
MODES: Final = tuple(LEVELS)
CONTROLLERS: Final = {
    "cst": {"kind": "pid", "proportional_nm_s_rad": 0.05, "integral_nm_rad": 0.5, "derivative_nm_s2_rad": 0.0}
    | {"derivative_filter_s": 0.02, "feedforward_nm_s_rad": 0.00185},
    "csv": {"kind": "position", "made_for": {"delay_us": 1000, "speed_bandwidth_hz": 30}},
    "csp": {"kind": "stream"},
    "ip": {"kind": "stream"},
    "vl": {"kind": "stream"},
}
OWN: Final = """
from servobench import Controller, PositionSetPoint, SpeedSetPoint, TorqueSetPoint

class Failing(Controller):
    def __init__(self, setup, mode):
        self.mode = mode

    def output(self, context):
        if context.sequence == 250:
            raise RuntimeError("no solution")
        speed = min(40.0, 0.4 * context.sequence)
        if self.mode == "cst":
            return TorqueSetPoint(0.05 * (speed - context.estimate.velocity_rad_s))
        if self.mode in ("csv", "vl"):
            return SpeedSetPoint(speed)
        return PositionSetPoint(context.estimate.position_rad + 0.05)
"""
PULLED: Final = [{"at_s": STRUCK_S, "torque_nm": -4.0}]


def blackout(direction: str, *frames: str) -> dict[str, Any]:
    lost = {"direction": direction, "from_s": STRUCK_S, "duration_s": 60.0, "side": "drive"}
    return {"faults": {"blackout": [{**lost, "frames": list(frames)}]}}


def struck(kind: str, **keys: Any) -> dict[str, Any]:
    return {"faults": {kind: [{"at_s": STRUCK_S, **keys}]}}


EXITS: Final[Mapping[str, tuple[dict[str, Any], type[BenchError] | None]]] = {
    "end": ({}, None),
    "commands lost": (blackout("host_to_drive", "pdo"), PeerFault),
    "readings lost": (blackout("drive_to_host", "pdo"), LimitExceeded),
    "bus lost": (struck("silence", nodes=[1], duration_s=60.0), PeerFault),
    "bus off": (struck("bus_off", nodes=[1]), PeerFault),
    "host stalled": (struck("host_stall", late_us=1_000_000), PeerFault),
    "drive fault": (struck("drive_fault", fault="over_temperature"), DriveInFault),
    "following error": (struck("drive_fault", fault="following_error"), DriveInFault),
    "encoder lost": (struck("drive_fault", fault="encoder_loss"), DriveInFault),
    "safe torque off": (struck("safe_torque_off", duration_s=60.0), PowerLost),
    "speed limit": ({"load": {"axis1": PULLED}, "drive.axis1.limits.speed_max_rpm": 480.0}, LimitExceeded),
}


def bench_of(mode: str) -> dict[str, Any]:
    return {
        "bench.duration_s": 0.5,
        "drive.axis1.mode": mode,
        "drive.axis1.controller": CONTROLLERS[mode],
        "drive.axis1.limits": {"speed_max_rpm": 900.0, "torque_max_nm": 5.0, "dropouts_consecutive_max": 50},
        "reference": {"axis1": LEVELS[mode]},
        "verdict": {},
    }


class ShaftWitness(DriveWitness):
    """It reads the plant itself, not what the drive measures."""

    turned_rad_s = 0.0

    @property
    def shaft_rad_s(self) -> float:
        return abs(self._drive.drive.firmware.inner.speed_rad_s)

    def _seen(self, frames: Any, now: Instant) -> Any:
        if self._drive.drive.power.state is State.OPERATION_ENABLED:
            self.turned_rad_s = max(self.turned_rad_s, self.shaft_rad_s)
        return super()._seen(frames, now)

    def rests_when_left_alone(self) -> None:
        """From the end of the run on, for a second in which it hears nothing."""
        ended = self.seen_at
        for ms in range(10, 1001, 10):
            now = Instant(ended + ms * NS_PER_MS)
            while (due := self._drive.wake_at) is not None and due <= now:
                self._drive.wake(Instant(max(due, ended)))
            self._drive.wake(now)
            if ms * NS_PER_MS < REST_WITHIN_NS:
                continue
            state = self._drive.drive.power.state
            assert self.shaft_rad_s < STILL_RAD_S, f"{self.shaft_rad_s:.1f} rad/s in {state} after {ms} ms"
            assert state is not State.OPERATION_ENABLED, f"enabled after {ms} ms"


class ResetWitness(ShaftWitness):
    """Another master resets the drive's communication, which takes it off the bus until its boot-up."""

    syncs = 0

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        self.syncs += frame.can_id == SYNC_ID
        if frame.can_id == SYNC_ID and self.syncs == round(STRUCK_S * 1000):
            super().receive(Frame(0x000, bytes([NmtCommand.RESET_COMMUNICATION, 1])), now)
        return super().receive(frame, now)


def rests(
    changes: Mapping[str, Any],
    ends_in: type[BenchError] | None,
    stop_at_s: float = math.inf,
    witness_of: type[ShaftWitness] = ShaftWitness,
) -> None:
    witnesses: list[DriveWitness] = []
    stop = StopRequest()

    def progress(phase: str, elapsed_s: float) -> None:
        if phase == "running" and elapsed_s >= stop_at_s:
            stop.ask()

    with witnessed(witnesses, witness_of), nullcontext() if ends_in is None else pytest.raises(ends_in):
        run(EXAMPLES / "position_csp.toml", changes, stop=stop, progress=progress)
    (witness,) = witnesses
    assert isinstance(witness, ShaftWitness)
    assert witness.turned_rad_s > TURNING_RAD_S, "it never turned"
    witness.rests_when_left_alone()


@pytest.mark.parametrize(("way_out", "mode"), few_pairs(EXITS, MODES, 2))
def test_a_way_out_ends_with_the_shaft_at_rest(way_out: str, mode: str) -> None:
    changes, ends_in = EXITS[way_out]
    rests({**bench_of(mode), **changes}, ends_in)


@pytest.mark.parametrize("mode", few_of(MODES, 2))
def test_an_interrupted_run_ends_with_the_shaft_at_rest(mode: str) -> None:
    rests(bench_of(mode), None, stop_at_s=STRUCK_S)


@pytest.mark.parametrize("mode", few_of(MODES, 2))
def test_a_controller_that_raises_ends_with_the_shaft_at_rest(tmp_path: Path, mode: str) -> None:
    code = tmp_path / "failing.py"
    code.write_text(OWN)
    own = {"kind": "python", "object": f"{code}:Failing", "parameters": {"mode": mode}}
    rests({**bench_of(mode), "drive.axis1.controller": own, "reference": {}}, OwnCodeFailed)


@pytest.mark.parametrize("mode", few_of(MODES, 2))
def test_a_drive_that_another_master_resets_ends_with_the_shaft_at_rest(mode: str) -> None:
    rests(bench_of(mode), PeerFault, witness_of=ResetWitness)

"""A drive that ignores its set-points without a word while it is commissioned: bit 12 stays set.

Witnesses: the frames on the bus and the simulated shaft.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.cia402.profile import Mode, State, supported_mode_bit
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.commissioning.findings import StepVerdict
from servobench.hil.commissioning.report import REPORT_FILE, Commissioned
from servobench.hil.rows.recording_plan import SIMULATED_EPOCH
from servobench.hil.rows.run_files import COMMISSIONING_RECORDING, EVENTS_FILE
from tests.commissioning import Spy, unknown_world
from tests.recorded_frames import candump_text

SEED = 3
DEAF = "no longer follows its commands"
LEFT_AWAY = ["turn", "stop_proof", "mechanics", "torque_constant", "voltage_constant", "response"]
"""They take their time, and the delays do not rest on them."""
TICK_US = 62.5
"""Of the drive's inner loops: when in a tick the SYNCs fall is chance."""
BEFORE_PULSES_S = 2.3
"""The step "polarity" has begun."""
RPDO = "201#"
MARGIN_RAW = 4
"""A demand that is off by less may be rounded."""
DEAF_AFTER_S = 0.6
"""Of a step that lasts two seconds."""
NOTICED_S = 0.1
"""40 ms of commands, until the next read of the demand, and the time in which the drive is asked why."""


def told(folder: Path) -> list[dict[str, Any]]:
    lines = (folder / COMMISSIONING_RECORDING / EVENTS_FILE).read_text().splitlines()
    return [json.loads(line) for line in lines]


def begins_s(folder: Path, step: str) -> float:
    """When, from the first frame on."""
    return float(next(event["at_ns"] for event in told(folder) if event.get("state") == step)) / NS_PER_S


def deaf(folder: Path, from_s: float, holds: str, lasts_s: float, **more: Any) -> tuple[Commissioned, Spy]:
    fault = {"nodes": [1], "at_s": from_s, "holds": holds, "duration_s": lasts_s, "bit_12_cleared": False}
    _, result, spy = unknown_world(SEED, folder, faults={"ignored_commands": [fault]}, **more)
    return result, spy


def noticed_s(folder: Path, step: str) -> float:
    """When the step failed for it."""
    events = (event for event in told(folder) if f"{step}: failed: " in event.get("text", ""))
    event = next(events)
    assert DEAF in event["text"]
    return float(event["at_ns"]) / NS_PER_S


def moved_at_s(folder: Path, from_s: float) -> float:
    """When the set-point on the bus had moved by more than MARGIN_RAW since ``from_s``."""
    first = None
    for line in candump_text(folder / COMMISSIONING_RECORDING).splitlines():
        stamp, _, frame = line.split()[:3]
        at_s = float(stamp.strip("()")) - SIMULATED_EPOCH / NS_PER_S
        if at_s > from_s and frame.startswith(RPDO):
            raw = int.from_bytes(bytes.fromhex(frame.removeprefix(RPDO))[2:], "little", signed=True)
            first = raw if first is None else first
            if abs(raw - first) > MARGIN_RAW:
                return at_s
    raise AssertionError("nothing was commanded")


def rests(spy: Spy) -> bool:
    drive = spy.drive
    return drive.power.state is State.SWITCH_ON_DISABLED and abs(drive.firmware.speed_rad_s) < 1.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Commissioned]:
    """Of a drive that follows."""
    folder = tmp_path_factory.mktemp("whole")
    _, result, _ = unknown_world(SEED, folder, last_step="delays", without=LEFT_AWAY)
    return folder, result


def test_no_delay_is_made_of_commands_that_were_ignored(
    tmp_path: Path, whole: tuple[Path, Commissioned]
) -> None:
    from_s = begins_s(whole[0], "delays") + DEAF_AFTER_S
    result, spy = deaf(tmp_path, from_s, "last", 0.1, last_step="delays", without=LEFT_AWAY)
    assert noticed_s(tmp_path, "Delays and losses") - from_s < NOTICED_S
    record, expected = result.records[-1], whole[1].records[-1].outcome.figures
    assert (record.verdict, record.attempts) == (StepVerdict.DONE, 2)
    figures = record.outcome.figures
    assert figures["dead_time_us"] == pytest.approx(expected["dead_time_us"], abs=TICK_US / 4)
    assert figures["lag_us"] == pytest.approx(expected["lag_us"], abs=TICK_US / 4)
    assert figures["commands_lost"] == 0
    assert rests(spy)


def test_a_drive_that_stays_deaf_has_no_delay_and_rests(
    tmp_path: Path, whole: tuple[Path, Commissioned]
) -> None:
    from_s = begins_s(whole[0], "delays") + DEAF_AFTER_S
    result, spy = deaf(tmp_path, from_s, "zero", 100.0, last_step="delays", without=LEFT_AWAY)
    assert noticed_s(tmp_path, "Delays and losses") - from_s < NOTICED_S
    assert result.records[-1].verdict is StepVerdict.FAILED
    assert result.records[-1].outcome.figures == {}
    assert result.findings.effect_delay_us is result.findings.current_bandwidth_hz is None
    assert not result.passed
    assert rests(spy)
    assert "the torque does not follow its command" in (tmp_path / REPORT_FILE).read_text()


@pytest.mark.parametrize(
    ("mode", "demand", "holds"),
    [
        (Mode.CYCLIC_SYNCHRONOUS_TORQUE, "6074h", "zero"),
        (Mode.PROFILE_TORQUE, "6074h", "last"),
        (Mode.CYCLIC_SYNCHRONOUS_VELOCITY, "606Bh", "last"),
        (Mode.CYCLIC_SYNCHRONOUS_POSITION, "6062h", "zero"),
        (Mode.PROFILE_POSITION, "6062h", "last"),
    ],
)
def test_a_drive_that_is_deaf_in_an_exercise_is_brought_to_rest(
    tmp_path: Path, mode: Mode, demand: str, holds: str
) -> None:
    """Before its first pulse, so that nothing has moved yet."""
    only = supported_mode_bit(mode)
    result, spy = deaf(tmp_path, BEFORE_PULSES_S, holds, 100.0, modes=only, last_step="polarity")
    late_s = noticed_s(tmp_path, "Direction and polarity") - moved_at_s(tmp_path, BEFORE_PULSES_S)
    assert 0.02 < late_s < NOTICED_S
    assert f"its commands are watched by the host by {demand}, " in (tmp_path / REPORT_FILE).read_text()
    assert str(result.error).startswith("the step 'Direction and polarity' failed")
    assert result.left.at_rest
    assert rests(spy)

"""Where the product limits and reacts to faults, and which unit tests answer for it.

Functions are named, so that lines may move; one that is gone is an error, to be mended here.
"""

import fnmatch
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Final

from tests.code_mutants.mutations import Mutant, mutants_of
from tests.code_mutants.workshop import ROOT

MODULE: Final = "(module)"
"""Instead of a function: the constants at the top."""


@dataclass(frozen=True, slots=True)
class Guarded:
    """Functions of one file, and the tests that must see each of their mutants."""

    file: str
    functions: tuple[str, ...]
    """Qualified names; ``*`` stands for any part of one."""
    tests: tuple[str, ...]
    words: tuple[str, ...] = ("",)
    """Only lines that hold one of these: where a limit is a line of a function that does other things."""


_LOOP: Final = ("tests/unit/hil/test_safety.py", "tests/unit/hil/test_loop.py")
_UNIT: Final = "tests/unit/drivers/"
_SUPERVISION: Final = (_UNIT + "test_supervision.py", _UNIT + "test_servo.py")
_WATCH: Final = (_UNIT + "test_drive_watch.py",)
_STATES: Final = (_UNIT + "test_state_control.py", _UNIT + "test_drive_watch.py", _UNIT + "test_servo.py")
_SERVO: Final = (
    _UNIT + "test_servo.py",
    _UNIT + "test_servo_enabling.py",
    _UNIT + "test_servo_stopping.py",
    _UNIT + "test_drive_watch.py",
    _UNIT + "test_supervision.py",
    _UNIT + "test_modes.py",
)
_STOP: Final = ("tests/unit/hil/test_stopping_means.py", "tests/unit/hil/test_stopping.py")
_LIMITS: Final = ("tests/unit/hil/test_commissioning_limits.py",)
_EXERCISE: Final = ("tests/unit/hil/test_commissioning_exercise.py",)
_SESSION: Final = ("tests/unit/hil/test_commissioning_session.py",)
_STEPS: Final = ("tests/unit/hil/test_commissioning_travel.py",)
_TURN: Final = ("tests/unit/hil/test_commissioning_turn.py",)

SAFETY: Final = (
    Guarded("hil/loop/safety.py", ("*Limits", "SafetyGuard*", MODULE), _LOOP),
    Guarded(
        "hil/loop/safety.py",
        ("PositionPath.__init__", "PositionPath.start_from", "PositionPath.towards"),  # the others: how soon
        ("tests/unit/hil/test_position_path.py",),
    ),
    Guarded("hil/loop/axis.py", ("Axis.miss", "Axis._check"), _LOOP),
    Guarded("hil/loop/axis.py", ("Axis.decide",), _LOOP, words=("guard", "_fresh", "_drive")),
    Guarded("hil/loop/axis.py", ("Axis._take",), _LOOP, words=("check_speed",)),
    Guarded("hil/loop/loop.py", ("Loop.run",), _LOOP, words=("stop", "interrupted", "break", "settle_all")),
    Guarded("hil/loop/loop.py", ("Loop._miss",), _LOOP, words=("reason", "+= 1")),
    Guarded("hil/loop/loop.py", ("Loop._serve",), _LOOP, words=("served", "_cycle", "_miss")),
    Guarded("hil/loop/loop.py", ("Loop._drain",), _LOOP),
    Guarded("drivers/cia402/supervision.py", ("*",), _SUPERVISION),
    Guarded("drivers/cia402/drive_watch.py", ("*",), _WATCH),
    Guarded("drivers/cia402/rest.py", ("*",), (_UNIT + "test_rest.py", _UNIT + "test_servo.py")),
    Guarded(
        "drivers/cia402/state_control.py",
        (
            "StateControl.walk",
            "StateControl.await_state",
            "StateControl.await_older_words",
            "StateControl.ask_after_emergency",
            "StateControl.command",
            "StateControl.command_by_pdo",
            "StateControl.set_bits",
            "StateControl.clear_bits",
            "StateControl.fault_seen_at",
            "StateControl.in_fault",
            "StateControl.stuck",
            "StateControl.read_status",
            "StateControl._put_in_force",
            "StateControl._on_emergency",
        ),
        _STATES,
    ),
    Guarded(
        "drivers/cia402/servo.py",
        (
            "ServoDrive.enable",
            "ServoDrive.disable",
            "ServoDrive.stop",
            "ServoDrive.quick_stop",
            "ServoDrive.release",
            "ServoDrive.check",
            "ServoDrive.write",
            "ServoDrive._bring_to_rest",
            "ServoDrive._leave",
            "ServoDrive._stop_following",
        ),
        _SERVO,
    ),
    Guarded("hil/inspecting/stopping.py", ("*",), _STOP),
    Guarded("hil/restoring/restore.py", ("bring_to_rest",), ("tests/unit/hil/test_bring_to_rest.py",)),
    Guarded(
        "hil/restoring/restore.py",
        (MODULE,),
        ("tests/unit/hil/test_bring_to_rest.py",),
        words=("REST_",),
    ),
    Guarded("hil/commissioning/exercise.py", ("Watched.*", "EnergyMeter.*"), _LIMITS),
    Guarded("hil/commissioning/exercise.py", ("Exerciser._run",), _EXERCISE),
    Guarded(
        "hil/commissioning/exercise.py",
        ("torque_limits", "speed_limits", "_shaft_speed_max", "_dropouts_max"),
        (*_EXERCISE, *_LIMITS),
    ),
    Guarded("hil/commissioning/exercise.py", (MODULE,), _EXERCISE, words=("BLIND", "OVERSPEED", "RUN_UP")),
    Guarded("hil/commissioning/request.py", ("motion_limits", "PlateLimits"), _LIMITS),
    Guarded("hil/commissioning/request.py", ("CommissionRequest.heartbeat_ms",), _LIMITS),
    Guarded(
        "hil/commissioning/session.py",
        ("Session.check_stop", "Session.enabled", "Session.check_temperature", "Session.calm"),
        _SESSION,
    ),
    Guarded(
        "hil/commissioning/dialog.py",
        ("EmergencyStop.*",),
        ("tests/unit/hil/test_commissioning_sequence.py",),
    ),
    Guarded("hil/commissioning/steps_units.py", ("pulses", "_both_ways"), _STEPS, words=("limits.",)),
    Guarded("hil/commissioning/steps_units.py", ("Turn.left_out",), _STEPS, words=("travel",)),
    Guarded("hil/commissioning/steps_mechanics.py", ("top_speed",), _STEPS),
    Guarded("hil/commissioning/steps_mechanics.py", ("_coasts",), _STEPS, words=("travel",)),
    Guarded("hil/commissioning/steps_design.py", ("Verify._speed",), _STEPS),
    Guarded("hil/commissioning/steps_dynamics.py", ("*.left_out",), _STEPS, words=("limits.",)),
    Guarded("hil/commissioning/steps_setup.py", ("_extra_limits",), _STEPS, words=("reach", "bound")),
    Guarded("hil/commissioning/turn.py", ("_by_searches",), _TURN),
    Guarded("hil/commissioning/turn.py", (MODULE,), _TURN, words=("OVERSHOOT",)),
)


class Gone(LookupError):
    """A file or a function of the list is not there any more."""


_mutants_of = cache(mutants_of)


def mutants_in(guarded: Guarded) -> list[Mutant]:
    """Those of the functions. Raises Gone."""
    path = ROOT / guarded.file
    if not path.is_file():
        raise Gone(f"{guarded.file} is not there any more: mend tests/code_mutants/safety.py")
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    every = _mutants_of(guarded.file, text)
    chosen = []
    for pattern in guarded.functions:
        matching = [each for each in every if fnmatch.fnmatchcase(each.place.function or MODULE, pattern)]
        if not matching:
            raise Gone(f"nothing in {guarded.file} is called {pattern}: mend tests/code_mutants/safety.py")
        chosen += [each for each in matching if any(word in lines[each.line - 1] for word in guarded.words)]
    if not chosen:
        raise Gone(f"no line of {guarded.file} holds {guarded.words!r}: mend tests/code_mutants/safety.py")
    return chosen


def safety_set() -> Iterator[tuple[Guarded, list[Mutant]]]:
    """Each entry of the list with its mutants. Raises Gone."""
    for guarded in SAFETY:
        yield guarded, mutants_in(guarded)

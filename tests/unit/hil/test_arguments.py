"""Every public function refuses arguments that it cannot mean, before it looks at anything.

Functions and arguments are found, not listed: a new one is walked too.
"""

import inspect
import math
from collections.abc import Callable, Iterator
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from servobench.drivers.cia402.profile import State
from servobench.hil.campaign.campaign import Campaign, run_campaign
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.testing.drive_rig import DriveRig
from servobench.hil.testing.history import AxisHistory
from servobench.hil.testing.hosted import DriveWish
from servobench.hil.testing.run import Run
from servobench.hil.testing.wire import Wire

ROOMS = (Run, Wire, DriveRig, Campaign, CampaignPlan, AxisHistory)
UNCHECKED = {
    ("Wire", "take"): "called for each frame, by the adapter",
    ("Wire", "controlwords"): "called by assert_controlwords, with the node of its drive",
    ("Wire", "assert_only"): "called by assert_no_unintended_frame, with patterns",
    ("Run", "axis"): "refuses every name but those of the run",
    ("Run", "column"): "refuses every name but those of the run",
    ("AxisHistory", "channel"): "refuses every name but those of the run",
    ("Campaign", "column"): "refuses every name but those of the table",
}
NO_NUMBERS: tuple[Any, ...] = (math.nan, -math.inf, True, "1.0", b"1", 1j, [1.0], {}, np.float64(math.nan))
SIGNED = {("between", "from_s"), ("between", "until_s"), ("run", "torque_nm")}
ENDLESS = {"assert_error_below", "window"}
"""Their ``until_s`` may be infinite."""
NO_TEXTS = (1, 1.0, b"081#*", ["081#*"], State.FAULT)
NO_FLAGS = (0, 1, "True", 1.0, np.True_)
NO_STATES = (5, "fault", True, 1.0)
NEEDED: dict[Any, Any] = {State: State.FAULT, str: "080#", float: 0.5, int: 1}


class Nothing:
    """Behind no function: who looks at it fails otherwise than by a refusal."""


def functions() -> Iterator[Callable[..., Any]]:
    for room in ROOMS:
        for name, method in inspect.getmembers(room, inspect.isfunction):
            if not name.startswith("_") and (room.__name__, name) not in UNCHECKED:
                yield method
    yield run_campaign


def kinds(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def arguments(*wanted: type) -> Iterator[tuple[Callable[..., Any], str, tuple[Any, ...]]]:
    """Those of which a part of the annotation is, or is derived from, one of ``wanted``."""
    for function in functions():
        for key, hint in get_type_hints(function).items():
            if key != "return" and any(kind in wanted for kind in kinds(hint)):
                yield function, key, kinds(hint)


def cases(*wanted: type) -> pytest.MarkDecorator:
    found = [pytest.param(*case, id=f"{case[0].__qualname__}-{case[1]}") for case in arguments(*wanted)]
    return pytest.mark.parametrize(("function", "key", "taken"), found)


def called(function: Callable[..., Any], key: str, value: Any) -> None:
    """With what it needs beside them."""
    hints, given, named = get_type_hints(function), list[Any](), dict[str, Any]()
    for name, parameter in inspect.signature(function).parameters.items():
        needed = value if name == key else NEEDED.get(hints.get(name), Nothing())
        if parameter.default is not parameter.empty and name != key:
            continue
        if name == "self" or (parameter.kind is parameter.VAR_POSITIONAL and not named):
            given.append(needed)
        elif parameter.kind is not parameter.VAR_POSITIONAL:
            named[name] = needed
    function(*given, **named)


def refused(function: Callable[..., Any], key: str, value: Any) -> None:
    with pytest.raises((ValueError, TypeError), match=f"^{function.__name__}: {key}: found .*, expected "):
        called(function, key, value)


def test_there_are_numbers_in_every_room() -> None:
    rooms = {case[0].__qualname__.partition(".")[0] for case in arguments(int, float)}
    assert rooms == {each.__name__ for each in ROOMS} | {"run_campaign"}
    assert len([*arguments(int, float)]) > 30


@cases(int, float)
def test_what_is_no_number_is_refused_by_name(
    function: Callable[..., Any], key: str, taken: tuple[Any, ...]
) -> None:
    bad: list[Any] = [*NO_NUMBERS]
    bad += [] if float in taken else [1.5]
    bad += [] if (function.__name__, key) in SIGNED else [-1, -0.5]
    bad += [] if key == "until_s" and function.__name__ in ENDLESS else [math.inf]
    bad += [] if type(None) in taken else [None]
    for value in bad:
        refused(function, key, value)


@cases(str)
def test_what_is_no_text_is_refused_by_name(
    function: Callable[..., Any], key: str, taken: tuple[Any, ...]
) -> None:
    if all(kind in (str, type(None)) for kind in taken):
        for value in NO_TEXTS:
            refused(function, key, value)


@cases(bool)
def test_a_flag_is_a_bool(function: Callable[..., Any], key: str, taken: tuple[Any, ...]) -> None:
    assert set(taken) <= {bool, type(None)}
    for value in NO_FLAGS:
        refused(function, key, value)


@cases(State)
def test_a_state_is_one_of_them(function: Callable[..., Any], key: str, taken: tuple[Any, ...]) -> None:
    assert taken == (State,)
    for value in NO_STATES:
        refused(function, key, value)


@pytest.mark.parametrize("value", ["081#*", b"081#*", [1], {}, None])
@pytest.mark.parametrize("room", [Run, DriveRig])
def test_patterns_that_are_allowed_come_in_a_tuple(room: Any, value: Any) -> None:
    refused(room.assert_no_unintended_frame, "allow", value)


@pytest.mark.parametrize(("from_s", "until_s"), [(2.0, 1.0), (1.0, 1.0), (0.0, 0.0)])
@pytest.mark.parametrize("function", [Run.assert_error_below, Wire.between, AxisHistory.window])
def test_a_window_ends_after_it_begins(function: Any, from_s: float, until_s: float) -> None:
    with pytest.raises(ValueError, match=r"from_s = \d is not before until_s = \d"):
        function(Nothing(), from_s=from_s, until_s=until_s)


def test_a_sequence_has_a_frame() -> None:
    with pytest.raises(ValueError, match="assert_sequence: no patterns given, at least one expected"):
        Wire().assert_sequence()


@pytest.mark.parametrize(
    ("function", "key", "worst", "expected"),
    [
        (Campaign.assert_pass_rate, "at_least", 0.0, "a share above 0 and"),
        (Campaign.assert_pass_rate, "at_least", 1.5, "a share above 0 and"),
        (Campaign.assert_pass_rate, "confidence", 0.5, "a share above 0.5"),
        (Campaign.pass_rate, "confidence", 0.0, "a share above 0 and"),
        (Campaign.failure_rate, "confidence", 1.5, "a share above 0 and"),
        (run_campaign, "workers", 0, "a number above 0"),
    ],
)
def test_a_number_is_in_its_range(function: Any, key: str, worst: float, expected: str) -> None:
    with pytest.raises(ValueError, match=f"{key}: found {worst:g}.*, expected {expected}"):
        called(function, key, worst)


@pytest.mark.parametrize("value", [2.0, 2, np.float32(2.0), np.int64(2)])
def test_numbers_of_any_kind_pass(value: Any) -> None:
    with pytest.raises(AttributeError, match="Nothing"):
        called(Run.assert_error_below, "percent", value)


def test_a_torque_may_be_a_function_of_the_reading() -> None:
    with pytest.raises(AttributeError, match="Nothing"):
        called(DriveRig.run, "torque_nm", lambda reading: 0.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "1", 1.5, -1])
@pytest.mark.parametrize("key", ["node", "seed", "bitrate_bit_s"])
def test_a_wish_for_a_drive_is_refused_when_it_is_made(key: str, value: Any) -> None:
    with pytest.raises((ValueError, TypeError), match=f"^servo_drive: {key}: found "):
        DriveWish(**{key: value})

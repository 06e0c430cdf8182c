"""Every claim of the pytest API refuses arguments that nothing could break, before it looks at anything."""

import inspect
import math
from collections.abc import Callable, Iterator
from typing import Any, get_type_hints

import numpy as np
import pytest

from servobench.drivers.cia402.profile import State
from servobench.hil.campaign.campaign import Campaign
from servobench.hil.testing.drive_rig import DriveRig
from servobench.hil.testing.run import Run
from servobench.hil.testing.wire import Wire

ROOMS = (Run, Wire, DriveRig, Campaign)
NO_NUMBERS = (math.nan, -math.inf, -1.0, True, "1.0", np.float64(math.nan))


class Nothing:
    """Behind no claim: who looks at it fails otherwise than by a refusal."""


def claims() -> Iterator[Callable[..., Any]]:
    """Found, not listed."""
    for room in ROOMS:
        for name, method in inspect.getmembers(room, inspect.isfunction):
            if name.startswith("assert_"):
                yield method


def kinds(hint: Any) -> set[Any]:
    return set(getattr(hint, "__args__", (hint,)))


def numbers() -> Iterator[tuple[Callable[..., Any], str, set[Any]]]:
    for method in claims():
        for key, hint in get_type_hints(method).items():
            if key in ("return", "words"):  # controlwords are no limits
                continue
            if kinds(hint) & {int, float}:
                yield method, key, kinds(hint)


def called(method: Callable[..., Any], **changed: Any) -> None:
    """With what it needs beside them."""
    needed: dict[str, Any] = {}
    for key, parameter in list(inspect.signature(method).parameters.items())[1:]:
        if parameter.default is parameter.empty and parameter.kind is not parameter.VAR_POSITIONAL:
            needed[key] = {State: State.FAULT, str: "080#", float: 0.5}[get_type_hints(method)[key]]
    method(Nothing(), **needed | changed)


CASES = [pytest.param(*case, id=f"{case[0].__qualname__}-{case[1]}") for case in numbers()]


def test_there_are_claims_with_numbers_in_every_room() -> None:
    assert {case[0].__qualname__.partition(".")[0] for case in numbers()} == {each.__name__ for each in ROOMS}


@pytest.mark.parametrize(("method", "key", "taken"), CASES)
def test_what_is_no_number_is_refused_by_name(method: Callable[..., Any], key: str, taken: set[Any]) -> None:
    bad = [*NO_NUMBERS, *([] if float in taken else [1.5]), *([] if key == "until_s" else [math.inf])]
    for value in bad:
        with pytest.raises((ValueError, TypeError), match=f"^{method.__name__}: {key}: found .*, expected "):
            called(method, **{key: value})


@pytest.mark.parametrize(("from_s", "until_s"), [(2.0, 1.0), (1.0, 1.0), (0.0, 0.0)])
def test_a_window_ends_after_it_begins(from_s: float, until_s: float) -> None:
    with pytest.raises(ValueError, match=r"from_s = \d is not before until_s = \d"):
        called(Run.assert_error_below, percent=1.0, from_s=from_s, until_s=until_s)


@pytest.mark.parametrize("key", ["at_least", "confidence"])
@pytest.mark.parametrize("value", [0.0, 1.5])
def test_a_rate_is_a_share(key: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{key}: found .*, expected a share above 0"):
        called(Campaign.assert_pass_rate, **{key: value})


@pytest.mark.parametrize("value", [2.0, 2, np.float32(2.0), np.int64(2)])
def test_numbers_of_any_kind_pass(value: Any) -> None:
    with pytest.raises(AttributeError, match="Nothing"):
        called(Run.assert_error_below, percent=value, from_s=0, until_s=math.inf)

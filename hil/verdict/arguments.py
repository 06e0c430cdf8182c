"""Checks the arguments of public functions by their annotations.

Every comparison with NaN is false: a NaN limit would hold for any run, like no limit; and no frame is of a
flag that is no bool. Both would make a claim that no outcome could break.
"""

import math
from collections.abc import Callable, Mapping
from enum import Enum
from functools import cache, wraps
from inspect import Parameter, signature
from numbers import Real
from types import UnionType
from typing import Any, Final, NamedTuple, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

P = ParamSpec("P")
R = TypeVar("R")


class ArgumentRange(NamedTuple):
    """Numbers that an argument may have."""

    expected: str
    holds: Callable[[float], bool]
    endless: bool = False
    """Infinity is one: to the end."""


NOT_NEGATIVE: Final = ArgumentRange("no negative number", lambda number: number >= 0.0)
ENDLESS: Final = ArgumentRange(NOT_NEGATIVE.expected, NOT_NEGATIVE.holds, endless=True)
SIGNED: Final = ArgumentRange("a finite number", lambda number: True)
COUNT: Final = ArgumentRange("a number above 0", lambda number: number > 0.0)
SHARE: Final = ArgumentRange("a share above 0 and not above 1", lambda number: 0.0 < number <= 1.0)
"""A rate of at least 0 says nothing, and none is above 1."""
ONE_SIDED: Final = ArgumentRange("a share above 0.5 and not above 1", lambda number: 0.5 < number <= 1.0)
RANGES: Final = {
    "until_s": ENDLESS,
    "between.from_s": SIGNED,
    "between.until_s": SIGNED,
    "run.torque_nm": SIGNED,
    "workers": COUNT,
    "confidence": SHARE,
    "assert_pass_rate.at_least": SHARE,
    "assert_pass_rate.confidence": ONE_SIDED,
}
"""By argument, or function and argument; else :data:`NOT_NEGATIVE`."""
_PLAIN: Final = (str, bool, type(None))
_hints = cache(get_type_hints)
_signature = cache(signature)


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Wrap a public function in a check of its arguments.

    Raises ValueError or TypeError, which name function and argument.
    """

    @wraps(function)
    def checking(*given: P.args, **named: P.kwargs) -> R:
        __tracebackhide__ = True
        arguments = _signature(function).bind(*given, **named).arguments
        check_arguments(function.__name__, function, arguments)
        return function(*given, **named)

    return checking


def check_arguments(name: str, function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Check ``arguments`` by the annotations of ``function``; ``name``: as its user knows it.

    Numbers are finite and in their :data:`RANGES`, counts are whole, ``from_s`` is before ``until_s``, of
    texts there is at least one, and texts, flags and states are of their type.
    """
    hints = _hints(function)
    for key, parameter in _signature(function).parameters.items():
        several = parameter.kind is Parameter.VAR_POSITIONAL
        if several and hints[key] is str and not arguments.get(key):
            raise ValueError(f"{name}: no {key} given, at least one expected")
        if key in arguments and key in hints:
            for value in arguments[key] if several else (arguments[key],):
                _check(name, key, value, hints[key])
    bounds = {"from_s": -math.inf, "until_s": math.inf} | dict(arguments)
    if not bounds["from_s"] < bounds["until_s"]:
        raise ValueError(
            f"{name}: from_s = {bounds['from_s']:g} is not before until_s = {bounds['until_s']:g}"
        )


def _check(name: str, key: str, value: Any, hint: Any) -> None:
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    place = f"{name}: {key}"
    if float in kinds or int in kinds:
        if value is None and type(None) in kinds:
            return
        if not (callable(value) and any(get_origin(kind) is not None for kind in kinds)):
            _check_number(place, value, float not in kinds, RANGES.get(f"{name}.{key}") or RANGES.get(key))
    elif kinds == (tuple[str, ...],):
        if not isinstance(value, tuple | list) or not all(isinstance(each, str) for each in value):
            raise TypeError(f"{place}: found {value!r}, expected texts in a tuple")
    elif all(_is_plain(kind) for kind in kinds) and not isinstance(value, kinds):
        expected = " or ".join(kind.__name__ for kind in kinds if kind is not type(None))
        raise TypeError(f"{place}: found {value!r}, expected {expected}")


def _is_plain(kind: Any) -> bool:
    return kind in _PLAIN or (isinstance(kind, type) and issubclass(kind, Enum))


def _check_number(place: str, value: Any, whole: bool, allowed: ArgumentRange | None) -> None:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{place}: found {value!r}, expected a number")
    number, numbers = float(value), allowed or NOT_NEGATIVE
    expected = ""
    if math.isnan(number) or (math.isinf(number) and not numbers.endless):
        expected = "a finite number"
    elif whole and not number.is_integer():
        expected = "a whole number"
    elif not numbers.holds(number):
        expected = numbers.expected
    if expected:
        raise ValueError(f"{place}: found {value!r}, expected {expected}")

"""Checks the arguments of a claim: one that no outcome could break is refused at once.

Every comparison with NaN is false: a NaN limit would hold for any run, like no limit.
"""

import math
from collections.abc import Callable
from functools import cache, wraps
from inspect import Parameter, Signature, signature
from numbers import Real
from typing import Any, Final, ParamSpec, TypeVar, get_type_hints

P = ParamSpec("P")
R = TypeVar("R")

RATES: Final = frozenset({"assert_pass_rate"})
"""Claims whose numbers are shares, of (0, 1]: a rate of at least 0 says nothing, and none is above 1."""
ENDLESS: Final = frozenset({"until_s"})
"""Numbers that may be infinite: to the end."""
_hints = cache(get_type_hints)
_signature = cache(signature)


def claim(method: Callable[P, R]) -> Callable[P, R]:
    """Wrap ``method``, a claim, in a check of its arguments by their annotations.

    Numbers are finite and not negative (:data:`RATES`, :data:`ENDLESS`), counts are whole, ``from_s`` is
    before ``until_s``, and of texts there is at least one. Raises ValueError or TypeError, which name the
    claim and its argument.
    """

    @wraps(method)
    def checked(*given: P.args, **named: P.kwargs) -> R:
        __tracebackhide__ = True
        asked = _signature(method)
        _check(method.__name__, asked, asked.bind(*given, **named).arguments, _hints(method))
        return method(*given, **named)

    return checked


def _check(name: str, asked: Signature, arguments: dict[str, Any], hints: dict[str, Any]) -> None:
    for key, parameter in asked.parameters.items():
        value = arguments.get(key, ())
        if parameter.kind is Parameter.VAR_POSITIONAL and hints[key] is str and not value:
            raise ValueError(f"{name}: no {key} given, at least one expected")
        kinds = _kinds(hints.get(key))
        if key in arguments and value is not None and kinds & {int, float}:
            _check_number(f"{name}: {key}", value, kinds, name in RATES, key in ENDLESS)
    bounds = {"from_s": 0.0, "until_s": math.inf} | arguments
    if not bounds["from_s"] < bounds["until_s"]:
        raise ValueError(
            f"{name}: from_s = {bounds['from_s']:g} is not before until_s = {bounds['until_s']:g}"
        )


def _kinds(hint: Any) -> set[Any]:
    """Return the types of a union, or the one type."""
    return set(getattr(hint, "__args__", (hint,)))


def _check_number(place: str, value: Any, kinds: set[Any], share: bool, endless: bool) -> None:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{place}: found {value!r}, expected a number")
    number = float(value)
    expected = ""
    if math.isnan(number) or (math.isinf(number) and not endless):
        expected = "a finite number"
    elif float not in kinds and not number.is_integer():
        expected = "a whole number"
    elif share and not 0.0 < number <= 1.0:
        expected = "a share above 0 and not above 1"
    elif number < 0.0:
        expected = "no negative number"
    if expected:
        raise ValueError(f"{place}: found {value!r}, expected {expected}")

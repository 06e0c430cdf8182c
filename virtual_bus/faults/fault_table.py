"""Base of every table of a fault plan: a pydantic model with the keys of the file, used directly.

A field of a wrong type or beyond its bounds is pydantic's to find; what does not fit together raises BadInput
about its key (:func:`require`). :mod:`.fault_plan` gives both the file and the place in it.

Log format of one fault kind, and the replacements of a struck frame.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from servobench.drivers.canopen.nmt_states import NODE_ID_MAX
from servobench.drivers.errors import MISSING, BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration

NONE: Final = -1
"""A number that an entry does without: the bit of a frame that was lost, the recovery that never comes."""
UNDAMAGED: Final = -1
Copies = tuple[tuple[int, int], ...]
"""Replacements of a frame: for each copy the inverted bit of its data (UNDAMAGED: none), and its delay, ns,
after the frame's own turn."""


@dataclass(frozen=True, slots=True)
class LogNumber:
    """One number of an entry, as it stands in the log."""

    name: str
    least: int = 0
    optional: bool = False
    """May be NONE. Only for the first number; the others are then left out with it."""
    words: tuple[bool | str, ...] = ()
    """Words written for 0, 1, 2 ... instead."""
    usual: int | None = None
    """The value that is left out."""
    unsaid: int | None = None
    """Value in logs that lack it, though it is always written."""


@dataclass(frozen=True, slots=True)
class LogKind:
    """Entries of one kind."""

    name: str
    numbers: tuple[LogNumber, ...] = ()
    """At most three."""
    at: Literal["link", "node", "host"] = "link"
    tells: Literal["frame", "count", "nothing"] = "frame"
    """Which it was beside: the n-th frame of an identifier, the n-th of all, or nothing."""
    copies: Callable[[int], Copies] | None = None
    """Replacements of a struck frame by the entry's first number; None: it is lost."""
    in_order: bool = True
    """The frames behind it wait for what goes on."""
    alters: bool = False
    """The frame goes on with other values, whatever else befalls it (:mod:`.mangler`)."""
    of: Callable[[int, int], str] | None = None
    """Tells what was struck by the first two numbers; strikes of each count for themselves."""
    says: Callable[[int, int], str] | None = None
    """Tells by the first two numbers of something that is no strike."""
    since_power_on: bool = False
    """It counts its times from the drive's power-on, not from the plan's time zero."""

    @property
    def in_windows(self) -> bool:
        """So many may strike in a row that a reader is told from when to when."""
        return self.says is None and (self.tells == "frame" or self.at == "host")


LATER: Final = LogNumber("delay_ns", unsaid=0)
"""For how long a fault of the same frame delays it."""


def node_event(name: str, *numbers: LogNumber, since_power_on: bool = False) -> LogKind:
    """Entries of something that befalls a node now and then."""
    return LogKind(name, numbers, "node", "nothing", since_power_on=since_power_on)


DELAY_MAX = Duration(10 * NS_PER_S)
"""No field bus holds a frame longer; what is held takes memory."""
NS_PER_UNIT = {"us": NS_PER_US, "ms": NS_PER_MS, "s": NS_PER_S}
A_NUMBER = "a number, at most 1e+12"
"""Above every time in every unit: ten days in us. What is larger has no product in float."""
A_WHOLE_NUMBER = "a whole number, at most 2147483647"
"""Frames: at the 20 000 per second of a full bus, a day."""


def within(low: float, high: float, expected: str) -> AfterValidator:
    """A bound of a field, both ends included."""

    def check(value: Any) -> Any:
        if not low <= value <= high:
            raise ValueError(expected)
        return value

    return AfterValidator(check)


Number = Annotated[float, within(-1e12, 1e12, A_NUMBER)]
Seconds = Annotated[float, within(0.0, 1e8, "a time in seconds, >= 0")]
Lasting = Annotated[float, within(1e-9, 1e8, "a time > 0")]
Probability = Annotated[float, within(0.0, 1.0, "a probability from 0 to 1")]
Count = Annotated[int, within(1, 2**31 - 1, "a whole number >= 1")]
NodeId = Annotated[int, within(1, NODE_ID_MAX, f"a node id from 1 to {NODE_ID_MAX}")]
"""CiA 301 7.2.8.1."""
NodeIds = Annotated[tuple[NodeId, ...], Field(strict=False, description="a list of node ids, such as [1, 2]")]


def require(holds: bool, key: str, value: Any, expected: str) -> None:
    """Raise :class:`BadInput` about ``key`` unless ``holds``."""
    if not holds:
        raise BadInput("fault plan", key, value, expected)


def ns(value: float, unit: str = "s") -> Duration:
    """``value`` in ``unit`` to the nearest ns."""
    return Duration(round(value * NS_PER_UNIT[unit]))


class Range(NamedTuple):
    """A time from ``min_ns`` to ``max_ns``, both included."""

    min_ns: int
    max_ns: int

    @property
    def width(self) -> int:
        """How many times there are in it, ns."""
        return self.max_ns - self.min_ns + 1

    def drawn(self, draw: Callable[[], float]) -> int:
        """One of them, drawn evenly; without a draw if there is only one."""
        if self.max_ns == self.min_ns:
            return self.min_ns
        return self.min_ns + int(draw() * self.width)


class RangeRule(NamedTuple):
    """A time that is given by a key, or by two with _min and _max before its unit."""

    key: str
    what: str = "time"
    low: int = 0
    """ns, as ``high``."""
    high: int = DELAY_MAX
    optional: bool = False
    """Nothing, if it is left out."""


class FaultTable(BaseModel):
    """A table of a fault plan: immutable, no key unknown, no silent conversion, no nan."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)
    kind: ClassVar[str]
    """Name of its tables."""
    logs: ClassVar[tuple[LogKind, ...]] = ()
    """The entries that it makes in the log."""
    ranges: ClassVar[tuple[RangeRule, ...]] = ()
    """Its times that may be given as a range; each needs the three fields."""

    @model_validator(mode="after")
    def _check_ranges(self) -> "FaultTable":
        for rule in self.ranges:
            self.range(rule.key)
        return self

    @property
    def edges_ns(self) -> list[Duration]:
        """When it opens and closes, or strikes, of what has such times; since the plan's time zero."""
        return []

    def range(self, key: str) -> Range:
        """``STEM_UNIT``, which is ``key``, or ``STEM_min_UNIT`` and ``STEM_max_UNIT``. Raises BadInput."""
        _, what, low, high, optional = next(rule for rule in self.ranges if rule.key == key)
        stem, _, unit = key.rpartition("_")
        least_key, most_key = f"{stem}_min_{unit}", f"{stem}_max_{unit}"
        fixed, least, most = (getattr(self, name) for name in (key, least_key, most_key))
        if fixed is not None:
            require(most is None, most_key, most, f"nothing beside {key}")
            require(least is None, least_key, least, f"nothing beside {key}")
            least = most = fixed
        elif least is None and most is None:
            require(optional, key, MISSING, f"a {what}, or {least_key} and {most_key}")
            return Range(0, 0)
        require(least is not None, least_key, MISSING, A_NUMBER)
        require(most is not None, most_key, MISSING, A_NUMBER)
        limits, scale = Range(ns(least, unit), ns(most, unit)), NS_PER_UNIT[unit]
        top = f"{high // scale} {unit}"
        expected = f"a {what} > 0, at most {top}" if low > 0 else f"a {what} from {low // scale} to {top}"
        require(low <= limits.min_ns <= high, least_key if fixed is None else key, least, expected)
        expected = f"a {what} from {least_key} = {least:g} to {top}"
        require(limits.min_ns <= limits.max_ns <= high, most_key, most, expected)
        return limits

    def as_table(self) -> dict[str, Any]:
        """Return it as in a plan, every default written out."""
        return self.model_dump(mode="json", exclude_none=True)


class TimeWindow(FaultTable):
    """When a fault acts."""

    from_s: Seconds = 0.0
    """Since the plan's time zero."""
    until_s: Seconds | None = None
    """Exclusive; None: to the end."""

    @model_validator(mode="after")
    def _check_window(self) -> "TimeWindow":
        if self.until_ns is not None:
            expected = f"a time after from_s = {self.from_s:g}"
            require(self.until_ns > self.from_ns, "until_s", self.until_s, expected)
        return self

    @property
    def from_ns(self) -> Duration:
        """``from_s``."""
        return ns(self.from_s)

    @property
    def until_ns(self) -> Duration | None:
        """``until_s``."""
        return None if self.until_s is None else ns(self.until_s)

    @property
    def edges_ns(self) -> list[Duration]:
        """When it opens and closes."""
        return [self.from_ns] if self.until_ns is None else [self.from_ns, self.until_ns]

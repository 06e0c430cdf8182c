"""Fates with a log of them: what a run records so that it can be replayed."""

from collections.abc import Sequence
from typing import Final

from drivers.timebase import Duration, Instant
from virtual_bus.fault_injection.fault_log import EXTENDED_FLAG, KIND_CODES, NONE, FaultLog
from virtual_bus.fault_injection.fault_plan import Direction
from virtual_bus.fault_injection.replay import ReplayedFates
from virtual_bus.faults import PASSED, Fate, FaultInjector
from virtual_bus.frame import Frame

_DELAY: Final = KIND_CODES["delay"]
_REORDER: Final = KIND_CODES["reorder"]
_CORRUPTION: Final = KIND_CODES["corruption"]
_PASSED: Final = PASSED


TellingSource = FaultInjector | ReplayedFates
"""A source that can tell what it did. The classes by name: compiled, a call of a known one costs a tenth."""


class LoggedFates:
    """``source``, and an entry in ``log`` for every frame that does not just pass."""

    def __init__(self, source: TellingSource, log: FaultLog) -> None:
        self._source = source
        self._log = log
        self._zero = Instant(0)
        self._started = False
        self._counts: tuple[dict[int, int], ...] = ({}, {})

    def start(self, now: Instant) -> None:
        """See :class:`virtual_bus.faults.FateSource`."""
        self._zero = now
        self._started = True
        self._counts = ({}, {})
        self._source.start(now)
        self._source.struck_by = ""
        self._source.waited = 0

    def stop(self) -> None:
        """See :class:`virtual_bus.faults.FateSource`."""
        self._started = False
        self._source.stop()

    def fate(self, direction: Direction, can_id: int, now: Instant, extended: bool = False) -> Fate:
        """See :class:`virtual_bus.faults.FateSource`."""
        fate = self._source.fate(direction, can_id, now, extended)
        if not self._started:
            return fate
        key = can_id | EXTENDED_FLAG if extended else can_id
        counts = self._counts[direction]
        n = counts.get(key, 0)
        counts[key] = n + 1
        if fate is not _PASSED:
            self._note(fate, direction, key, n, now - self._zero)
        return fate

    def _note(self, fate: Fate, direction: Direction, key: int, n: int, at_ns: int) -> None:
        source, log = self._source, self._log
        dropped, delay = fate
        kind, waited = source.struck_by, source.waited
        source.struck_by = ""
        source.waited = 0
        if not kind:
            can_id = key & ~EXTENDED_FLAG
            in_order = source.keeps_order(direction, can_id, key != can_id)
            log.note(_DELAY, at_ns, direction, key, n, delay - waited, in_order)
            return
        code, parameter = KIND_CODES[kind], source.parameter
        if code == _REORDER:
            log.note(code, at_ns, direction, key, n, parameter, delay - waited - parameter)
            return
        copies = source.replacements(_NO_FRAME) if dropped else ()
        if copies:
            log.note(code, at_ns, direction, key, n, parameter, copies[0][1] - waited)
        else:
            log.note(code, at_ns, direction, key, n, NONE if code == _CORRUPTION else 0)

    def replacements(self, frame: Frame) -> Sequence[tuple[Frame, Duration]]:
        """See :class:`virtual_bus.faults.FateSource`."""
        return self._source.replacements(frame)

    def counts(self) -> dict[str, dict[str, int]]:
        """See :class:`virtual_bus.faults.FateSource`."""
        return self._source.counts()


_NO_FRAME = Frame(0)

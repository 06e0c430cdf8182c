"""What becomes of a frame, and who decides: a seeded injector, or the replay of a recorded run."""

from typing import Final, NamedTuple

from mypy_extensions import mypyc_attr

from drivers.timebase import Duration, Instant
from virtual_bus.bus.judge import LOST, Direction, Judge
from virtual_bus.faults.fault_log import AT_NODE, EXTENDED_FLAG, KIND_CODES, NONE, FaultLog
from virtual_bus.frame import Frame


class FrameFate(NamedTuple):
    """What becomes of a frame."""

    dropped: bool
    """It does not go on as it is; ``replacements`` says what does, if anything."""
    delay_ns: Duration
    """From the instant given to ``fate`` until it goes on; 0 if dropped."""


PASSED: Final = FrameFate(False, Duration(0))
DROPPED: Final = FrameFate(True, Duration(0))

_DELAY: Final = KIND_CODES["delay"]
_REORDER: Final = KIND_CODES["reorder"]
_CORRUPTION: Final = KIND_CODES["corruption"]
_NO_FRAME: Final = Frame(0)


@mypyc_attr(allow_interpreted_subclasses=True)
class FateSource(Judge):
    """A judge of frames that tells what it has done. Override all but ``fate`` and ``note``."""

    def __init__(self, log: FaultLog | None = None, node: int = 0) -> None:
        """``log``: takes an entry for every frame that does not just pass. ``node``: the drive at whose
        connection the frames are; 0 at the host's."""
        self.log = log
        self._place = node * AT_NODE
        self.struck_by = ""
        """The kind of fault that struck the last frame that was dropped or held out of order."""
        self.parameter = 0
        """What that fault drew, see :meth:`Special.parameter`."""
        self.waited = 0
        """How long the last frame that had to wait for one in front of it did so, ns."""

    def start(self, now: Instant) -> None:
        """Time zero of the plan is ``now``."""
        raise NotImplementedError

    def stop(self) -> None:
        """From here on every frame passes."""
        raise NotImplementedError

    def keeps_order(self, way: int, can_id: int, extended: bool) -> bool:
        """Whether a held frame of that kind waits for the one in front of it."""
        raise NotImplementedError

    def counts(self) -> dict[str, dict[str, int]]:
        """Frames by direction and by what befell them."""
        raise NotImplementedError

    def fate(self, direction: Direction, can_id: int, now: Instant, extended: bool = False) -> FrameFate:
        """As :meth:`Judge.hold`, in words."""
        held = self.hold(int(direction), can_id, now, extended)
        if held == 0:
            return PASSED
        return DROPPED if held == LOST else FrameFate(False, Duration(held))

    def note(self, log: FaultLog, way: int, key: int, n: int, at_ns: int, held: int) -> None:
        """Enter the last frame, the ``n``-th of ``key`` in its direction, for which ``hold`` gave ``held``.

        ``key``: its identifier, with EXTENDED_FLAG for an extended one.
        """
        kind, waited = self.struck_by, self.waited
        self.struck_by = ""
        self.waited = 0
        link = self._place + way
        if not kind:
            can_id = key & ~EXTENDED_FLAG
            log.note(_DELAY, at_ns, link, key, n, held - waited, self.keeps_order(way, can_id, key != can_id))
            return
        code = KIND_CODES[kind]
        if code == _REORDER:
            log.note(code, at_ns, link, key, n, self.parameter, held - waited - self.parameter)
            return
        copies = self.replacements(_NO_FRAME) if held == LOST else ()
        if copies:
            log.note(code, at_ns, link, key, n, self.parameter, copies[0][1] - waited)
        else:
            log.note(code, at_ns, link, key, n, NONE if code == _CORRUPTION else 0)

"""Who hears the frames of a segment at a port."""

from collections.abc import Callable

from mypy_extensions import mypyc_attr

from drivers.timebase import Instant
from virtual_bus.frame import Frame

OnFrame = Callable[[Frame, Instant], None]


@mypyc_attr(allow_interpreted_subclasses=True)
class Listener:
    """The owner of a port. This one ignores every frame, like a port that was detached."""

    def on_frame(self, frame: Frame, now: Instant) -> None:
        """Another port's frame ended at ``now``."""


NOBODY = Listener()


class _CallbackListener(Listener):
    """A function as a listener."""

    def __init__(self, callback: OnFrame) -> None:
        self._callback = callback

    def on_frame(self, frame: Frame, now: Instant) -> None:
        self._callback(frame, now)


def listener_of(owner: Listener | OnFrame) -> Listener:
    """``owner`` itself, or what calls it."""
    return owner if isinstance(owner, Listener) else _CallbackListener(owner)

"""Who hears the frames of a segment at a port."""

from collections.abc import Callable

from mypy_extensions import mypyc_attr

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.frame import Frame

OnFrame = Callable[[Frame, Instant], None]


@mypyc_attr(allow_interpreted_subclasses=True)
class Listener:
    """The owner of a port. This one ignores every frame, like a port that was detached."""

    def on_frame(self, frame: Frame, now: Instant) -> None:
        """Another port's frame ended at ``now``."""

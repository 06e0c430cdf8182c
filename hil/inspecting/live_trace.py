"""The frames of a bus as they come, for as long as somebody listens. Nothing is sent."""

from collections.abc import Callable, Generator
from typing import Final

import can

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant, MonotonicClock
from servobench.drivers.wire.adapters import BusSpec
from servobench.drivers.wire.frame_port import ERROR_FLAG, FramePort
from servobench.drivers.wire.message_port import MessagePort
from servobench.hil.inspecting.scanning import ScanPlan, open_to_look
from servobench.hil.reviewing.trace.frame_columns import LogFrame
from servobench.virtual_bus.bus.hub import HubBus

_LOOK_EVERY: Final = Duration(100 * NS_PER_MS)
"""So long Ctrl-C may wait on a silent bus; a reader does not see it."""


def live_frames(
    spec: BusSpec, bitrate_bit_s: int | None, stopped: Callable[[], bool], say: Callable[[str], None]
) -> Generator[LogFrame, None, None]:
    """Each frame with its stamp, ns since the listening began, until ``stopped``.

    An adapter that can listen only does; one that cannot acknowledges frames, as every node of a bus, and
    sends none. Raises BadInput, BusDown.
    """
    opened = open_to_look(ScanPlan(spec, bitrate_bit_s, Duration(0), passive=True), say)
    clock, bus = MonotonicClock(), opened.bus.bus
    try:
        if isinstance(bus, HubBus):
            bus.set_listen_only(True)
        port: FramePort = getattr(bus, "frame_port", None) or MessagePort(bus, clock, opened.bus.stamps)
        say(f"listening on {spec}; Ctrl-C ends it")
        began, number = clock.now(), 0
        while not stopped():
            try:
                frame = port.receive(Instant(clock.now() + _LOOK_EVERY))
            except (can.CanError, OSError) as error:
                raise BusDown(f"{spec} failed while it was listened to", str(error)) from error
            if frame is None:
                continue
            number += 1
            error_frame = frame.can_id >= ERROR_FLAG and not frame.extended
            yield LogFrame(
                number=number,
                at_ns=port.came_at - began,
                channel=str(spec),
                can_id=frame.can_id & ~ERROR_FLAG if error_frame else frame.can_id,
                data=frame.data,
                extended=frame.extended,
                remote=frame.remote,
                error=error_frame,
                sent="R",
            )
    finally:
        bus.shutdown()

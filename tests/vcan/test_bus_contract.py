"""The bus contract on the kernel's own virtual CAN interface, and that of echoes."""

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import can
import pytest

from servobench.drivers.timebase import NS_PER_US, Clock, MonotonicClock
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.drivers.wire.socketcan import StampedSocketcanBus
from tests.contract.bus_suite import BusSuite, OpenBus
from tests.contract.echo_suite import EchoSuite


class TestSocketcan(BusSuite):
    """All participants on one vcan interface."""

    marks_own_frames = False

    @pytest.fixture
    def open_bus(self, channel: str) -> Iterator[OpenBus]:
        with ExitStack() as stack:

            def open_one(**options: Any) -> can.BusABC:
                return stack.enter_context(
                    can.Bus(interface="socketcan", channel=channel, ignore_config=True, **options)
                )

            yield open_one


class TestStampedSocketcan(EchoSuite):
    """The bench's own bus: the kernel stamps a frame once for all who get it."""

    basis = EchoBasis.KERNEL
    stamps_differ_max_ns = 100 * NS_PER_US
    """Each socket maps it to the monotonic clock by comparisons of its own, between two system calls."""

    @pytest.fixture
    def clock(self) -> Clock:
        return MonotonicClock()

    @pytest.fixture
    def open_bus(self, channel: str) -> Iterator[OpenBus]:
        with ExitStack() as stack:

            def open_one(**options: Any) -> can.BusABC:
                return stack.enter_context(StampedSocketcanBus(channel, **options))

            yield open_one

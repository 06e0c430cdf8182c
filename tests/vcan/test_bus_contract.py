"""The bus contract on the kernel's own virtual CAN interface."""

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import can
import pytest

from tests.contract.bus_suite import BusSuite, OpenBus


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

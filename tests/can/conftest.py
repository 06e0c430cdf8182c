"""Tests on two CAN controllers of one bus, can0 and can1 (or what CAN0 and CAN1 name): skipped where they are
not up, a failure where they were promised."""

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.vcan.conftest import skip_unless_up

CHANNELS = os.environ.get("CAN0", "can0"), os.environ.get("CAN1", "can1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip this folder's tests without controllers, unless ``make test-can`` runs them."""
    skip_unless_up(items, Path(__file__).parent, CHANNELS, "SERVOBENCH_CAN")


@pytest.fixture
def channel() -> str:
    """The controller that the bench has."""
    return CHANNELS[0]


@pytest.fixture
def other() -> str:
    """The controller at the other end of the bus."""
    return CHANNELS[1]


@pytest.fixture
def ip_link(channel: str) -> Iterator[Callable[..., None]]:
    """``ip link set`` of the bench's controller; afterwards it is up, with ten frames in its queue."""
    if os.geteuid():
        pytest.skip("setting an interface needs root")

    def setting(*words: str) -> None:
        subprocess.run(["ip", "link", "set", channel, *words], check=True, timeout=60)

    yield setting
    setting("down")
    setting("up", "type", "can", "bitrate", "1000000", "restart-ms", "100", "listen-only", "off")
    setting("txqueuelen", "10")

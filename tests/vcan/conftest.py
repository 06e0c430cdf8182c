"""Tests on SocketCAN's vcan0: skipped where it is not up, a failure where it was promised."""

import os
from pathlib import Path

import pytest

CHANNEL = "vcan0"
IFF_UP = 1


def is_up(channel: str) -> bool:
    """Whether the kernel has the network interface ``channel``, and it is up."""
    flags = Path("/sys/class/net", channel, "flags")
    return flags.exists() and bool(int(flags.read_text(), 16) & IFF_UP)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip this folder's tests without vcan0, unless ``make test-vcan`` runs them."""
    if is_up(CHANNEL):
        return
    if os.environ.get("SERVOBENCH_VCAN") == "required":
        raise pytest.UsageError(f"{CHANNEL} is not up")
    here = Path(__file__).parent
    for item in items:
        if item.path.is_relative_to(here):
            item.add_marker(pytest.mark.skip(reason=f"{CHANNEL} is not up; make test-vcan brings its own"))


@pytest.fixture
def channel() -> str:
    """The virtual CAN interface of this machine."""
    return CHANNEL

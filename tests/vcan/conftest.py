"""Tests on SocketCAN's vcan0: skipped where it is not up, a failure where it was promised."""

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

CHANNEL = "vcan0"
IFF_UP = 1


def is_up(channel: str) -> bool:
    """Whether the kernel has the network interface ``channel``, and it is up."""
    flags = Path("/sys/class/net", channel, "flags")
    return flags.exists() and bool(int(flags.read_text(), 16) & IFF_UP)


def skip_unless_up(items: list[pytest.Item], folder: Path, channels: Sequence[str], promised: str) -> None:
    """Skip the tests of ``folder`` without its interfaces; raises UsageError if the variable ``promised`` of
    the environment says that they are there."""
    down = [channel for channel in channels if not is_up(channel)]
    if not down:
        return
    reason = f"{' and '.join(down)} not up; make test-{folder.name} brings its own"
    if os.environ.get(promised) == "required":
        raise pytest.UsageError(reason)
    for item in items:
        if item.path.is_relative_to(folder):
            item.add_marker(pytest.mark.skip(reason=reason))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip this folder's tests without vcan0, unless ``make test-vcan`` runs them."""
    skip_unless_up(items, Path(__file__).parent, [CHANNEL], "SERVOBENCH_VCAN")


@pytest.fixture
def channel() -> str:
    """The virtual CAN interface of this machine."""
    return CHANNEL

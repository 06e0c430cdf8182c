"""Hubs of one test."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.bus.hub_place import HubPlace


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Hubs of this test only; their brokers leave by themselves."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


@pytest.fixture
def place(runtime: Path) -> HubPlace:  # noqa: ARG001
    return HubPlace("bench")


@pytest.fixture
def buses(runtime: Path) -> Iterator[list[HubBus]]:  # noqa: ARG001
    opened: list[HubBus] = []
    yield opened
    for bus in opened:
        bus.shutdown()

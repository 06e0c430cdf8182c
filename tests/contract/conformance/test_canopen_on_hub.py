"""The independent master on the hub."""

import os
from typing import Any

import pytest

from tests.contract.conformance.master_suite import MasterSuite

pytestmark = pytest.mark.xdist_group("real time")


class TestOnTheHub(MasterSuite):
    """Master and device are processes of their own."""

    @pytest.fixture(autouse=True)
    def _runtime(self, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
        # short: the path of a socket has its limit
        runtime = tmp_path_factory.mktemp("hub")
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))

    @pytest.fixture
    def bus_spec(self) -> str:
        return f"hub:master-{os.getpid()}"

    @pytest.fixture
    def connection(self, bus_spec: str) -> dict[str, Any]:
        return {"interface": "hub", "channel": bus_spec.partition(":")[2], "bitrate": 1_000_000}

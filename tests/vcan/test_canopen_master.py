"""The independent master on the kernel's virtual CAN interface."""

from typing import Any

import pytest

from tests.contract.conformance.master_suite import MasterSuite


class TestOnVcan(MasterSuite):
    """Master and device are processes of their own."""

    @pytest.fixture
    def bus_spec(self, channel: str) -> str:
        return f"socketcan:{channel}"

    @pytest.fixture
    def connection(self, channel: str) -> dict[str, Any]:
        return {"interface": "socketcan", "channel": channel}

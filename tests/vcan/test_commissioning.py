"""``hil commission`` on the kernel's virtual CAN interface."""

import pytest

from tests.scenario.commission_suite import CommissionSuite


class TestOnVcan(CommissionSuite):
    """The same as on the hub."""

    @pytest.fixture
    def bus_spec(self, channel: str) -> str:
        return f"socketcan:{channel}"

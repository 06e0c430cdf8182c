"""``hil commission`` on the kernel's virtual CAN interface."""

import pytest

from tests.scenario.commission_suite import CommissionSuite
from tests.stillness import EMULATED


@pytest.mark.skipif(EMULATED, reason="takes an emulated machine two minutes, a busy one ten")
class TestOnVcan(CommissionSuite):
    """The same as on the hub."""

    @pytest.fixture
    def bus_spec(self, channel: str) -> str:
        return f"socketcan:{channel}"

"""``hil run`` and ``hil simulate`` as two processes on the hub."""

import pytest

from tests.scenario.two_process_suite import TwoProcesses

pytestmark = pytest.mark.xdist_group("real time")


@pytest.mark.servo_bus("hub")
class TestOnHub(TwoProcesses):
    """On a hub of its own, so that no other test's frames are heard."""

"""The contracts of a bus and of its echoes, those of vcan's own tests, on a controller's driver: all
participants on the bench's interface, whose echo the driver gives once the frame was on the wire."""

from tests.vcan import test_bus_contract as on_vcan


class TestControllerBus(on_vcan.TestSocketcan):
    """python-can's class."""


class TestStampedControllerBus(on_vcan.TestStampedSocketcan):
    """The bench's own."""

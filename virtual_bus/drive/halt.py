"""Halt: bit 8 of the controlword and 605Dh, in the profile modes and homing."""

from drivers.cia402.profile import Control
from virtual_bus.drive.axis import SimulatedAxis


class Halt:
    """Whether a halt is commanded, and how far it is."""

    def __init__(self, axis: SimulatedAxis) -> None:
        self._axis = axis
        self.active = False

    def begin(self, controlword: int, slow_down_rad_s2: float) -> None:
        """A mode begins; a halt may be there already."""
        self.active = False
        self.receive(controlword, slow_down_rad_s2)

    def receive(self, controlword: int, slow_down_rad_s2: float) -> bool:
        """Begin the stop, or end the halt: true then, and the mode goes on from where the shaft is."""
        wanted = controlword & Control.HALT != 0
        if wanted == self.active:
            return False
        self.active = wanted
        if wanted:
            self._axis.stop(self._axis.halt_rad_s2(slow_down_rad_s2))
        return not wanted

    @property
    def standing(self) -> bool:
        """The shaft has come to rest: bit 10 of the statusword during a halt."""
        return self._axis.rests()

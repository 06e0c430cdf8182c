"""Several drives of a bench are told to stop before the first of them is waited for."""

from collections.abc import Sequence
from contextlib import suppress

from drivers.cia402.servo import ServoDrive
from drivers.errors import PeerFault


def stop_all(drives: Sequence[ServoDrive]) -> None:
    """A quick stop to each by RPDO, then by SDO; what fails is tried again, and told, by its release.

    A silent drive holds up the next one that is asked; a drive whose commands cease while another is brought
    to rest would call that a fault.
    """
    for asking in (False, True):
        for drive in drives:
            with suppress(PeerFault):
                drive.stop(asking=asking)

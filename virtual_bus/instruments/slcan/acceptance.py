"""The acceptance filter of an SJA1000, which the commands M, m and W of a Lawicel adapter set.

Source: Philips SJA1000 data sheet (January 2000), 6.4.15: four bytes of acceptance code, four of mask; a mask
bit of 1 means "does not matter". In dual mode each half is a filter of its own, in single mode all four bytes
are one. The data bytes that the filters can also look at are left out: here they never matter.
"""

from dataclasses import dataclass

from virtual_bus.frame import Frame

_ALL = 0xFFFF_FFFF


@dataclass(slots=True)
class AcceptanceFilter:
    """Lets everything pass at first."""

    code: int = 0
    """AC0 in the highest byte, AC3 in the lowest."""
    mask: int = _ALL
    single: bool = False

    def passes(self, frame: Frame) -> bool:
        """Whether the controller takes ``frame``."""
        if self.mask == _ALL:
            return True
        if self.single:
            if frame.extended:
                seen, width = frame.can_id << 3 | frame.remote << 2, 0xFFFF_FFFC
            else:
                seen, width = frame.can_id << 21 | frame.remote << 20, 0xFFF0_0000
            return not (self.code ^ seen) & ~self.mask & width
        if frame.extended:
            seen, width = frame.can_id >> 13, 0xFFFF
        else:
            seen, width = frame.can_id << 5 | frame.remote << 4, 0xFFF0
        return any(
            not (self.code >> shift ^ seen) & ~(self.mask >> shift) & width & 0xFFFF for shift in (16, 0)
        )

"""The homing methods of CiA 402-2 as a table.

A switch is a stretch of the axis in which it is active; the ends of the stretch are its edges:

                    left edge          right edge
    ________________|==================|________________    -> positive
      1, 17         the negative limit switch: active up to its right edge; left towards positive
      2, 18         the positive limit switch: active from its left edge on; left towards negative
      3, 4          home switch active from its left edge to the positive end of the axis
      5, 6          home switch active up to its right edge
      7..10         home switch in between, search begins towards positive, turns at the limit switch
      11..14        the same towards negative

Each method finds an edge, crosses it slowly in a given direction, and the home is there (17..30) or at the
next index pulse in that direction (1..14). 33 and 34 go to the next index pulse; 35 and 37 stay.
"""

from enum import Enum
from typing import Final, NamedTuple


class Sensor(Enum):
    """Which switch a method looks for."""

    NEGATIVE_LIMIT = 0
    POSITIVE_LIMIT = 1
    HOME = 2


class SwitchEdge(Enum):
    """An end of the stretch in which a switch is active."""

    LEFT = "left"
    RIGHT = "right"


class HomingMethod(NamedTuple):
    """How a home is found; no ``sensor`` and no ``pulse``: it is where the shaft stands."""

    sensor: Sensor | None
    edge: SwitchEdge
    across: int
    """Direction, +1 or -1, in which the edge is crossed at last, or the index pulse is looked for."""
    start_inactive: int
    """Direction in which the search begins beside the switch."""
    start_active: int
    """And on it."""
    pulse: bool


_NEGATIVE, _POSITIVE, _HOME = Sensor.NEGATIVE_LIMIT, Sensor.POSITIVE_LIMIT, Sensor.HOME
_LEFT, _RIGHT = SwitchEdge.LEFT, SwitchEdge.RIGHT

_WITH_INDEX: Final[dict[int, HomingMethod]] = {
    1: HomingMethod(_NEGATIVE, _RIGHT, +1, -1, +1, True),
    2: HomingMethod(_POSITIVE, _LEFT, -1, +1, -1, True),
    3: HomingMethod(_HOME, _LEFT, -1, +1, -1, True),
    4: HomingMethod(_HOME, _LEFT, +1, +1, -1, True),
    5: HomingMethod(_HOME, _RIGHT, +1, -1, +1, True),
    6: HomingMethod(_HOME, _RIGHT, -1, -1, +1, True),
    7: HomingMethod(_HOME, _LEFT, -1, +1, -1, True),
    8: HomingMethod(_HOME, _LEFT, +1, +1, -1, True),
    9: HomingMethod(_HOME, _RIGHT, -1, +1, +1, True),
    10: HomingMethod(_HOME, _RIGHT, +1, +1, +1, True),
    11: HomingMethod(_HOME, _RIGHT, +1, -1, +1, True),
    12: HomingMethod(_HOME, _RIGHT, -1, -1, +1, True),
    13: HomingMethod(_HOME, _LEFT, +1, -1, -1, True),
    14: HomingMethod(_HOME, _LEFT, -1, -1, -1, True),
}
_INDEX_OFFSET: Final = 16
"""Methods 17..30 are 1..14 without the index pulse."""

HOMING_METHODS: Final[dict[int, HomingMethod]] = {
    **_WITH_INDEX,
    **{number + _INDEX_OFFSET: method._replace(pulse=False) for number, method in _WITH_INDEX.items()},
    33: HomingMethod(None, _LEFT, -1, 0, 0, True),
    34: HomingMethod(None, _LEFT, +1, 0, 0, True),
    35: HomingMethod(None, _LEFT, 0, 0, 0, False),
    37: HomingMethod(None, _LEFT, 0, 0, 0, False),
}
"""Every method that the drive has; 60E3h and the range of 6098h follow from it."""

TURNS_AT_LIMIT: Final = frozenset({*range(7, 15), *range(23, 31)})
"""Methods whose search turns round at a limit switch; for the others that is the end of it."""

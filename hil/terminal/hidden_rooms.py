"""Whether the packages of servobench are those that Python finds under their names.

``drivers`` and ``design`` are names that a user's folder may well bear; on the path in front of ours it is
imported instead. Nothing of these packages is imported here, before that is known.
"""

from importlib.util import find_spec
from pathlib import Path

ROOMS = ("design", "drivers", "virtual_bus")
ROOT = Path(__file__).resolve().parents[2]


def hidden_room(root: Path = ROOT) -> str | None:
    """What to tell the user of a folder or file that hides a package below ``root``; None: nothing does."""
    for room in ROOMS:
        spec = find_spec(room)
        places = [*(spec.submodule_search_locations or ()), spec.origin] if spec else [None]
        place = places[0]
        if place is None or Path(place).resolve() != root / room:
            return (
                f"{place}: hides the package {room!r} of servobench, expected {root / room}; rename it, "
                "or take its folder off Python's path (PYTHONPATH, the current folder of python -m, or that "
                "of a test module)"
            )
    return None

"""A bench and what befalls it, as a drawn plan has them."""

from dataclasses import dataclass, field
from typing import Any, Final

from tests.truth.adapter import Adapter
from tests.truth.standstills import Standstills

PERIOD_US: Final = 1000


@dataclass(slots=True)
class DrawnPlan:
    """A bench and what befalls it, as its features have made it."""

    seed: int
    features: list[str] = field(default_factory=list)
    """Those that are in it, by name."""
    words: list[str] = field(default_factory=list)
    """What each of them says."""
    axes: int = 1
    period_us: int = PERIOD_US
    deadline_us: int = 2 * PERIOD_US
    horizon_periods: int = 20
    sync: str = "own"
    producer_period_us: int = PERIOD_US
    producer_jitter_us: int = 0
    actuation: str = "on_arrival"
    readback: str = "sync"
    position_every: int = 1
    has_stamps: bool = True
    simulation: dict[str, Any] = field(default_factory=dict)
    """How all drives stamp and act on SYNCs, as the table ``simulation`` of a bench file."""
    stamp_resolution_us: float = 1.0
    """What the bench is told of the stamps."""
    clock_starts_at_us: int | None = None
    drifts_ppm: tuple[float, ...] = (0.0, 0.0, 0.0)
    adapter: Adapter | None = None
    background: list[dict[str, Any]] = field(default_factory=list)
    faults: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    reading_delay_us: float = 0.0
    """The longest that faults may hold a reading."""
    sync_jitter_us: float = 0.0
    """The longest that faults may hold a SYNC behind its echo."""
    sync_wait_us: float = 0.0
    """As that, in front of its echo."""
    standstills: Standstills | None = None
    """Of the process of each drive."""

    @property
    def heard(self) -> bool:
        """Whether the loop makes no SYNC itself."""
        return self.sync != "own"

    @property
    def delays_are_short(self) -> bool:
        """Whether delays stay below two periods: then doubt is rare without stamps too."""
        return self.reading_delay_us < 2 * self.period_us

    @property
    def stamps_are_fine(self) -> bool:
        """Whether the steps of the stamps say which SYNC they are of; else order places the readings."""
        steps_us = (self.stamp_resolution_us, self.simulation.get("stamp_resolution_us", 1))
        return self.has_stamps and 10 * max(steps_us) <= self.period_us

    def add(self, kind: str, **keys: Any) -> None:
        """One more fault, as in a fault plan."""
        self.faults.setdefault(kind, []).append(keys)

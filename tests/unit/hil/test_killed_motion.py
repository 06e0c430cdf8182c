"""``hil jog``, ``homing``, ``brake``, ``phase`` and ``tune`` whose host ends by kill -9 before any of its
frames: the drive comes to rest by itself, and ``hil restore`` puts everything back to the byte.
"""

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.commissioning.steps_brake import brake_limits, brake_steps
from servobench.hil.commissioning.steps_tune import TuneRequest, tune_limits, tune_steps
from servobench.hil.execution.world import World
from servobench.hil.restoring.journal import read_journal
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.draws import few_of
from tests.motors import LING
from tests.parameters.roundtrip import Killed
from tests.unit.hil.test_brake_and_io import braked
from tests.unit.hil.test_manual_motion import Moved, homed, jogged, moved
from tests.unit.hil.test_phase import drive, phased, undone

KILLS: Final = 12
FIRST: Final = 200
"""Before it nothing is written."""


class MortalLink(BusLink):
    """Ends the host before its frame number ``dies_at``: nothing of it acts any more."""

    sent = 0
    dies_at = math.inf

    def send(self, can_id: int, data: bytes, /) -> Instant:
        self.sent += 1
        if self.sent >= self.dies_at:
            raise Killed
        return super().send(can_id, data)


def _jog(out: Path, servo: SimulatedServo, **how: Any) -> Moved:
    return jogged(out, 1.0, servo=servo, **how)


def _homing(out: Path, servo: SimulatedServo, **how: Any) -> Moved:
    return homed(out, 34, servo=servo, **how)


def _brake(out: Path, servo: SimulatedServo, **how: Any) -> Moved:
    steps = lambda: brake_steps(1.0)  # noqa: E731
    return moved(out, steps, brake_limits(30.0), purpose="brake", servo=servo, **how)


def _phase(out: Path, servo: SimulatedServo, **how: Any) -> Moved:
    return phased(out, servo, store=True, **how)


def _tune(out: Path, servo: SimulatedServo, **how: Any) -> Moved:
    steps = lambda: tune_steps(TuneRequest(bandwidth_hz=45.0, apply=True))  # noqa: E731
    limits = tune_limits(600.0, 50.0, 40.0)
    return moved(out, steps, limits, purpose="tune", servo=servo, store=True, **how)


MOTIONS: Final[dict[str, tuple[Callable[..., Moved], Callable[[], SimulatedServo], int]]] = {
    "homing": (_homing, lambda: SimulatedServo(1, LING), 4290),
    "phase": (_phase, lambda: drive(offset_rad=1.9, lines_swapped=True, pole_pairs_set=3), 4790),
    "jog": (_jog, lambda: SimulatedServo(1, LING), 2040),
    "brake": (_brake, braked, 6180),
    "tune": (_tune, lambda: SimulatedServo(1, LING, DriveParameters(gain_objects=True)), 33820),
}
"""Each with a drive for it, and as many frames as its host sends; the last ones store or put back."""


def killed(out: Path, name: str, dies_at: float) -> tuple[Moved, SimulatedServo, MortalLink]:
    motion, make, _ = MOTIONS[name]
    servo, links = make(), list[MortalLink]()

    def through(world: World) -> World:
        link = MortalLink(world.link.bus, world.clock, StampSource.MONOTONIC, "simulated")
        link.dies_at = dies_at
        links.append(link)
        return replace(world, link=link)

    return motion(out, servo, through=through), servo, links[0]


def drawn() -> Iterator[tuple[str, int]]:
    """Yield motions and frames before which their hosts end: one of each part of each, the middle first."""
    draw = random.Random(44)
    for part in sorted(range(KILLS), key=lambda part: abs(part - KILLS // 2 + 1)):
        for name, (_, _, frames) in MOTIONS.items():
            yield name, max(FIRST, 1 + part * frames // KILLS + draw.randrange(frames // KILLS))


@pytest.mark.parametrize(("name", "at"), few_of([*drawn()], 2))
def test_a_host_that_is_killed_leaves_a_drive_at_rest_and_a_journal_that_undoes_it(
    tmp_path: Path, name: str, at: int
) -> None:
    done, servo, link = killed(tmp_path, name, at)
    assert link.sent >= at, "it ended by itself"
    assert not any(done.tap.enabled[-500:])
    assert max(done.tap.turns[-500:]) - min(done.tap.turns[-500:]) < 1e-3
    journal = tmp_path / "journal.jsonl"
    waits = journal.exists() and not read_journal(journal).restored
    assert (undone(tmp_path, servo) if waits else done.after) == done.before

"""A drive whose torque rises slowly, and which cannot be set steeper, is commissioned without overshoot."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from servobench.hil.commissioning import commission
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.unknown_drive import nameplate_of
from tests.rehearsals.rehearsal import made_sheet, rehearsed
from tests.scenario.foreign_node import put_on_the_bus
from tests.scenario.test_drive_follows import Shaft

LIMIT_RPM = 0.5 * nameplate_of(LING2012.parameters)["rating"]["speed_rpm"]
"""Of the default nameplate; the host stops a shaft that is 30 % faster."""


def test_the_shaft_stays_below_the_limit_of_speed(tmp_path: Path) -> None:
    """6087h = 50000 is refused with 06090031h; 1000 is the greatest: the rated torque in a second."""
    drives: list[SimulatedServo] = []
    shaft = Shaft(drives)

    @contextmanager
    def with_shaft(plan: WorldPlan, devices: Sequence[Any]) -> Iterator[World]:
        with open_world(plan, devices) as world:
            put_on_the_bus(world, shaft)
            yield world

    sheet = made_sheet(["6087h is 1000 at most"], tmp_path)
    with mock.patch.object(commission, "open_world", with_shaft):
        result = rehearsed(sheet, tmp_path, last_step="mechanics", change=drives.append)
    assert (result.reason, result.not_done) == ("", {})
    fastest = abs(shaft.rpm(1e6)).max()
    assert 0.5 * LIMIT_RPM < fastest <= LIMIT_RPM

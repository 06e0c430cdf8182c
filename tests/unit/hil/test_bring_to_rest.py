"""Before a drive is put back it is brought to rest: what it is told, when, and what counts as rest."""

from collections.abc import Callable

import pytest

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import Duration
from servobench.hil.restoring.restore import bring_to_rest
from tests.unit.hil.scripted_drive import (
    DISABLE_VOLTAGE,
    DISABLED,
    ENABLED,
    FAULT,
    NOT_READY,
    QUICK_STOP,
    REACTING,
    READY,
    STOPPING,
    SWITCHED_ON,
    ScriptedDrive,
    on_a_bus,
)


def brought(drive: ScriptedDrive) -> float:
    """How long it took, ms."""
    with on_a_bus(drive) as (world, network):
        bring_to_rest(RemoteObjects(network, 1))
        return world.clock.now() / 1e6


@pytest.mark.parametrize("word", [DISABLED, READY, SWITCHED_ON, FAULT])
def test_one_that_is_out_of_the_way_is_looked_at_and_disabled(word: int) -> None:
    drive = ScriptedDrive(lambda _drive: word)
    assert brought(drive) == pytest.approx(3 * 20.0, abs=3.0)
    assert drive.told == [DISABLE_VOLTAGE]
    assert drive.looks == 4, "three without a change follow the first"


def test_an_enabled_one_is_told_to_stop_until_it_stands_still() -> None:
    drive = ScriptedDrive(
        lambda drive: ENABLED if drive.looks <= 2 else STOPPING,
        lambda drive: min(drive.places, 6),
    )
    brought(drive)
    assert drive.told == [QUICK_STOP] * 9 + [DISABLE_VOLTAGE]
    assert drive.told_ms[0] < 1.0
    assert drive.places == 6 + 3


def test_three_readings_are_in_a_row() -> None:
    """It moves by a unit after two."""
    drive = ScriptedDrive(lambda _drive: STOPPING, lambda drive: int(drive.places > 3))
    brought(drive)
    assert drive.places == 4 + 3


@pytest.mark.parametrize(
    ("word", "place"),
    [
        (ENABLED, lambda _drive: 0),
        (REACTING, lambda _drive: 0),
        (NOT_READY, lambda _drive: 0),
        (STOPPING, lambda drive: drive.places),
        (DISABLED, lambda drive: -drive.places),
        (STOPPING, lambda _drive: None),
    ],
    ids=["enabled", "reacting", "not ready", "turning", "coasting", "turning perhaps"],
)
def test_one_that_does_not_come_to_rest_keeps_its_torque(
    word: int, place: Callable[[ScriptedDrive], int | None]
) -> None:
    drive = ScriptedDrive(lambda _drive: word, place)
    with pytest.raises(PeerFault, match="node 1 was not brought to rest") as fault:
        brought(drive)
    assert fault.value.evidence == f"statusword {word:04X}h"
    assert drive.now_ms == pytest.approx(5000.0, abs=25.0)
    assert set(drive.told) == ({QUICK_STOP} if word in (ENABLED, STOPPING) else set())


def test_one_without_a_position_is_at_rest_when_it_has_disabled_itself() -> None:
    drive = ScriptedDrive(lambda drive: STOPPING if drive.looks < 6 else DISABLED, lambda _drive: None)
    brought(drive)
    assert drive.told == [QUICK_STOP] * 5 + [DISABLE_VOLTAGE]
    assert drive.looks == 5 + 3


def test_one_without_a_position_that_is_disabled_already_is_looked_at_three_times() -> None:
    drive = ScriptedDrive(lambda _drive: DISABLED, lambda _drive: None)
    brought(drive)
    assert drive.told == [DISABLE_VOLTAGE]
    assert drive.looks == 3


def test_a_limit_of_no_time_tells_the_drive_nothing() -> None:
    drive = ScriptedDrive(lambda _drive: DISABLED)
    with on_a_bus(drive) as (_, network), pytest.raises(PeerFault, match="was not brought to rest"):
        bring_to_rest(RemoteObjects(network, 1), Duration(0))
    assert (drive.looks, drive.told) == (1, []), "its statusword, for the error"

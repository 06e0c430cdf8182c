"""What a bench tells its drives, and which drive a data sheet is for."""

from pathlib import Path

import pytest

from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.assembly import loop_timing
from servobench.hil.execution.drive_session import drive_settings, identity_notes
from tests.unit.drivers.eds_maker import four_pdos, sheet

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "ling2012.toml"
MADE = Identity("made", 0x123, 7, 0, 0, 0x20192)


@pytest.mark.parametrize(
    ("vendor", "notes"),
    [
        (0x123, []),
        (0, []),
        (0x99, ["the data sheet is for vendor 00000123h, the drive is 00000099h"]),
    ],
)
def test_another_drive_than_the_sheets_is_told(vendor: int, notes: list[str]) -> None:
    assert identity_notes(MADE._replace(vendor=vendor), sheet(four_pdos())) == notes


@pytest.mark.parametrize(
    ("dropouts_max", "heartbeat_timeout_ms", "timeout_ms"),
    [(100, 150, 100), (5, 150, 50), (1000, 150, 150), (1000, 2000, 1000)],
)
def test_as_many_commands_may_be_lost_as_readings(
    dropouts_max: int, heartbeat_timeout_ms: int, timeout_ms: int
) -> None:
    config = load_bench(EXAMPLE)
    limits = config.drive["axis1"].limits
    drive = config.drive["axis1"].model_copy(
        update={"limits": limits.model_copy(update={"dropouts_consecutive_max": dropouts_max})}
    )
    host = config.host.model_copy(update={"heartbeat_timeout_ms": heartbeat_timeout_ms})
    config = config.model_copy(update={"drive": {"axis1": drive}, "host": host})
    settings = drive_settings(config, "axis1", loop_timing(config), None)
    assert settings.command_timeout_ms == timeout_ms
    assert settings.scale == ScaleOverride()

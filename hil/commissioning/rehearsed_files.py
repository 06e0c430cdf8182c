"""Files that accompany the bench of a commissioned drive: its data sheet, and its rehearsed drive."""

import shutil
from pathlib import Path
from typing import Any, Final

from servobench.hil.commissioning.request import CommissionRequest
from servobench.hil.configuration.toml_text import toml_text
from servobench.hil.rows.run_files import BENCH_FILE

_SHEET: Final = "data-sheet"
"""The drive's, with its original suffix."""
_REHEARSED_SHEET: Final = "rehearsed"
"""The simulated drive's, if it was commissioned with another one."""
_REHEARSED_MOTOR_FILE: Final = "rehearsed-motor.toml"
_BITRATE_BIT_S: Final = 1_000_000
"""The default of ``--bitrate``."""


def copied_files(request: CommissionRequest) -> dict[str, str]:
    """Copy the data sheets named by the bench next to it; return the other files to write, by name."""
    rehearsal = request.rehearsal
    for sheet, name in (
        (request.eds, sheet_name(request)),
        (None if rehearsal is None else rehearsal.eds, _rehearsed_name(request)),
    ):
        if sheet is not None and not ((request.out / name).exists() and sheet.samefile(request.out / name)):
            shutil.copyfile(sheet, request.out / name)
    if rehearsal is None or rehearsal.eds is None:
        return {}
    return {
        _REHEARSED_MOTOR_FILE: "# The motor on the simulated drive's shaft.\n\n"
        + toml_text(rehearsal.motor.tables)
    }


def sheet_name(request: CommissionRequest) -> str:
    """Return the name of the copy of the drive's data sheet; empty without one."""
    return "" if request.eds is None else f"{_SHEET}{request.eds.suffix}"


def _rehearsed_name(request: CommissionRequest) -> str:
    eds = None if request.rehearsal is None else request.rehearsal.eds
    if eds is None or eds == request.eds:
        return sheet_name(request)
    return f"{_REHEARSED_SHEET}{eds.suffix}"


def simulation_table(request: CommissionRequest) -> dict[str, Any]:
    """Return the rehearsed drive as a bench table."""
    rehearsal = request.rehearsal
    if rehearsal is None:
        return {}
    if rehearsal.eds is None:
        return {"rehearse": rehearsal.seed or 0}
    return {"eds": _rehearsed_name(request), "motor": _REHEARSED_MOTOR_FILE}


def ways_to_run(request: CommissionRequest, folder: Path) -> list[str]:
    """Return commands to run the bench in ``folder`` with its rehearsed drive: as it is, and with the drive
    in another process; empty for a real drive."""
    rehearsal = request.rehearsal
    if rehearsal is None:
        return []
    rate = request.bitrate_bit_s
    shared = f"--bus hub:bench --node {request.node}{'' if rate == _BITRATE_BIT_S else f' --bitrate {rate}'}"
    if rehearsal.eds is None:
        drive = f"hil rehearse {shared} --seed {rehearsal.seed or 0}"
    else:
        sheet, motor = folder / _rehearsed_name(request), folder / _REHEARSED_MOTOR_FILE
        drive = f"hil simulate {shared} --eds {sheet} --motor {motor}"
    bench = folder / BENCH_FILE
    return [
        f"With the rehearsed drive beside it, in simulated time: hil run {bench}",
        f"With it in another process, on a hub or on vcan: {drive}",
        f"and then: hil run {bench} --bus hub:bench",
    ]

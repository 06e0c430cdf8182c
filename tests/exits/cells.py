"""The cells of the table: what befalls whom, in which phase of a run, on which bus."""

from typing import Final, NamedTuple

HUB, SIMULATED = "hub", "simulated"
HOST, LOGGER, BROKER, DRIVE, DISK = VICTIMS = ("host", "logger", "broker", "drive", "disk")
KILL, STOP, TERMINATE, FULL, SLOW = DEEDS = ("kill", "stop", "terminate", "full", "slow")
CONNECTING, RUNNING, STOPPING, STOPPED = "connecting", "running", "stopping", "stopped"
PHASES: Final = (CONNECTING, "configuring", "calibrating", "enabling", RUNNING, STOPPING, STOPPED)
"""As a run tells them; "stopped": all drives are let go, and the recording is closed."""

_PROGRAMS: Final = {HUB: (HOST, LOGGER, BROKER, DRIVE), SIMULATED: (HOST, LOGGER)}
"""On the simulated bus the drive is in the host's process."""


class Cell(NamedTuple):
    """One run."""

    bus: str
    victim: str
    deed: str
    phase: str
    mode: str = "cst"
    """In which the drive is run."""

    def __str__(self) -> str:
        return " ".join(self)


CELLS: Final = tuple(
    Cell(bus, victim, deed, phase)
    for bus, programs in _PROGRAMS.items()
    for victim, deeds in (
        *[(program, (KILL, STOP, TERMINATE)) for program in programs],
        (DISK, (FULL, SLOW)),
    )
    for deed in deeds
    for phase in PHASES
) + tuple(
    Cell(HUB, victim, deed, phase, mode)
    for mode in ("csv", "csp")
    for victim in (HOST, BROKER, DRIVE)
    for deed in (KILL, STOP, TERMINATE)
    for phase in ("enabling", RUNNING, STOPPING)
)
"""What the drive is given matters while it is enabled, to those who move it."""

_STATUSES: Final = {
    (HOST, KILL): (6,),
    (HOST, STOP): (3, 6),
    (HOST, TERMINATE): (130,),
    (LOGGER, KILL): (5,),
    (LOGGER, STOP): (0,),
    (LOGGER, TERMINATE): (0,),
    (BROKER, KILL): (3,),
    (BROKER, STOP): (3,),
    (BROKER, TERMINATE): (3,),
    (DRIVE, KILL): (3,),
    (DRIVE, STOP): (3,),
    (DRIVE, TERMINATE): (3,),
    (DISK, FULL): (5,),
    (DISK, SLOW): (0,),
}
"""Of a run that turns the shaft when it happens; of a host that is killed, what its logger comes to."""
_SURVIVED: Final = {(HOST, STOP), (BROKER, STOP), (DRIVE, STOP)}
"""A run may go on after it, before a drive is enabled."""


def statuses(cell: Cell) -> tuple[int, ...]:
    """With which a run may end that this befalls."""
    rule = _STATUSES[cell.victim, cell.deed]
    early = cell.phase not in (RUNNING, STOPPING, STOPPED)
    if cell.bus == SIMULATED and early and (cell.victim, cell.deed) == (LOGGER, TERMINATE):
        return (0, 5)  # there it still starts, and does not refuse the signal yet
    over = cell.phase == STOPPED and cell.victim in (BROKER, DRIVE)
    late = cell.phase in (STOPPING, STOPPED) and cell.deed in (STOP, TERMINATE)
    survived = early and (cell.victim, cell.deed) in _SURVIVED
    in_no_time = cell.bus == SIMULATED and cell.deed == STOP
    return (0, *rule) if over or late or survived or in_no_time else rule

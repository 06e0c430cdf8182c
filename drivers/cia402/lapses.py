"""Checks that a drive left alone for a while still has its set-up."""

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.pdo import differences
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant


def lapses(drive: ServoDrive, heartbeat_ms: int) -> list[str]:
    """Say where a drive is no longer as ``configure`` left it: NMT state, watch over the host, PDOs.

    ``heartbeat_ms``: its heartbeat period; two of them are waited for. RuntimeError before ``configure``,
    NoAnswer if it is gone.
    """
    if drive.plan is None:
        raise RuntimeError(f"{drive.name} was not configured")
    texts = []
    if drive.error_control.told:
        state = _told_state(drive, Duration(2 * heartbeat_ms * NS_PER_MS))
        if state is not NmtState.OPERATIONAL:
            texts.append(f"its NMT state is {'not told' if state is None else state.name}")
    texts += drive.error_control.lapses()
    for pdo in drive.plan:
        texts += differences(drive.objects, pdo)
    return texts


def _told_state(drive: ServoDrive, patience: Duration) -> NmtState | None:
    """Return the next NMT state that the drive reports; None if none comes in time."""
    network, status = drive.network, drive.status
    asked_at = network.clock.now()
    until = Instant(asked_at + patience)
    while network.pump_one(until):
        if status.heartbeat_at is not None and status.heartbeat_at >= asked_at:
            return status.state
    return None

"""Lapses of host and drive during a commissioning: no sign of life for too long, a set-up that is gone.

Faults that an exercise itself may cause, and that pass: they are reset before the next attempt.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final, NamedTuple

from servobench.drivers.canopen.error_codes import HEARTBEAT_ERROR
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.canopen.pdo import differences
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import DriveInFault, PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant


class HostStoodStill(PeerFault):
    """The drive considered the host lost, and stopped: measurements meanwhile are worthless."""


class HostGaps:
    """Gaps of the attempts at a step, one after the other."""

    def __init__(self, network: CanopenNetwork, borne_ms: int) -> None:
        """``borne_ms``: silence of the host that the drive tolerates."""
        self._signs = network.life_signs
        self._borne_ms = borne_ms
        self._longest_ns = 0

    def begin(self) -> None:
        """Begin an attempt."""
        self._longest_ns = self._signs.longest_gap_ns = Duration(0)

    @contextmanager
    def while_enabled(self) -> Iterator[None]:
        """Inside, gaps count that a drive at rest would not mind; raises HostStoodStill at the end if there
        was one."""
        self._longest_ns = max(self._longest_ns, self._signs.longest_gap_ns)
        self._signs.longest_gap_ns = Duration(0)
        yield
        if self._too_long(self._signs.longest_gap_ns):
            raise self._stood_still(self._signs.longest_gap_ns)

    def cause_of(self, failure: PeerFault | None) -> PeerFault | None:
        """Return the cause of a failed attempt: the host's own silence takes precedence."""
        longest_ns = max(self._longest_ns, self._signs.longest_gap_ns)
        if failure is None or isinstance(failure, HostStoodStill) or not self._too_long(longest_ns):
            return failure
        return self._stood_still(longest_ns, f"; then: {failure}")

    def _too_long(self, gap_ns: int) -> bool:
        return gap_ns > self._borne_ms * NS_PER_MS

    def _stood_still(self, gap_ns: int, then: str = "") -> HostStoodStill:
        return HostStoodStill(
            f"the host stood still for {gap_ns / NS_PER_S:.2f} s",
            f"the drive bears {self._borne_ms} ms without it{then}",
            "repeat the step; is the machine busy with something else?",
        )


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


class _OwnFault(NamedTuple):
    cause: str
    """Empty: it may be a short circuit, and is not reset."""
    remedy: str = ""


_LOWER: Final = "lower limits.speed_max_rpm or limits.torque_max_percent in the nameplate"
_OWN_FAULTS: Final = {
    HEARTBEAT_ERROR: _OwnFault("of a host that was not heard"),
    0x3210: _OwnFault(
        "of a DC link that braking charged",
        f"braking returns more than the link takes: a braking resistor, or {_LOWER}",
    ),
    0x3220: _OwnFault(
        "of a DC link that driving emptied", f"the supply gives less than the motion takes: {_LOWER}"
    ),
    0x2350: _OwnFault("of I^2 t", "let it cool, or lower limits.torque_max_percent in the nameplate"),
    0x4210: _OwnFault(
        "of a power stage that its current warmed",
        "let it cool, or lower limits.torque_max_percent in the nameplate",
    ),
    0x2310: _OwnFault("", _LOWER),
}


def passing_cause(codes: Sequence[int]) -> str | None:
    """Return the cause of the last of ``codes``; None if there is none, or an exercise does not cause it."""
    known = _OWN_FAULTS.get(codes[-1]) if codes else None
    return None if known is None else known.cause or None


def advise(failure: PeerFault | None, codes: Sequence[int]) -> None:
    """Give a drive's fault the remedy for the last of ``codes``, if an exercise causes that."""
    known = _OWN_FAULTS.get(codes[-1]) if codes else None
    if known is not None and known.remedy and isinstance(failure, DriveInFault):
        failure.remedy = known.remedy

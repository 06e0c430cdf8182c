"""A measurement as a network file, and as a fault plan that does the same to a simulated bus."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from drivers.timebase import NS_PER_US
from hil.configuration.network_file import Certainty, LossChain, Network
from hil.configuration.toml_text import toml_text
from hil.execution.assembly import shortest_transit
from hil.loop.samples import CommandFate
from hil.measuring.bounds import CONFIDENCE, share_within_largest
from hil.measuring.figures import Measured, MeasuredDrive
from hil.measuring.loss_model import UNKNOWN, Losses, Outcomes, losses_of
from hil.reviewing.histogram import TimeHistogram
from hil.reviewing.network_meter import NetworkMeter, histogram_of
from hil.rows.records import COMMAND_FATES, FATE_SAMPLE, Rows

_APART: Final = 1000
"""Unknown fates between the sequences of two drives, so that neither's state says anything of the other's."""
_ACTING: Final = COMMAND_FATES.index(CommandFate.ACTING)
Table = dict[str, Any]


def network_of(period_us: int, rows: Sequence[Rows], ways: Sequence[dict[str, Outcomes]]) -> Network | None:
    """The network file of a measurement: all drives together. ``rows``, ``ways``: of each; None without a
    reading."""
    meter = NetworkMeter(period_us, len(rows))
    for each in rows:
        meter.add(each)
    network = meter.network()
    if network is None:
        return None
    readings, commands = (losses_of(_joined(ways, key)) for key in ("readings", "commands"))
    assert readings.interval is not None
    came = sum(int((each["fate"] == FATE_SAMPLE).sum()) for each in rows)
    acting = [each[each["command_fate"] == _ACTING] for each in rows]
    acted = sum(each.size for each in acting)
    effect = TimeHistogram()
    for each in acting:
        effect.add(each["command_acts_by"] - each["command_handed_at"])
    certainty = Certainty(
        confidence=CONFIDENCE,
        loss_percent=_percent(readings) or (0.0, 100.0),
        command_loss_percent=_percent(commands),
        reading_delay_share=share_within_largest(came),
        action_delay_share=share_within_largest(acted) if acted else None,
    )
    return network.model_copy(
        update={
            "command_histogram": histogram_of(effect),
            "reading_losses": _chain_of(readings),
            "command_losses": _chain_of(commands),
            "certainty": certainty,
        }
    )


def _chain_of(losses: Losses) -> LossChain | None:
    """The model of these losses; None where there is none."""
    model = losses.model
    return None if model is None else LossChain(**model.parameters._asdict())


def fault_plan_text(measured: Measured) -> str:
    """A fault plan by which a simulated bus treats these drives as the measured one did.

    Losses strike the frames that were measured: SYNC, those with the speed, the commands. What a frame takes
    on an idle bus is left out of the delays, since the simulated bus takes it again.
    """
    request = measured.request
    head = (
        f"# What {request.bus} did in {measured.cycles} cycles of {request.period_us} us.\n"
        "# Losses that were too few to be modelled are not in it.\n\n"
    )
    tables: dict[str, list[Table]] = {"measured_delay": [], "burst": []}
    for drive in measured.drives:
        tables["measured_delay"] += _delays(drive, request.bitrate_bit_s)
        tables["burst"] += _bursts(drive)
    sync = measured.drives[0].losses["sync_before_bus"]
    tables["burst"] += _burst(sync, {"side": "host", "direction": "host_to_drive", "frames": ["sync"]})
    return head + toml_text({name: entries for name, entries in tables.items() if entries})


def _delays(drive: MeasuredDrive, bitrate: int) -> Iterator[Table]:
    stages = {each.key: each.times for each in drive.stages}
    reading, command = (shortest_transit(pdo.bits // 8, bitrate) for pdo in (drive.speed, drive.command))
    for key, transit, where in (
        ("reception", reading, _from_drive(drive, "pdo")),
        ("command_on_bus", command, _command(drive, "host")),
        ("command_acting", 0, _command(drive, "drive")),
    ):
        bars = histogram_of(stages[key])
        if bars is None:
            continue
        # Whole bars go down together, so that none of them changes its width; the first may lose a part.
        edges = np.maximum(np.array(bars.edges_us) - transit / NS_PER_US, 0.0)
        counts = np.array(bars.counts)
        kept = edges[1:] > edges[:-1]
        if kept.any():
            first = int(np.flatnonzero(kept)[0])
            counts[first] += counts[:first].sum()
            yield {**where, "edges_us": edges[first:].tolist(), "counts": counts[first:].tolist()}


def _bursts(drive: MeasuredDrive) -> Iterator[Table]:
    for key, where in (
        ("reading", _from_drive(drive, drive.speed.cob_id)),
        ("command_before_bus", _command(drive, "host")),
        ("command_behind_bus", _command(drive, "drive")),
    ):
        yield from _burst(drive.losses[key], where)


def _burst(losses: Losses, where: Table) -> Iterator[Table]:
    if losses.model is not None:
        yield {**where, **losses.model.parameters._asdict()}


def _from_drive(drive: MeasuredDrive, frames: int | str) -> Table:
    """What travels with the speed is delayed as it is: a frame that overtook it would be another SYNC's."""
    return {"side": "drive", "nodes": [drive.node], "direction": "drive_to_host", "frames": [frames]}


def _command(drive: MeasuredDrive, side: str) -> Table:
    where: Table = {"side": side, "direction": "host_to_drive", "frames": [drive.command.cob_id]}
    return where if side == "host" else {**where, "nodes": [drive.node]}


def _percent(losses: Losses) -> tuple[float, float] | None:
    if losses.interval is None:
        return None
    return 100.0 * losses.interval.low, 100.0 * losses.interval.high


def _joined(ways: Sequence[dict[str, Outcomes]], key: str) -> Outcomes:
    gap = np.full(_APART, UNKNOWN, np.int8)
    parts = [part for each in ways for part in (gap, each[key])]
    return np.concatenate(parts[1:])

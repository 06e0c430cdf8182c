"""What becomes of a plate: commissioned in simulated time, with the drawn motor as the witness."""

import re
import shutil
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

from pydantic import ValidationError

from servobench.hil.commissioning.findings import StepVerdict
from servobench.hil.commissioning.report import Commissioned, as_json, summary_of
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.virtual_bus.drive.unknown_drive import Truth
from tests.commissioning import unknown_world
from tests.mistakes.drawn import Mistake, Plate, lacks_of, own_plate

STILL: Final = frozenset({"bus", "identity", "dump", "units", "setup", "stop", "watchdog"})
"""Steps in which nothing turns."""
OFF: Final = 0.05
PERIOD_US: Final = 4000
"""Fewer cycles to simulate; inertia and friction are within a percent by it."""
UNITS: Final = "units"
"""The step in which nameplate and drive meet."""
LAST: Final = "voltage_constant"
"""The last step that holds a figure against another."""


class Outcome(NamedTuple):
    """Of one mistake."""

    verdict: str
    why: str


class RightPlate:
    """What is found with the drive's own plate, as far as it was asked for."""

    def __init__(self, seed: int, folder: Path) -> None:
        """A plate that cannot tell which is right, itself or the drive, is one that somebody vouches for."""
        self._seed, self._folder = seed, folder
        self._trust = False
        refusal, self.at_rest = self._faults(UNITS)
        if "nothing measured tells which is right" in refusal:
            self._trust = True
            refusal, self.at_rest = self._faults(UNITS)
        self.refusal = refusal
        """Why it is refused; empty if it is not."""

    @cached_property
    def in_motion(self) -> frozenset[str]:
        """Findings of the whole commissioning; it may be refused there, too."""
        self.refusal, found = self._faults(LAST)
        return found

    def _faults(self, last_step: str) -> tuple[str, frozenset[str]]:
        _, result = _commissioned(self._seed, own_plate(self._seed), self._trust, self._folder, last_step)
        return "" if result.error is None else str(result.error), faults_of(result)


def outcome_of(seed: int, mistake: Mistake, trust: bool, right: RightPlate, folder: Path) -> Outcome:
    """A plate that is refused or named at rest is not tried in motion."""
    try:
        _, result = _commissioned(seed, mistake.plate, trust, folder, UNITS)
    except ValidationError as error:
        return Outcome("refused", str(error))
    if result.error is not None:
        return Outcome("refused", str(result.error))
    told = faults_of(result) - right.at_rest
    if not told:
        truth, result = _commissioned(seed, mistake.plate, trust, folder, LAST)
        if result.error is not None:
            still = result.records[-1].name in STILL
            return Outcome("refused" if still else "named", str(result.error))
        told = faults_of(result) - right.in_motion
    if told:
        return Outcome("named", "; ".join(sorted(told)))
    summary = summary_of(_request(mistake.plate, folder), result)
    off = _off(truth, result)
    if off > OFF:
        unproven = "a torque scale that nothing measured" in summary[0]
        return Outcome("unproven" if unproven else "WRONG", f"off by {100.0 * off:.3g} %; {summary[0]}")
    alone = as_json(_request(mistake.plate, folder), result)["header"]["by the nameplate alone"].split(", ")
    changed = _changed(mistake.plate, own_plate(seed))
    if changed <= set(alone):
        return Outcome("harmless", ", ".join(sorted(changed)))
    return Outcome("right", f"{', '.join(sorted(changed))}; {summary[0]}")


def faults_of(result: Commissioned) -> frozenset[str]:
    """Findings and failed steps, without the last digits that scatter."""
    texts = [fault for record in result.records for fault in record.outcome.faults]
    texts += [
        f"{record.name}: {record.reason}" for record in result.records if record.verdict is StepVerdict.FAILED
    ]
    return frozenset(re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", _two_digits, text) for text in texts)


def _two_digits(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2g}"


def _commissioned(
    seed: int, plate: Plate, trust: bool, folder: Path, last_step: str
) -> tuple[Truth, Commissioned]:
    place = folder / "out"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    truth, result, _ = unknown_world(
        seed, place, plate=plate, trust_nameplate=trust, period_us=PERIOD_US, last_step=last_step,
        lacks=lacks_of(seed),
    )  # fmt: skip
    return truth, result


def _request(plate: Plate, folder: Path) -> CommissionRequest:
    return CommissionRequest(
        bus="simulated", node=1, out=folder / "out", nameplate=Nameplate.model_validate(plate)
    )


def _off(truth: Truth, result: Commissioned) -> float:
    """The inertia, relative; of a commissioning that found none it is none."""
    mechanics = result.findings.mechanics
    if mechanics is None:
        return 0.0
    return abs(mechanics.inertia_kg_m2 / truth.motor.inertia_kg_m2 - 1.0)


def _changed(plate: Plate, own: Plate) -> set[str]:
    return {
        f"{table}.{name}"
        for table, values in own.items()
        for name, value in values.items()
        if plate[table][name] != value
    }

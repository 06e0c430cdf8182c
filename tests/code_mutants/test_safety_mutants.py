"""A few of the mutants of ``make mutate``, and so the tool: a safety test that is weakened goes red here."""

from collections.abc import Iterator

import pytest

from tests.code_mutants.mutations import Mutant
from tests.code_mutants.safety import SAFETY, Guarded, mutants_in
from tests.code_mutants.workshop import Fate, Workshop, workshop
from tests.draws import few_of

NAMED = (
    ("hil/loop/safety.py", "SafetyGuard.limit", "max(demand, low)"),
    ("hil/commissioning/exercise.py", "Watched._check", "(travel >= limits.travel_rad)"),
    ("drivers/cia402/rest.py", "resting_since", "now() + since"),
    ("drivers/cia402/drive_watch.py", "DriveWatch.check", "status.lost_at is None"),
    ("hil/loop/safety.py", "SafetyGuard.check_speed", "abs(velocity_rad_s) < self"),
    ("hil/loop/safety.py", "SafetyGuard._count", "self._dropouts >= self._dropouts_max"),
    ("hil/commissioning/exercise.py", "Watched._check", "energy.spent_j -= "),
    ("hil/commissioning/request.py", "motion_limits", "given.turns_max / math.tau"),
    ("hil/commissioning/steps_units.py", "pulses", "0.4 / session.limits.travel_rad"),
    ("hil/commissioning/session.py", "Session.check_temperature", "raw / told.celsius"),
    ("drivers/cia402/drive_watch.py", "DriveWatch.check", "(as_expected) and"),
)
"""File, function and a part of what the mutant becomes."""


@pytest.fixture(scope="module")
def shop() -> Iterator[Workshop]:
    with workshop() as made:
        yield made


def named(file: str, function: str, becomes: str) -> tuple[Guarded, Mutant]:
    """The first safety mutant of these words."""
    for guarded in SAFETY:
        if guarded.file == file:
            for mutant in mutants_in(guarded):
                if mutant.place.function == function and becomes in mutant.place.becomes:
                    return guarded, mutant
    raise AssertionError(f"no mutant of {function} becomes {becomes}")


@pytest.mark.parametrize(("file", "function", "becomes"), few_of(NAMED, 4))
def test_a_mutant_is_killed(shop: Workshop, file: str, function: str, becomes: str) -> None:
    guarded, mutant = named(file, function, becomes)
    assert shop.fate_of(mutant, guarded.tests[:1]) is Fate.KILLED
    assert "failed" in shop.said(), "by a test, not by what kept it from running"


def test_a_mutant_that_no_test_sees_survives_and_the_original_comes_back(shop: Workshop) -> None:
    guarded, mutant = named("hil/loop/safety.py", "SafetyGuard.limit", "max(demand, low)")
    elsewhere = ["tests/unit/drivers/test_command_watch.py"]
    assert shop.fate_of(mutant, elsewhere) is Fate.SURVIVED
    shop.check(guarded.tests[:1])
    with pytest.raises(RuntimeError, match="without a mutant"):
        shop.check(["tests/unit/absent.py"])


def test_a_run_without_end_is_ended(shop: Workshop) -> None:
    endless = shop.folder / "test_endless.py"
    endless.write_text("import subprocess\n\ndef test_it():\n    subprocess.run(['sleep', '600'])\n")
    assert shop.run([endless.name], timeout_s=2.0) == "timeout"

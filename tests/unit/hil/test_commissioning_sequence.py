"""The guided sequence: asking, doing, repeating, skipping with a reason; and the keys that stop it."""

import os
import select
import termios
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, cast

import pytest

from servobench.drivers.errors import BusDown, LimitExceeded
from servobench.hil.commissioning.commission import all_steps
from servobench.hil.commissioning.dialog import Choice, Dialog, EmergencyStop, Idle, Terminal
from servobench.hil.commissioning.findings import (
    ReadingsLost,
    StepFailed,
    StepOutcome,
    StepRecord,
    StepVerdict,
)
from servobench.hil.commissioning.sequence import Abandoned, Step, run_sequence
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_static import DumpStep
from servobench.hil.commissioning.steps_stopping import StopProof
from servobench.hil.commissioning.steps_units import Turn
from servobench.hil.machine.stopping import Interrupted, StopRequest


class Played(Step):
    """A step that fails as often as it is told to."""

    title = "a step"

    def __init__(
        self, name: str, failures: int = 0, *, needs: tuple[str, ...] = (), essential: bool = False,
        writes: bool = False, without: str | None = None, error: Exception | None = None,
    ) -> None:  # fmt: skip
        for key, value in {"name": name, "needs": needs, "essential": essential, "writes": writes}.items():
            setattr(self, key, value)
        self.failures = failures
        self.runs = 0
        self._without = without
        self._error = error

    def left_out(self, session: Session) -> str | None:  # noqa: ARG002 - as the base
        return self._without

    def plan(self, _session: Session, /) -> str:
        return f"play {self.name}"

    def run(self, session: Session, outcome: StepOutcome) -> None:  # noqa: ARG002 - as the base
        self.runs += 1
        if self._error is not None:
            raise self._error
        if self.runs <= self.failures:
            raise StepFailed("it went wrong")
        outcome.say("it went well")


class Scripted:
    """Somebody at the keyboard who answers from a list."""

    attended = True

    def __init__(self, choices: Sequence[Choice], lines: Sequence[str] = ()) -> None:
        self.told: list[str] = []
        self.offered: list[tuple[Choice, ...]] = []
        self._choices = list(choices)
        self._lines = list(lines)

    def tell(self, text: str) -> None:
        self.told.append(text)

    def choose(self, _question: str, choices: tuple[Choice, ...], _idle: Idle) -> Choice:
        self.offered.append(choices)
        return self._choices.pop(0)

    def line(self, _question: str, _idle: Idle) -> str:
        return self._lines.pop(0)


def play(dialog: Any, steps: Sequence[Step], *, dry_run: bool = False) -> list[StepRecord]:
    records: list[StepRecord] = []
    session = SimpleNamespace(
        dialog=dialog,
        request=SimpleNamespace(dry_run=dry_run, brief=False),
        check_stop=lambda: None,
        idle=lambda: None,
        begin_attempt=lambda: None,
        end_attempt=lambda failure: failure,
        log=SimpleNamespace(step=lambda _name: None, event=lambda _level, _text: None),
        write_log=lambda: None,
    )
    run_sequence(cast(Session, session), steps, records)
    return records


def verdicts(records: list[StepRecord]) -> list[StepVerdict]:
    return [record.verdict for record in records]


def test_a_step_tells_what_it_will_do_before_it_does_it() -> None:
    dialog = Scripted([Choice.GO])
    play(dialog, [Played("one")])
    assert "play one" in dialog.told[0]
    assert "it went well" in dialog.told[-1]


def test_a_step_that_failed_is_repeated() -> None:
    step = Played("one", failures=2)
    records = play(Scripted([Choice.GO, Choice.REPEAT, Choice.REPEAT]), [step])
    assert verdicts(records) == [StepVerdict.DONE]
    assert records[0].attempts == 3
    assert records[0].reason == ""


def test_a_step_is_skipped_with_a_reason_and_what_rests_on_it_is_left_out() -> None:
    dialog = Scripted([Choice.SKIP, Choice.GO], ["the shaft is coupled"])
    records = play(dialog, [Played("one"), Played("two", needs=("one",)), Played("three")])
    assert verdicts(records) == [StepVerdict.SKIPPED, StepVerdict.LEFT_OUT, StepVerdict.DONE]
    assert records[0].reason == "the shaft is coupled"
    assert records[1].reason == "it rests on one"


def test_a_failed_step_can_be_skipped_too() -> None:
    records = play(Scripted([Choice.GO, Choice.SKIP], [""]), [Played("one", failures=9)])
    assert verdicts(records) == [StepVerdict.SKIPPED]
    assert "it went wrong" in records[0].reason


def test_an_essential_step_cannot_be_skipped() -> None:
    dialog = Scripted([Choice.GO, Choice.QUIT])
    with pytest.raises(Abandoned):
        play(dialog, [Played("one", failures=9, essential=True), Played("two")])
    assert all(Choice.SKIP not in offered for offered in dialog.offered)


def test_no_step_before_the_proof_that_it_stops_can_be_passed_over_but_two() -> None:
    """A dump that failed harms nobody, and a whole turn is looked for only where there is room for it."""
    steps = all_steps()
    proved = next(place for place, step in enumerate(steps) if isinstance(step, StopProof))
    before, behind = steps[: proved + 1], steps[proved + 1 :]
    assert {type(step) for step in before if not step.essential} == {DumpStep, Turn}
    assert not any(step.essential for step in behind)


def test_quitting_leaves_the_rest_undone() -> None:
    later = Played("two")
    with pytest.raises(Abandoned):
        play(Scripted([Choice.QUIT]), [Played("one"), later])
    assert later.runs == 0


def test_nobody_there_goes_on_after_a_failure_unless_it_is_essential() -> None:
    silent = Dialog(lambda _text: None)
    records = play(silent, [Played("one", failures=9), Played("two", needs=("one",)), Played("three")])
    assert verdicts(records) == [StepVerdict.FAILED, StepVerdict.LEFT_OUT, StepVerdict.DONE]
    with pytest.raises(Abandoned, match="it went wrong"):
        play(silent, [Played("one", failures=9, essential=True)])


def test_nobody_there_repeats_what_was_disturbed_but_not_what_was_judged() -> None:
    silent = Dialog(lambda _text: None)
    disturbed, judged = Played("one", error=LimitExceeded("no reading")), Played("two", failures=9)
    blind = Played("three", error=ReadingsLost("14 of 80 readings were lost"))
    records = play(silent, [disturbed, judged, blind])
    assert verdicts(records) == [StepVerdict.FAILED] * 3
    assert (disturbed.runs, judged.runs, blind.runs) == (2, 1, 3)


def test_what_a_drive_cannot_do_is_left_out_with_the_reason() -> None:
    records = play(Dialog(lambda _text: None), [Played("one", without="no torque mode")])
    assert (records[0].verdict, records[0].reason) == (StepVerdict.LEFT_OUT, "no torque mode")


def test_a_dry_run_tells_of_what_writes_and_of_what_rests_on_it() -> None:
    writer, follower, reader = Played("one", writes=True), Played("two", needs=("one",)), Played("three")
    records = play(Dialog(lambda _text: None), [writer, follower, reader], dry_run=True)
    assert verdicts(records) == [StepVerdict.NOT_DONE, StepVerdict.NOT_DONE, StepVerdict.DONE]
    assert (writer.runs, follower.runs, reader.runs) == (0, 0, 1)


@pytest.mark.parametrize("error", [BusDown("gone"), Interrupted("ended by SIGINT")])
def test_a_lost_bus_and_a_stop_signal_end_it(error: Exception) -> None:
    with pytest.raises(type(error)):
        play(Dialog(lambda _text: None), [Played("one", error=error), Played("two")])


# ---- the terminal -----------------------------------------------------------------------------------------


def typed(text: str, choices: tuple[Choice, ...]) -> tuple[Choice, list[str], int]:
    """What an answer from a pipe means, what was said, and how often the bench could go on meanwhile."""
    read, write = os.pipe()
    said: list[str] = []
    waits = 0

    def idle() -> None:
        nonlocal waits
        waits += 1
        if waits == 2:
            os.write(write, text.encode())
            os.close(write)

    with os.fdopen(read, encoding="utf-8") as source:
        choice = Terminal(source, said.append).choose("do it?", choices, idle)
    return choice, said, waits


@pytest.mark.parametrize(
    ("text", "choice"),
    [
        ("\n", Choice.GO),
        ("s\n", Choice.SKIP),
        ("SKIP\n", Choice.SKIP),
        ("q\n", Choice.QUIT),
        ("", Choice.QUIT),
    ],
)
def test_answers(text: str, choice: Choice) -> None:
    found, said, waits = typed(text, (Choice.GO, Choice.SKIP, Choice.QUIT))
    assert found is choice
    assert "Enter = go" in said[0]
    assert waits == 2, "heartbeats went on while nobody answered"


def test_a_word_that_is_no_answer_is_asked_again() -> None:
    found, said, _ = typed("what\nr\n", (Choice.REPEAT, Choice.QUIT))
    assert found is Choice.REPEAT
    assert len(said) == 2


def test_any_key_stops_only_while_armed_and_the_terminal_is_as_before() -> None:
    keyboard, line = os.openpty()
    before = termios.tcgetattr(line)
    try:
        with open(line, "rb", buffering=0, closefd=False) as source:
            stop = EmergencyStop(StopRequest(), source)
            os.write(keyboard, b"x")
            assert not stop(), "not armed"
            with stop.armed():
                assert termios.tcgetattr(line) != before, "single keys are heard"
                os.write(keyboard, b" ")
                assert stop()
                assert stop.key
            assert termios.tcgetattr(line) == before
    finally:
        os.close(keyboard)
        os.close(line)


def test_a_key_is_taken_from_the_terminal_and_counts_until_it_is_armed_again() -> None:
    """What is hit after the shaft has come to rest belongs to the next question."""
    keyboard, line = os.openpty()
    try:
        with open(line, "rb", buffering=0, closefd=False) as source:
            stop = EmergencyStop(None, source)
            with stop.armed():
                assert not stop()
                os.write(keyboard, b"abc")
                select.select([line], [], [], 5.0)
                assert stop()
                assert not select.select([line], [], [], 0.0)[0], "the keys are gone"
            assert stop(), "who asks later is told too"
            with stop.armed():
                assert not stop.key
                assert not stop()
            os.write(keyboard, b"y\n")
            select.select([line], [], [], 5.0)
            assert not stop(), "an answer is no emergency"
            assert source.readline() == b"y\n"
    finally:
        os.close(keyboard)
        os.close(line)


def test_the_standard_input_is_a_keyboard_and_no_cycle_waits_for_a_key(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waits: list[float] = []
    cleared: list[int] = []

    def select_nothing(_read: list[int], _write: list[int], _odd: list[int], wait_s: float) -> Any:
        waits.append(wait_s)
        return [], [], []

    monkeypatch.setattr("select.select", select_nothing)
    monkeypatch.setattr("termios.tcgetattr", lambda _descriptor: ["as before"])
    monkeypatch.setattr("termios.tcsetattr", lambda *_: None)
    monkeypatch.setattr("tty.setcbreak", lambda descriptor, _when: cleared.append(descriptor))
    stop = EmergencyStop(None, cast(IO[Any], SimpleNamespace(fileno=lambda: 0, isatty=lambda: True)))
    with stop.armed():
        assert not stop()
    assert (cleared, waits) == ([0], [0.0])


def test_who_asked_for_the_end_is_told() -> None:
    asked = StopRequest()
    stop = EmergencyStop(asked)
    assert stop.asked_by == ""
    asked.ask("a test")
    assert stop()
    assert stop.asked_by == "a test"
    assert EmergencyStop().asked_by == ""


def test_the_terminal_is_as_before_after_an_error() -> None:
    keyboard, line = os.openpty()
    before = termios.tcgetattr(line)
    try:
        with (
            open(line, "rb", buffering=0, closefd=False) as source,
            pytest.raises(BusDown),
            EmergencyStop(None, source).armed(),
        ):
            raise BusDown("gone")
        assert termios.tcgetattr(line) == before
    finally:
        os.close(keyboard)
        os.close(line)


def test_without_a_keyboard_there_is_no_key(tmp_path: Path) -> None:
    with (tmp_path / "nothing").open("wb+") as source:
        stop = EmergencyStop(None, source)
        with stop.armed():
            assert not stop()

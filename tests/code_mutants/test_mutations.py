"""The mutants of a text, and what is declared and argued of those of the product."""

import ast
from pathlib import Path
from typing import Any

import pytest

from tests.code_mutants.argued import Arguments, read_arguments
from tests.code_mutants.imports import reached
from tests.code_mutants.mutations import Mutant, Place, mutants_of
from tests.code_mutants.safety import MODULE, SAFETY, Gone, Guarded, mutants_in
from tests.code_mutants.sample import Called, Kept, callers, killer, others, room_of, sample, slow
from tests.code_mutants.workshop import ROOT

SOURCE = '''"""ä text."""
LIMIT: float = 0.4

class Guard:
    @property
    def check(self, value, on=True):
        """A text with 1 and 2."""
        if on and abs(value) > LIMIT * 2:
            raise ValueError(f"{value + 1} is beyond", 3)
        self.last = min(value,
                        -50)
        return self.last
'''


def changes(source: str = SOURCE) -> list[str]:
    return [f"{each.place.was} -> {each.place.becomes}" for each in mutants_of("a.py", source)]


def test_each_kind_of_mutant_is_made_once_and_texts_are_left_alone() -> None:
    assert changes() == [
        "LIMIT: float = 0.4 -> LIMIT: float = (0.8)",
        "True -> (False)",
        "on and abs(value) > LIMIT * 2 -> (not (on and abs(value) > LIMIT * 2))",
        "on and abs(value) > LIMIT * 2 -> (on or abs(value) > LIMIT * 2)",
        "on and abs(value) > LIMIT * 2 -> on and (abs(value) >= LIMIT * 2)",
        "on and abs(value) > LIMIT * 2 -> on and (abs(value) <= LIMIT * 2)",
        "on and abs(value) > LIMIT * 2 -> on and (value) > LIMIT * 2",
        "on and abs(value) > LIMIT * 2 -> on and abs(value) > (LIMIT / 2)",
        "on and abs(value) > LIMIT * 2 -> on and abs(value) > LIMIT * (3)",
        'raise ValueError(f"{value + 1} is beyond", 3) -> pass',
        "self.last = min(value, -50) -> pass",
        "self.last = min(value, -50) -> self.last = (max(value, -50))",
        "self.last = min(value, -50) -> self.last = min(value, (50))",
        "self.last = min(value, -50) -> self.last = min(value, -(100))",
        "return self.last -> return None",
    ]


def test_a_mutant_is_python_and_leaves_the_lines_before_it_as_they_were() -> None:
    lines = SOURCE.splitlines()
    for mutant in mutants_of("a.py", SOURCE):
        text = mutant.text(SOURCE)
        ast.parse(text)
        assert text != SOURCE
        assert text.splitlines()[: mutant.line - 1] == lines[: mutant.line - 1]


def test_a_mutant_knows_its_function_by_name_and_by_first_line() -> None:
    places = {(each.place.function, each.function_line) for each in mutants_of("a.py", SOURCE)}
    assert places == {("", 0), ("Guard.check", 5)}


def test_the_same_change_twice_in_a_function_is_told_apart() -> None:
    first, second = mutants_of("a.py", "def f(a):\n    a(a + b)\n    a(a + b)\n")[1::2]
    assert (first.place.turn, second.place.turn) == (1, 2)
    assert (first.line, second.line) == (2, 3)


def test_a_drawn_mutant_of_the_product_is_python() -> None:
    for mutant, _ in zip(sample(3), range(2), strict=False):
        ast.parse(mutant.text((ROOT / mutant.place.file).read_text(encoding="utf-8")))


def test_all_that_is_declared_is_there() -> None:
    for guarded in SAFETY:
        assert mutants_in(guarded)
        for test in guarded.tests:
            assert (ROOT / test).is_file(), test


@pytest.mark.parametrize(
    ("guarded", "told"),
    [
        (Guarded("hil/absent.py", ("*",), ()), "hil/absent.py is not there any more"),
        (Guarded("hil/loop/safety.py", ("SafetyGuard.gone",), ()), "is called SafetyGuard.gone"),
        (Guarded("hil/loop/safety.py", ("*",), (), ("nowhere",)), "no line .* holds"),
    ],
)
def test_what_was_renamed_is_an_error(guarded: Guarded, told: str) -> None:
    with pytest.raises(Gone, match=told):
        mutants_in(guarded)


def test_what_is_argued_is_a_safety_mutant() -> None:
    every = {mutant.place for guarded in SAFETY for mutant in mutants_in(guarded)}
    assert [str(place) for place in read_arguments().why if place not in every] == []
    assert any(MODULE in guarded.functions for guarded in SAFETY)


def test_stale_arguments_are_told() -> None:
    killed, gone, held = (Place("a.py", "f", "a < b", becomes) for becomes in ("a <= b", "a > b", "a >= b"))
    arguments = Arguments(dict.fromkeys((killed, gone, held), "because"))
    assert arguments.holds(held)
    assert not arguments.holds(Place("a.py", "g", "a < b", "a >= b"))
    stale = arguments.stale([killed, held])
    assert len(stale) == 2
    assert "killed" in stale[0]
    assert "no such mutant" in stale[1]


def test_an_argument_needs_a_reason(tmp_path: Path) -> None:
    path = tmp_path / "argued.toml"
    table = '[[mutant]]\nfile = "a.py"\nfunction = "f"\nwas = "a"\nbecomes = "b"\n'
    path.write_text(table)
    with pytest.raises(ValueError, match="no reason"):
        read_arguments(path)
    path.write_text(2 * (table + 'why = "because"\n'))
    with pytest.raises(ValueError, match="told twice"):
        read_arguments(path)


def test_a_sample_is_that_of_its_seed() -> None:
    one, same, other = (
        [each.place for each, _ in zip(sample(seed), range(3), strict=False)] for seed in (1, 1, 2)
    )
    assert one == same != other
    assert len(set(one)) == 3


def called(**lines: list[int]) -> Called:
    """By a test file, in files of hil and of virtual_bus."""
    return Called(1.0, {f"{room}/a.py": of for room, of in lines.items()})


def test_a_mutant_is_judged_by_who_calls_it_and_first_by_the_test_that_is_about_it() -> None:
    (mutant, *_) = mutants_of("hil/a.py", "def f(a):\n    return a + 1\n")
    calls = {"wide": called(hil=[1], virtual_bus=[1]), "about f": called(hil=[1]), "other": called(hil=[0])}
    assert room_of(mutant) == "hil"
    assert callers(mutant, calls) == ["about f", "wide"]


def test_all_other_tests_that_reach_a_mutant_judge_it_the_nearest_first() -> None:
    file = "hil/campaign/figures.py"
    (mutant, *_) = mutants_of(file, (ROOT / file).read_text(encoding="utf-8"))
    tests = others(mutant)
    assert tests[0] == "tests/scenario/test_campaign.py"
    assert "tests/scenario/test_determinism.py" in tests, "it runs hil"
    assert "tests/oracle/test_plant.py" not in tests
    assert [test for test in tests if test.startswith(("tests/unit", "tests/vcan"))] == []
    long, known, far = (f"tests/unit/hil/test_{name}.py" for name in ("told", "campaign_claims", "toml_text"))
    unmapped = Called(180.0, {})
    assert slow(mutant, {long: unmapped, known: called(hil=[1]), far: unmapped}) == [long]


def test_imports_are_followed_by_name_by_text_and_by_command() -> None:
    assert reached("drivers/timebase.py") == {"drivers/timebase.py": 0}
    assert reached("servobench/__init__.py")["hil/campaign/plan.py"] == 1
    assert reached("tests/scenario/processes.py")["hil/cli.py"] == 2, "by tests.warm, which forks it"
    assert reached("tests/scenario/test_two_processes.py")["hil/terminal/simulate.py"] > 2


class Shop:
    """Answers as a workshop does, by the name of the test; ``ran`` holds what was asked."""

    folder = ROOT

    def __init__(self, **statuses: tuple[int | str, int]) -> None:
        self.statuses = statuses
        """With the mutant and without."""
        self.ran: list[str] = []

    def status_of(self, _mutant: Mutant, tests: list[str], _timeout_s: float, pure: bool) -> int | str:
        assert not pure, "it is in a function"
        self.ran += tests
        return self.statuses[tests[0]][0]

    def run(self, arguments: list[str], _timeout_s: float, pure: bool) -> int | str:
        assert not pure
        return self.statuses[arguments[-1]][1]


def test_who_fails_without_the_mutant_or_takes_too_long_has_not_killed_it() -> None:
    (mutant, *_) = mutants_of("hil/a.py", "def f(a):\n    return a + 1\n")
    shop = Shop(green=(0, 0), slow=("timeout", 0), red=(1, 1), sees=(1, 0), late=(1, 0))
    of: Any = shop
    assert killer(of, mutant, list(shop.statuses), 60.0) == "sees"
    assert shop.ran == ["green", "slow", "red", "sees"]
    assert killer(of, mutant, ["green", "slow", "red"], 60.0) == ""
    shop.ran.clear()
    assert killer(of, mutant, ["sees"], 0.0) == ""
    assert shop.ran == [], "the time was up"


def test_an_answer_is_kept_until_question_or_tests_change(tmp_path: Path) -> None:
    path = tmp_path / "kept.jsonl"
    one, other = "tests/unit/hil/test_toml_text.py", "tests/unit/hil/test_loss_model.py"
    assert Kept(path).answer(["a"], [one], lambda: "first") == "first"
    with path.open("a") as file:
        file.write('\n["cut o')
    kept = Kept(path)
    assert kept.answer(["b"], [one], lambda: "second") == "second"
    kept = Kept(path)
    assert kept.answer(["a"], [one], lambda: "anew") == "first"
    assert kept.answer(["b"], [one], lambda: "anew") == "second"
    assert kept.answer(["c"], [one], lambda: "anew") == "anew"
    assert kept.answer(["a"], [other], lambda: "anew") == "anew"

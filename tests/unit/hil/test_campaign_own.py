"""Functions of one's own beside a sweep file: how they are called, and what is said of their failures."""

from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput, BusDown
from servobench.hil.campaign.sweep_file import EXPECTED, Own, OwnFunctions
from servobench.hil.control.own_code import OwnCodeFailed

CODE = """
from servobench.drivers.errors import BenchError

class Mine(BenchError):
    exit_status = 0

TABLE = {"drive": {"axis1": {"node": 3}}}

def changes(seed):
    return TABLE | {"bench.seed_was": seed}

def check(seed, run):
    yield f"{seed} with {run()}"
    yield 7

def fails(seed, *run):
    return 1 // (seed - seed)

def own_error(seed, *run):
    raise Mine("none of the bench's")

def runs(seed, run):
    run()

def no_list(seed, run):
    return None
"""


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    (tmp_path / "own.py").write_text(CODE)
    return tmp_path / "sweep.toml"


def test_without_functions_nothing_is_changed_or_checked(sweep: Path) -> None:
    own = OwnFunctions(Own(), sweep)
    assert own.changes(4) == {}
    assert not own.checks


def test_a_function_changes_the_bench_by_the_seed_and_its_tables_stay(sweep: Path) -> None:
    own = OwnFunctions(Own(changes="own.py:changes"), sweep)
    assert not own.checks
    changes = own.changes(4)
    assert changes == {"drive": {"axis1": {"node": 3}}, "bench.seed_was": 4}
    changes["drive"]["axis1"]["node"] = 9
    assert own.changes(5) == {"drive": {"axis1": {"node": 3}}, "bench.seed_was": 5}


def test_a_check_says_texts_of_seed_and_run(sweep: Path) -> None:
    own = OwnFunctions(Own(check="own.py:check"), sweep)
    assert own.checks
    assert own.findings(4, lambda: "its run") == ["4 with its run", "7"]


def test_a_module_that_is_installed_is_named_as_it_is(sweep: Path) -> None:
    own = OwnFunctions(Own(changes="collections:Counter"), sweep)
    with pytest.raises(OwnCodeFailed, match=r"^collections:Counter, seed 4: .*'int' object is not iterable"):
        own.changes(4)


def test_a_failure_names_the_function_the_seed_and_the_line(sweep: Path) -> None:
    line = CODE[: CODE.index("    return 1 //")].count("\n") + 1
    told = (
        f"{sweep.parent / 'own.py'}:fails, seed 4: own.py:{line} in fails: ZeroDivisionError: "
        "integer division or modulo by zero"
    )
    own = OwnFunctions(Own(changes="own.py:fails", check="own.py:fails"), sweep)
    for call in (lambda: own.changes(4), lambda: own.findings(4, lambda: None)):
        with pytest.raises(OwnCodeFailed) as caught:
            call()
        assert str(caught.value).replace("division by zero", "integer division or modulo by zero") == told


def test_what_the_bench_raises_passes(sweep: Path) -> None:
    def run() -> None:
        raise BusDown("the bus is down")

    with pytest.raises(BusDown, match="the bus is down"):
        OwnFunctions(Own(check="own.py:runs"), sweep).findings(4, run)


def test_an_error_of_the_bench_s_kind_that_the_function_raises_is_its_own(sweep: Path) -> None:
    own = OwnFunctions(Own(check="own.py:own_error", changes="own.py:own_error"), sweep)
    for call in (lambda: own.changes(4), lambda: own.findings(4, lambda: None)):
        with pytest.raises(OwnCodeFailed, match="in own_error: Mine: none of the bench's") as caught:
            call()
        assert caught.value.exit_status == 3


def test_a_check_that_returns_no_list_has_failed(sweep: Path) -> None:
    own = OwnFunctions(Own(check="own.py:no_list"), sweep)
    with pytest.raises(OwnCodeFailed, match="TypeError: 'NoneType' object is not iterable"):
        own.findings(4, lambda: None)


def test_a_function_that_is_not_in_its_file_is_bad_input(sweep: Path) -> None:
    own = OwnFunctions(Own(check="own.py:chek"), sweep)
    name = f"{sweep.parent / 'own.py'}:chek"
    with pytest.raises(BadInput) as caught:
        own.findings(4, lambda: None)
    error = caught.value
    assert (error.source, error.key, error.value, error.expected) == (str(sweep), "own.check", name, EXPECTED)
    assert error.remedy.startswith(("AttributeError: ", "ValueError: "))


def test_a_file_that_is_not_there_is_bad_input_before_any_run(sweep: Path) -> None:
    with pytest.raises(BadInput) as caught:
        OwnFunctions(Own(changes="nowhere.py:changes"), sweep)
    error = caught.value
    name = f"{sweep.parent / 'nowhere.py'}:changes"
    assert (error.source, error.key, error.value, error.expected) == (
        str(sweep),
        "own.changes",
        name,
        EXPECTED,
    )
    assert "nowhere.py" in error.remedy

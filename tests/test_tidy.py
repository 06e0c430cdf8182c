"""The house rules hold in every file, and each rule does find its offence."""

import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests import tidy

ROOT = Path(__file__).parents[1]
ROOMS = ("design", "drivers", "virtual_bus", "hil")

TIMEBASE = "drivers/timebase.py"
"""The one file that may import ``time``."""
LOOP = "hil/loop/loop.py"
PROCESS_TOPS = frozenset(
    {
        "hil/campaign/worker.py",
        "hil/terminal/commands.py",
        "hil/terminal/supervision.py",
        "tests/warm/server.py",
    }
)
"""Files that may catch everything, because a process ends there."""
SUBJECTLESS_SHARE = 0.03
"""Most docstrings of a room that may begin with Of, As, What or Whether."""
RULES_THEMSELVES = frozenset({"tests/tidy.py", "tests/test_tidy.py"})

Rule = Callable[[str], Iterable[str]]

imports_time = partial(tidy.imports_of, forbidden=frozenset({"time"}))
loop_imports = partial(tidy.imports_of, forbidden=frozenset({"virtual_bus", "can", "time"}))


def python_files(*folders: str) -> Iterator[Path]:
    """Python files below the folders, in order."""
    for folder in folders:
        yield from sorted((ROOT / folder).rglob("*.py"))


def text_files() -> Iterator[Path]:
    """Every file that a person wrote: sources, documents, examples, scripts and set-up."""
    yield from python_files(*ROOMS, "tests")
    for folder in ("docs", "examples", ".ci"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.is_file() and path.suffix in {"", ".c", ".md", ".py", ".sh", ".toml", ".txt"}:
                yield path
    for name in ("README.md", "CHANGELOG.md", "Makefile", "pyproject.toml"):
        if (ROOT / name).exists():
            yield ROOT / name


def offences(rule: Rule, files: Iterable[Path], spared: frozenset[str] = frozenset()) -> list[str]:
    """``file: offence`` of each offence against ``rule``."""
    found = []
    for path in files:
        name = path.relative_to(ROOT).as_posix()
        if name not in spared:
            found += [f"{name}: {offence}" for offence in rule(path.read_text(encoding="utf-8"))]
    return found


def test_files_and_functions_are_short() -> None:
    assert offences(tidy.too_long, python_files(*ROOMS, "tests", "docs")) == []


def test_only_the_timebase_imports_time() -> None:
    assert offences(imports_time, python_files(*ROOMS, "tests"), frozenset({TIMEBASE})) == []


def test_the_loop_knows_neither_bus_nor_clock() -> None:
    assert offences(loop_imports, [path for path in [ROOT / LOOP] if path.exists()]) == []


def test_nothing_is_caught_that_nobody_expects() -> None:
    assert offences(tidy.broad_excepts, python_files(*ROOMS, "tests"), PROCESS_TOPS) == []


def test_public_names_are_documented() -> None:
    assert offences(tidy.missing_docstrings, python_files(*ROOMS)) == []


@pytest.mark.parametrize("room", ROOMS)
def test_docstrings_name_their_subject(room: str) -> None:
    files = [*python_files(room), *sorted((ROOT / room).rglob("*.pyi"))]
    texts = [text for path in files for text in tidy.docstrings(path.read_text(encoding="utf-8"))]
    begun = [text for text in texts if tidy.begins_without_a_subject(text)]
    assert len(begun) <= SUBJECTLESS_SHARE * len(texts), begun


def test_docstrings_are_found_and_told_by_their_subject() -> None:
    source = '"""As read."""\nA = 1\n"""Its size."""\ndef f():\n    "Whether."\n    return 1\n"none"\n'
    source += 'class C:\n    """Of a drive."""\n    b: int\n    "What it holds."\n'
    texts = sorted(tidy.docstrings(source))
    assert texts == ["As read.", "Its size.", "Of a drive.", "What it holds.", "Whether."]
    assert [tidy.begins_without_a_subject(text) for text in texts] == [True, False, True, True, True]
    assert not tidy.begins_without_a_subject("Assembles a frame.")


def test_nothing_is_cleaned_up_by_the_garbage_collector() -> None:
    assert offences(tidy.cleanup_in_del, python_files(*ROOMS)) == []


def test_no_unfinished_work() -> None:
    assert offences(tidy.leftovers, text_files(), RULES_THEMSELVES) == []


def test_every_exemption_names_its_rule() -> None:
    assert offences(tidy.unnamed_exemptions, text_files(), RULES_THEMSELVES) == []


def test_no_path_of_one_machine() -> None:
    assert offences(tidy.machine_paths, text_files(), RULES_THEMSELVES) == []


def test_set_up_names_no_package_index() -> None:
    files = [*ROOT.glob("*.lock"), ROOT / "Makefile", ROOT / "pyproject.toml"]
    files += [path for path in (ROOT / ".ci").rglob("*") if path.is_file()]
    assert offences(tidy.package_indexes, files) == []


@pytest.mark.parametrize(
    ("rule", "bad", "good"),
    [
        (tidy.too_long, "x = 1\n" * 400, "x = 1\n" * 399),
        (tidy.too_long, "def f():\n" + "    x = 1\n" * 69, "def f():\n" + "    x = 1\n" * 68),
        (imports_time, "def f():\n    import time\n", "import timeit\n"),
        (imports_time, "from time import sleep\n", "from .time import sleep\n"),
        (
            loop_imports,
            "from servobench.virtual_bus.bus.hub import HubBus\n",
            "from servobench.drivers.exchange import Reading\n",
        ),
        (loop_imports, "import can.interfaces\n", "import canopen\n"),
        (
            tidy.broad_excepts,
            "try:\n    f()\nexcept Exception:\n    pass\n",
            "try:\n    f()\nexcept OSError:\n    pass\n",
        ),
        (tidy.broad_excepts, "try:\n    f()\nexcept:\n    pass\n", "try:\n    f()\nexcept:\n    raise\n"),
        (tidy.missing_docstrings, '"""Doc."""\ndef f(): ...\n', '"""Doc."""\ndef _f(): ...\n'),
        (tidy.missing_docstrings, "x = 1\n", ""),
        (
            tidy.cleanup_in_del,
            "class A:\n    def __del__(self): ...\n",
            "class A:\n    def delete(self): ...\n",
        ),
        (tidy.leftovers, "# TODO mend\n", "# Todos los pares\n"),
        (tidy.leftovers, "@pytest.mark.xfail\n", "@pytest.mark.skip\n"),
        (tidy.unnamed_exemptions, "f()  # type: ignore\n", "f()  # type: ignore[misc]\n"),
        (tidy.unnamed_exemptions, "f()  # noqa\n", "f()  # noqa: B008\n"),
        (tidy.machine_paths, "see /" + "home/someone\n", "see ~/" + "home/someone and a/" + "work/b\n"),
        (tidy.package_indexes, "--index-url x\n", "make lock\n"),
    ],
)
def test_each_rule_finds_its_offence(rule: Rule, bad: str, good: str) -> None:
    assert list(rule(bad))
    assert not list(rule(good))


def pins(lock: str) -> dict[str, list[Requirement]]:
    """Canonical name -> pinned requirements of a lock file (one for each range of interpreters)."""
    found: dict[str, list[Requirement]] = {}
    for line in (ROOT / lock).read_text(encoding="utf-8").splitlines():
        if re.match(r"[A-Za-z0-9]", line):
            requirement = Requirement(line.rstrip(" \\"))
            found.setdefault(canonicalize_name(requirement.name), []).append(requirement)
    return found


def unmet(wanted: Iterable[str], lock: str) -> list[str]:
    """Requirements that the lock file does not pin to a version they allow."""
    locked = pins(lock)
    missing = []
    for requirement in map(Requirement, wanted):
        versions = [
            next(iter(pin.specifier)).version for pin in locked.get(canonicalize_name(requirement.name), [])
        ]
        if not versions or not all(requirement.specifier.contains(version) for version in versions):
            missing.append(str(requirement))
    return missing


def test_the_lock_files_pin_what_the_project_asks_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras = project["project"]["optional-dependencies"]
    runtime = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    runtime += [*extras["view"], *extras["design"], *extras["report"]]

    assert unmet(runtime, "requirements.lock") == []
    for group, lock in (("dev", "requirements-dev.lock"), ("bench", "requirements-bench.lock")):
        assert unmet(project["dependency-groups"][group], lock) == []
    assert unmet([*extras["campaign"], *extras["mf4"]], "requirements-dev.lock") == []
    assert unmet(["numpy<1", "not-in-there>=1"], "requirements.lock") == ["numpy<1", "not-in-there>=1"]


def test_tools_and_runtime_agree_where_both_pin_a_package() -> None:
    runtime, tools = pins("requirements.lock"), pins("requirements-dev.lock")
    shared = runtime.keys() & tools.keys()
    assert shared
    differing = {
        name
        for name in shared
        if {str(pin.specifier) for pin in runtime[name]} != {str(pin.specifier) for pin in tools[name]}
    }
    assert differing == set()


@pytest.mark.parametrize("lock", sorted(path.name for path in ROOT.glob("requirements*.lock")))
def test_every_pin_is_exact_and_hashed(lock: str) -> None:
    entries = re.split(r"\n(?=[A-Za-z0-9])", (ROOT / lock).read_text(encoding="utf-8"))[1:]
    assert len(entries) == sum(map(len, pins(lock).values()))
    assert [
        entry.splitlines()[0] for entry in entries if "==" not in entry or "--hash=sha256:" not in entry
    ] == []


@pytest.mark.parametrize(
    "script",
    [
        ".ci/run",
        ".ci/test-vcan",
        ".ci/test-can",
        ".ci/uml/run",
        ".ci/uml/init",
        ".ci/qemu/run",
        ".ci/qemu/inside",
    ],
)
def test_scripts_can_be_run(script: str) -> None:
    assert os.access(ROOT / script, os.X_OK)

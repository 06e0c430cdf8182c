"""Compiled modules are used only where they were made from the present sources, for this Python."""

import json
from pathlib import Path

import pytest

from servobench.drivers.compiled import MANIFEST, PURE, SUFFIX, SourcesOf, digest_of, look, notice, remedy

WIRE, LOOP, BUS, DEVICE = "drivers/a.py", "hil/b.py", "virtual_bus/c.py", "virtual_bus/d.py"
AGAINST = {"wire": [], "loop": ["wire"], "bus": ["wire"], "device": ["bus"]}
SOURCES = {"wire": WIRE, "loop": LOOP, "bus": BUS, "device": DEVICE}


@pytest.fixture(autouse=True)
def _not_pure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PURE, raising=False)


@pytest.fixture
def built(tmp_path: Path) -> Path:
    """A checkout with four groups of a module each, all compiled."""
    for path in SOURCES.values():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text("x = 1\n")
    (tmp_path / "drivers" / f"compiled_wire__mypyc{SUFFIX}").touch()
    groups = {
        name: {"sources": {path: digest_of(tmp_path / path)}, "against": AGAINST[name]}
        for name, path in SOURCES.items()
    }
    (tmp_path / MANIFEST).write_text(json.dumps({"suffix": SUFFIX, "groups": groups}))
    return tmp_path


def test_the_compiled_modules_of_this_checkout_are_made_from_its_sources() -> None:
    assert not look().unusable


def test_a_fresh_build_is_used_whole(built: Path) -> None:
    build = look(built)
    assert build.compiled == ("wire", "loop", "bus", "device")
    assert build.sources == frozenset(SOURCES.values())
    assert (build.why, build.unusable, notice(build)) == ("", False, None)


@pytest.mark.parametrize(
    ("edited", "compiled"),
    [
        (WIRE, ()),
        (LOOP, ("wire", "bus", "device")),
        (BUS, ("wire", "loop")),
        (DEVICE, ("wire", "loop", "bus")),
    ],
)
def test_an_edit_takes_back_its_group_and_all_compiled_against_it(
    built: Path, edited: str, compiled: tuple[str, ...]
) -> None:
    (built / edited).write_text("x = 2\n")
    build = look(built)
    assert build.compiled == compiled
    assert build.sources == {SOURCES[name] for name in compiled}
    assert set(build.held_back) == set(SOURCES) - set(compiled)
    told = notice(build) or ""
    assert edited in told
    assert "\n" not in told


def test_of_many_edits_the_first_are_named_and_the_others_counted(built: Path) -> None:
    for file in SOURCES.values():
        (built / file).write_text("x = 2\n")
    told = notice(look(built)) or ""
    assert [file for file in SOURCES.values() if file in told] == list(SOURCES.values())[:3]
    assert "and 1 more; " in told


def test_a_source_that_went_away_takes_back_its_group(built: Path) -> None:
    (built / DEVICE).unlink()
    assert look(built).held_back == ("device",)


def test_nothing_of_a_build_that_was_cut_short_is_used(built: Path) -> None:
    (built / MANIFEST).unlink()
    build = look(built)
    assert (build.sources, build.unusable) == (frozenset(), True)
    assert "not completed" in (notice(build) or "")


@pytest.mark.parametrize("manifest", [{"suffix": ".cpython-27.so", "groups": {}}, {"hil/b.py": "0"}])
def test_a_build_for_another_python_or_version_is_not_used(built: Path, manifest: dict[str, object]) -> None:
    (built / MANIFEST).write_text(json.dumps(manifest))
    build = look(built)
    assert (build.sources, build.unusable) == (frozenset(), True)


def test_where_nothing_is_compiled_it_is_told_why_and_without_a_notice(tmp_path: Path) -> None:
    assert look(tmp_path).why == "nothing has been compiled"
    (tmp_path / "drivers").mkdir()
    (tmp_path / MANIFEST).write_text(json.dumps({"lack": "no C compiler 'cc' was there"}))
    build = look(tmp_path)
    assert build.why == "no C compiler 'cc' was there"
    assert not build.unusable
    assert notice(build) is None


def test_pure_was_asked_for_and_is_not_told(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PURE, "1")
    build = look(built)
    assert (build.sources, build.unusable) == (frozenset(), True)
    assert notice(build) is None


def test_modules_of_a_group_taken_back_are_found_as_sources(built: Path) -> None:
    (built / LOOP).write_text("x = 2\n")
    finder = SourcesOf(look(built))
    found = finder.find_spec("servobench.hil.b", [str(built / "hil")])
    assert found is not None
    assert found.origin == str(built / LOOP)
    for name, folder in [
        ("servobench.drivers.a", "drivers"),
        ("servobench.drivers.compiled_wire__mypyc", "drivers"),
        ("json.b", "hil"),
    ]:
        assert finder.find_spec(name, [str(built / folder)]) is None
    assert finder.find_spec("servobench", None) is None


def test_the_remedy_is_one_that_is_there(tmp_path: Path) -> None:
    assert remedy() == "make compile"
    assert "install" in remedy(tmp_path)

"""A compiled module that is older than its source is found; those of this checkout are fresh."""

import json
from pathlib import Path

import pytest

from drivers.errors import BadInput
from hil.machine.compiled import (
    MANIFEST,
    compiled_modules,
    digest_of,
    require_fresh,
    stale_modules,
)

SOURCE = "hil/hot.py"


@pytest.fixture
def built(tmp_path: Path) -> Path:
    """A checkout with one compiled module."""
    (tmp_path / "hil").mkdir()
    (tmp_path / "drivers").mkdir()
    (tmp_path / SOURCE).write_text("x = 1\n")
    (tmp_path / "drivers" / "compiled__mypyc.so").touch()
    (tmp_path / MANIFEST).write_text(json.dumps({SOURCE: digest_of(tmp_path / SOURCE)}))
    return tmp_path


def test_the_compiled_modules_of_this_checkout_are_made_from_its_sources() -> None:
    assert stale_modules() == []


def test_nothing_compiled_is_fresh(tmp_path: Path) -> None:
    assert compiled_modules(tmp_path) == {}
    require_fresh(tmp_path)


def test_a_build_is_fresh_until_a_source_changes(built: Path) -> None:
    require_fresh(built)
    (built / SOURCE).write_text("x = 2\n")
    assert stale_modules(built) == [SOURCE]
    with pytest.raises(BadInput, match="make compile"):
        require_fresh(built)


def test_a_source_that_went_away_makes_its_compiled_form_stale(built: Path) -> None:
    (built / SOURCE).unlink()
    assert stale_modules(built) == [SOURCE]


def test_a_build_that_was_cut_short_is_stale(built: Path) -> None:
    (built / MANIFEST).unlink()
    assert stale_modules(built) == [MANIFEST]


def test_another_choice_of_modules_asks_for_another_build(built: Path) -> None:
    assert stale_modules(built, [SOURCE]) == []
    assert stale_modules(built, [SOURCE, "hil/more.py"]) == ["hil/more.py"]
    assert stale_modules(built, ["hil/more.py"]) == ["hil/hot.py", "hil/more.py"]

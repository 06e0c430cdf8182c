"""The reference pages of the documentation say all that there is to say."""

import runpy
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from servobench.hil.verdict.metrics import LIMITED
from servobench.virtual_bus.faults.register import TABLES

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def pages() -> Mapping[str, Callable[[], str]]:
    made: Mapping[str, Callable[[], str]] = runpy.run_path(str(ROOT / "docs/site/reference.py"))["PAGES"]
    return made


def _keys(table: Mapping[str, Any], names: frozenset[str]) -> set[str]:
    """Every key of a file, but for names that its writer chose."""
    found = set()
    for key, value in table.items():
        if key not in names:
            found.add(key)
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, dict):
                found |= _keys(inner, names)
    return found


@pytest.mark.parametrize(
    "name", ["ling2012", "three_axes", "two_segments", "azaiz2007_hinf", "load_machine", "any_bus"]
)
def test_every_key_of_the_examples_is_on_the_page(pages: Mapping[str, Callable[[], str]], name: str) -> None:
    bench = tomllib.loads((ROOT / "examples" / f"{name}.toml").read_text())
    bench.pop("faults", None)  # they have a page of their own
    page = pages["reference/bench.md"]()
    axes = frozenset({*bench["drive"], *bench.get("reference", {}), *bench.get("load", {})})
    missing = {
        key for key in _keys(bench, axes) - {"kind"} if f"`{key}`" not in page and f"{key}]" not in page
    }
    assert {key for key in missing if f".{key}" not in page and f"[{key}" not in page} == set()


def test_every_fault_and_every_command_has_its_section(pages: Mapping[str, Callable[[], str]]) -> None:
    faults = pages["reference/faults.md"]()
    for name, table in TABLES.items():
        assert f"## [[{name}]]" in faults
        assert all(f"`{key}`" in faults for key in table.model_fields)
    commands = pages["reference/commands.md"]()
    tables = "".join((ROOT / "docs" / name).read_text() for name in ("running.md", "real-drive.md"))
    named = [line for line in tables.splitlines() if line.startswith("| `hil ")]
    assert len(named) > 10
    for line in named:
        words = line.split("`")[1].split()
        lower = [word for word in words if word.islower() and word.isalpha()]
        assert f"## {' '.join(lower)}" in commands, line


def test_a_page_holds_defaults_bounds_and_words(pages: Mapping[str, Callable[[], str]]) -> None:
    page = pages["reference/bench.md"]()
    assert "| `period_us` | integer >= 100, <= 1000000 | `1000` |" in page
    assert (
        "| `deadline_us` | integer > 0 | `2000` | A reading older than this when it arrives is LATE. |"
        in page
    )
    assert "## [[load.NAME]]" in page


def test_every_limit_and_every_column_has_its_line(pages: Mapping[str, Callable[[], str]]) -> None:
    limits = pages["reference/verdict.md"]()
    assert (
        "| `delay_p99_us_max` | number > 0 | delay of readings, p99 [us] | Delay of readings, 99 %. |"
        in limits
    )
    assert all(f"| `{name}` |" in limits for name in LIMITED)
    columns = pages["reference/columns.md"]()
    assert (
        "| `fate` | int8 |  | what came of its reading: 0 sample, 1 lost, 2 late, 3 stale, 4 missed |"
        in columns
    )
    assert (
        "| `phase` | string |  | in which phase of the bench the row was taken: calibrating, run," in columns
    )
    assert all(
        f"| `{name}` |" in columns for name in ("due_at", "channel_7", "load_gain_rad_s_nm", "outcome")
    )

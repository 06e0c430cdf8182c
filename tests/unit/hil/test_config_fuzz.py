"""Whatever stands in a bench file, the answer is a bench or errors that name their place."""

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.errors import BadInput, printable
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config_files import BadInputs, bad_inputs_of, toml_text
from tests.draws import examples_of
from tests.unit.hil.test_toml_text import VALUES

pytestmark = pytest.mark.long

EXAMPLES = Path(__file__).parents[3] / "examples"
Path_ = tuple[str | int, ...]


def bench_tables() -> dict[str, Any]:
    """The example with its motor and faults inline, so that they are struck as well."""
    raw = tomllib.loads((EXAMPLES / "ling2012.toml").read_text())
    raw["drive"]["axis1"]["motor"] = tomllib.loads((EXAMPLES / "motors" / "ling2012.toml").read_text())
    raw["faults"] = tomllib.loads((EXAMPLES / "faults" / "demo.toml").read_text())
    return raw


def paths(node: Any, above: Path_ = ()) -> Iterator[Path_]:
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for step, child in children:
        yield (*above, step)
        yield from paths(child, (*above, step))


PATHS = sorted(paths(bench_tables()), key=str)


def put(raw: Any, path: Path_, value: Any) -> None:
    node = raw
    for step in path[:-1]:
        node = node[step]
    node[path[-1]] = value


@examples_of(400)
@given(st.sampled_from(PATHS), VALUES)
def test_any_value_anywhere(path: Path_, value: Any) -> None:
    raw = bench_tables()
    put(raw, path, value)
    check(raw)


@examples_of(200)
@given(
    st.sampled_from([path for path in PATHS if isinstance(path[-1], str)]), st.text(min_size=1, max_size=9)
)
def test_any_key_anywhere(path: Path_, key: str) -> None:
    raw = bench_tables()
    put(raw, (*path[:-1], key), 1)
    check(raw)


@examples_of(100)
@given(
    st.lists(st.sampled_from([path for path in PATHS if isinstance(path[-1], str)]), min_size=1, max_size=4)
)
def test_any_keys_missing(missing: list[Path_]) -> None:
    raw = bench_tables()
    for path in missing:
        node: Any = raw
        for step in path[:-1]:
            node = node.get(step, {}) if isinstance(node, dict) else node[step] if node else {}
        if isinstance(node, dict):
            node.pop(path[-1], None)
    check(raw)


def check(raw: dict[str, Any]) -> None:
    try:
        config = bench_from(raw, "bench.toml", EXAMPLES)
    except (BadInput, BadInputs) as error:
        for item in bad_inputs_of(error):
            assert item.source == "bench.toml"
            assert printable(str(item)) == str(item)
            assert len(str(item)) < 600
    else:
        again = bench_from(tomllib.loads(config.resolved_text()), "bench.toml", Path("/nonexistent"))
        assert again.resolved_text() == config.resolved_text()
        assert toml_text(tomllib.loads(config.resolved_text())) == config.resolved_text()

"""TOML text: whatever is written reads back equal."""

import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.hil.configuration.config_files import toml_text
from tests.draws import examples_of

KEYS = st.text(
    alphabet=st.characters(blacklist_categories=["Cs"]),
    min_size=1,
    max_size=6,
)
SCALARS = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False),
    st.text(alphabet=st.characters(blacklist_categories=["Cs"]), max_size=8),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(KEYS, inner, max_size=3)),
    max_leaves=12,
)
TABLES = st.dictionaries(KEYS, VALUES, max_size=5)


@pytest.mark.long
@examples_of(300)
@given(TABLES)
def test_reads_back_equal(tables: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(tables)) == tables


def test_is_laid_out_as_tables() -> None:
    text = toml_text({"bench": {"name": "a"}, "load": {"axis1": [{"at_s": 1.0}, {"at_s": 2.0}]}})
    expected = '[bench]\nname = "a"\n\n[[load.axis1]]\nat_s = 1.0\n\n[[load.axis1]]\nat_s = 2.0\n'
    assert text == expected


def test_refuses_what_toml_does_not_know() -> None:
    with pytest.raises(TypeError, match="NoneType"):
        toml_text({"a": None})

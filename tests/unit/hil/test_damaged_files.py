"""JSON that a run or a commissioning left, damaged since, is refused by file."""

from collections.abc import Callable
from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.campaign.store import plan_in
from servobench.hil.recorded.commissioning_page import commissioning_page
from servobench.hil.recording.run_metadata import read_summary

READERS: dict[str, Callable[[Path], object]] = {
    "figures.json": commissioning_page,
    "summary.json": read_summary,
}
DEEP = "[" * 100_000
"""What json.loads answers with a RecursionError."""


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", DEEP, '{"sweep": 1e999}', "\udcff"],
    ids=["empty", "open", "list", "null", "deep", "infinite", "not UTF-8"],
)
def test_a_damaged_file_is_refused_by_name(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / "recording").mkdir()
    (tmp_path / name).write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(BadInput) as refused:
        READERS[name](tmp_path)
    assert str(refused.value.source) == str(tmp_path / name)


def test_a_file_that_lacks_what_it_is_read_for_is_refused(tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text('{"sweep": 1}')
    with pytest.raises(BadInput, match=r"summary\.json"):
        read_summary(tmp_path)


def test_a_campaigns_plan_that_is_not_there_is_told_as_such(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="the folder of a campaign"):
        plan_in(tmp_path)

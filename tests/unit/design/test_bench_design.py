"""The benchmark's parts: what is asked for runs, and no longer than that."""

import sys

import pytest

from tests.benchmarks.bench_design import PARTS, main


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    """``bench_design`` with ``arguments``."""
    monkeypatch.setattr(sys, "argv", ["bench_design", *arguments])
    main()


def test_help_names_the_parts_and_runs_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        run(monkeypatch, "--help")
    assert end.value.code == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in PARTS)
    assert "p50" not in printed


def test_an_unknown_part_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit) as end:
        run(monkeypatch, "loop")
    assert end.value.code == 2


def test_a_part_ends_with_its_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, "orders", "--seconds", "0")
    assert capsys.readouterr().out.startswith("0 random stable loops")


def test_a_part_goes_on_where_it_was_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, "orders", "--first", "199")
    assert capsys.readouterr().out.startswith("2 random stable loops")

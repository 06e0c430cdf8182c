"""What is said of fault plans with a value that does not belong there."""

import tomllib
from pathlib import Path
from typing import Final

import pytest

from servobench.virtual_bus.faults.fault_plan import load_fault_plan
from tests.told import ROOT, hold, struck

PLANS: Final = sorted((ROOT / "examples" / "faults").glob("*.toml"))


@pytest.mark.parametrize("plan", PLANS, ids=lambda plan: plan.stem)
def test_what_is_told_of_a_bad_plan(plan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(plan.parent)
    tables = tomllib.loads(plan.read_text(encoding="utf-8"))
    lines = struck(tables, lambda changed: load_fault_plan(changed, plan.name))
    hold("\n".join(lines), Path(__file__).with_name("told") / f"plan_{plan.stem}.txt")

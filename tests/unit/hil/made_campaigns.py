"""Campaigns of made-up rows: a sweep over the example bench, its rows stored as a campaign stores them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from servobench.hil.campaign.campaign import Campaign
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.store import open_campaign
from servobench.hil.campaign.sweep_file import sweep_from
from servobench.hil.campaign.worker import FIGURES, Row

LING: Final = Path(__file__).parents[3] / "examples" / "ling2012.toml"
INERTIA: Final[dict[str, Any]] = {
    "key": "drive.axis1.motor.mechanics.inertia_kg_m2",
    "distribution": "log_uniform",
    "low": 0.0004,
    "high": 0.0016,
}
LOSS: Final = "faults.loss.0.probability"
GAIN: Final = "drive.axis1.controller.proportional_nm_s_rad"
_PASSED: Final[dict[str, Any]] = {
    "outcome": "passed",
    "passed": True,
    "completed": True,
    "reason": "",
    "certificate": "",
    "premises_left": "",
    "premises_unknown": "",
    **dict.fromkeys(FIGURES),
}


def plan_of(
    seeds: int = 1, name: str = "made-up", source: str | Path = "sweep.toml", **more: Any
) -> CampaignPlan:
    """``more``: further tables of the sweep file."""
    tables = {"campaign": {"name": name, "bench": str(LING), "seeds": seeds}, **more}
    return CampaignPlan(sweep_from(tables, str(source)), Path(source))


def campaign_of(folder: Path, plan: CampaignPlan, rows: Sequence[Mapping[str, Any]]) -> Campaign:
    """``rows``: what each run has beside its draw and a pass without figures."""
    stored: list[Row] = []
    for number, row in enumerate(rows):
        run = plan.run(number)
        drawn = {name: getattr(run, name) for name in ("point", "replicate", "seed", "weight", "counts")}
        stored.append({"run": number, **drawn, **run.labels, **_PASSED, "digest": f"{number:04x}", **row})
        if plan.rounds is not None:
            plan.rounds.take(stored[-1:])
    with open_campaign(folder, plan, resume=False) as store:
        store.append(stored)
    return Campaign(folder, plan)


def grid(losses: Sequence[float], kinds: Sequence[str]) -> dict[str, Any]:
    """Two axes of a sweep: one of numbers, and one of ``kinds``, which are texts."""
    gains = [0.05 + 0.01 * place for place in range(len(kinds))]
    return {
        "vary": [{"key": LOSS, "values": list(losses)}, {"key": GAIN, "values": gains, "labels": list(kinds)}]
    }

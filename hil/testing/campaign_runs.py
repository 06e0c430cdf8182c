"""Campaigns of tests: a sweep file, or its tables."""

import itertools
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from servobench.hil.campaign.campaign import Campaign, run_campaign
from servobench.hil.configuration.bench_file import PathLike
from servobench.hil.configuration.config_files import toml_text


class CampaignRunner:
    """The fixture ``servo_campaign``: call it with a sweep to run it."""

    def __init__(self, scratch: Path, folder: Path) -> None:
        """``folder``: start of the bench path in a sweep that is no file."""
        self._scratch = scratch
        self._folder = folder
        self._numbers = itertools.count(1)

    def __call__(self, sweep: PathLike | Mapping[str, Any], *, workers: int = 1) -> Campaign:
        """Run a sweep file, or its tables, in simulated time; ``workers``: processes, 1: this one.

        Raises BadInput or BadInputs; the campaign holds the results of the runs.
        """
        number = next(self._numbers)
        if isinstance(sweep, Mapping):
            tables = deepcopy(dict(sweep))
            campaign = tables.get("campaign")
            if isinstance(campaign, dict) and isinstance(campaign.get("bench"), str):
                campaign["bench"] = str((self._folder / campaign["bench"]).absolute())
            sweep = self._scratch / f"sweep-{number}.toml"
            sweep.write_text(toml_text(tables), encoding="utf-8")
        return run_campaign(sweep, self._scratch / f"campaign-{number}", workers=workers)

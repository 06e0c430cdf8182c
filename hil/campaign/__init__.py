"""Many runs of a bench: ``from hil import campaign``; docs/campaigns.md.

What is named here is public and found when it is asked for; the modules below are not.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.campaign.campaign import Campaign, CampaignProgress, run_campaign
    from hil.campaign.plan import CampaignPlan

__all__ = ["Campaign", "CampaignPlan", "CampaignProgress", "run_campaign"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module("hil.campaign.campaign"), name)
    raise AttributeError(f"module 'hil.campaign' has no attribute {name!r}")

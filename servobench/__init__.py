"""servobench from Python: benches and campaigns (``docs/python.md``), and what a controller of the user's own
is written with, version 1 of the protocol (``docs/control.md``).

What is named here is public and imported when it is asked for. The packages below hold the rest, which may
change: ``hil`` (the bench), ``virtual_bus`` (the simulated world), ``drivers`` (the wire) and ``design``.
"""

from importlib import import_module
from os.path import dirname, realpath
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servobench.drivers.cia402.profile import State
    from servobench.drivers.errors import (
        BadInput,
        BenchError,
        BusDown,
        DriveInFault,
        LimitExceeded,
        NoAnswer,
        PeerFault,
    )
    from servobench.drivers.exchange import Command, Reading
    from servobench.hil.campaign.campaign import Campaign, CampaignProgress
    from servobench.hil.campaign.campaign import run_campaign as campaign
    from servobench.hil.campaign.plan import CampaignPlan
    from servobench.hil.configuration.bench_file import Bench
    from servobench.hil.control.setup import Setup
    from servobench.hil.loop.protocol import (
        PROTOCOL_VERSION,
        Compensator,
        Context,
        Controller,
        PositionSetPoint,
        SetPoint,
        SpeedSetPoint,
        TorqueSetPoint,
    )
    from servobench.hil.loop.samples import Sample, StateEstimate
    from servobench.hil.testing.one_run import run
    from servobench.hil.testing.run import Run
    from servobench.hil.twin.twin import Twin, fit

_HOMES = {
    "drivers.cia402.profile": ("State",),
    "drivers.errors": (
        "BadInput",
        "BenchError",
        "BusDown",
        "DriveInFault",
        "LimitExceeded",
        "NoAnswer",
        "PeerFault",
    ),
    "drivers.exchange": ("Command", "Reading"),
    "hil.campaign.campaign": ("Campaign", "CampaignProgress"),
    "hil.campaign.plan": ("CampaignPlan",),
    "hil.configuration.bench_file": ("Bench",),
    "hil.control.setup": ("Setup",),
    "hil.loop.protocol": (
        "PROTOCOL_VERSION",
        "Compensator",
        "Context",
        "Controller",
        "PositionSetPoint",
        "SetPoint",
        "SpeedSetPoint",
        "TorqueSetPoint",
    ),
    "hil.loop.samples": ("Sample", "StateEstimate"),
    "hil.testing.one_run": ("run",),
    "hil.testing.run": ("Run",),
    "hil.twin.twin": ("Twin", "fit"),
}

__all__ = [
    "PROTOCOL_VERSION",
    "BadInput",
    "Bench",
    "BenchError",
    "BusDown",
    "Campaign",
    "CampaignPlan",
    "CampaignProgress",
    "Command",
    "Compensator",
    "Context",
    "Controller",
    "DriveInFault",
    "LimitExceeded",
    "NoAnswer",
    "PeerFault",
    "PositionSetPoint",
    "Reading",
    "Run",
    "Sample",
    "SetPoint",
    "Setup",
    "SpeedSetPoint",
    "State",
    "StateEstimate",
    "TorqueSetPoint",
    "Twin",
    "campaign",
    "fit",
    "run",
]

# In a checkout the packages are links to the folders beside this one: each of its files has one name, that of
# the folder, in tracebacks and for breakpoints.
__path__ = [dirname(realpath(f"{each}/hil")) for each in __path__]


def __getattr__(name: str) -> Any:
    home = (
        "hil.campaign.campaign"
        if name == "campaign"
        else next((home for home, names in _HOMES.items() if name in names), None)
    )
    if home is not None:
        try:
            module = import_module(f"servobench.{home}")
        except ModuleNotFoundError as error:
            from servobench.hil.machine.extras import missing_extra

            raise missing_extra(error, f"servobench {name.lower()}") or error from None
        return getattr(module, "run_campaign" if name == "campaign" else name)
    raise AttributeError(f"module 'servobench' has no attribute {name!r}")

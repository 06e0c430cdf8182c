"""The plans under which a run is held against the truth, one line each, with what is asked of it.

Faults are written as in a fault plan, on one line. Asked of every plan: no certain row is wrong, every
planned cycle and every SYNC has its row, no SYNC is handed over less than half a period after the last. Where
nothing else is said, every uncertain row lies within 50 cycles of a step of the clock, delays are right
within 2 us (p99) and no instant of sampling is further off than its row says.
"""

import tomllib
from dataclasses import dataclass
from typing import Any, Final, Literal

DELAY_ERROR_P99_US: Final = 2.0
NO_LIMIT: Final = float("inf")
"""What is measured and printed, and not asked."""


@dataclass(frozen=True, slots=True)
class Plan:
    """One bench and what befalls it."""

    name: str
    faults: str = ""
    """TOML."""
    axes: int = 1
    stamps: bool = True
    """Whether 1013h comes with every speed."""
    period_us: int = 1000
    deadline_us: int = 2000
    drift_ppm: float = 0.0
    """Of the first drive; the second drifts the other way, the third not at all."""
    actuation: str = "on_arrival"
    acts_at_age_us: int | None = None
    """With the compensator ``stamp``, at this age of the reading."""
    clock_starts_at_us: int | None = None
    """1013h of every drive at power-on; None: drawn from the seed."""
    decides: bool = True
    """The data decide which SYNC every reading answers; else rows may be uncertain anywhere."""
    delay_us: float = DELAY_ERROR_P99_US
    """Largest error of the delay, p99."""
    sync: Literal["own", "kernel", "foreign"] = "own"
    """Who makes the SYNC."""
    producer_period_us: int = 1000
    """Of another node that makes the SYNC, by the bench's clock."""
    producer_jitter_us: int = 0
    """Each of its SYNCs comes up to so much later."""
    commands: bool = False
    """The reference moves so fast that hardly any two neighbouring commands are equal, and the way of the
    commands is asked for too: losses within 1 percentage point."""
    command_delay_us: float = 100.0
    """Largest error of the delays told of the commands: p50, p99 and largest."""

    @property
    def heard(self) -> bool:
        """Whether the loop makes no SYNC itself."""
        return self.sync != "own"

    def fault_tables(self) -> dict[str, Any]:
        """As a fault plan file has them."""
        return tomllib.loads(self.faults)


def _fault(kind: str, *keys: str) -> str:
    return f"{kind} = [{{{', '.join(keys)}}}]\n"


def _span(key: str, least_us: int, most_us: int | None) -> str:
    return f"{key}_min_us = {least_us}, {key}_max_us = {least_us if most_us is None else most_us}"


def _delay(least_us: int, most_us: int | None = None, *more: str) -> str:
    """Of readings on their way in."""
    return _fault("delay", _span("delay", least_us, most_us), _IN, *more)


def _late(least_us: int, most_us: int | None = None) -> str:
    """Of the host, in one cycle of some fifty."""
    return _fault("host_stall", "every_s = 0.0473", _span("late", least_us, most_us))


def _step(step_us: int, *more: str) -> str:
    """Of the drives' clocks."""
    return _fault("clock_step", "at_s = 0.7", f"step_us = {step_us}", *more)


def _slow(least_us: int, most_us: int) -> str:
    """TPDOs come later out of the drive."""
    return _fault("slow_drive", _span("tpdo_delay", least_us, most_us))


_IN: Final = 'direction = "drive_to_host"'
_OUT: Final = 'direction = "host_to_drive"'
_SYNC: Final = 'direction = "host_to_drive", frames = ["sync"]'
_BEHIND: Final = 'side = "drive"'
_BARS: Final = "edges_us = [100, 200, 400, 900, 3500], counts = [60, 30, 8, 2]"
_LOSS: Final = _fault("loss", "probability = 0.1", _IN)
_SYNC_LOSS: Final = _fault("loss", "probability = 0.05", _SYNC)
_SYNC_PDO_LOSS: Final = _fault("loss", "probability = 0.1", 'frames = ["pdo", "sync"]')
_JITTER: Final = _delay(0, 1500)
_GATEWAY: Final = _delay(5000, None, "from_s = 0.5")
COMMANDS_LATE: Final = _fault("loss", "probability = 0.1", _OUT) + _fault("delay", "delay_us = 600", _OUT)
COMMANDS_LATE_BEHIND: Final = _fault("loss", "probability = 0.1", _OUT, _BEHIND) + _fault(
    "delay", "delay_us = 600", _OUT, _BEHIND
)
_SYNCS_HELD: Final = _fault("delay", _span("delay", 0, 12_000), _SYNC)
_STOPPED: Final = _fault("host_stall", "every_s = 0.0837", "late_us = 30000")
_BLACKOUTS: Final = "blackout = [{from_s = 0.5, duration_s = 0.015}, {from_s = 1.0, duration_s = 0.06}]"
_RANDOM_STEPS: Final = _fault(
    "clock_step", "probability_per_s = 0.9", "step_min_us = -900", "step_max_us = 900"
)

PLANS: Final = (
    Plan("quiet"),
    Plan("quiet, 1003 us", period_us=1003),
    Plan("quiet, on_sync", actuation="on_sync"),
    Plan("quiet, three axes", axes=3),
    # losses
    Plan("loss of readings", _LOSS),
    Plan("loss both ways", _fault("loss", "probability = 0.3")),
    Plan("loss in bursts", _fault("burst", "p_good_to_bad = 0.02, p_bad_to_good = 0.2")),
    Plan("two of three lost", _fault("periodic_loss", "lost = 2", _IN)),
    Plan("blackouts", _BLACKOUTS),
    Plan("SYNCs lost", _SYNC_LOSS),
    Plan("SYNCs lost in bursts", _fault("burst", "p_good_to_bad = 0.01, p_bad_to_good = 0.2", _SYNC)),
    Plan("SYNCs and PDOs lost", _SYNC_PDO_LOSS),
    # delays
    Plan("delay 600 us", _delay(600)),
    Plan("delay 3300 us", _delay(3300), deadline_us=5000),
    Plan("delay 7700 us", _delay(7700), deadline_us=9000),
    Plan("delay 0-300 us", _delay(0, 300)),
    Plan("delay 0-1500 us", _JITTER),
    Plan("delay 0-1500 us, 1003 us", _JITTER, period_us=1003),
    Plan("delay 1-6 ms", _delay(1000, 6000), deadline_us=5000),
    Plan("delay by histogram", _fault("measured_delay", _BARS, _IN)),
    Plan("delay with overtaking", _delay(0, 2500, "reorder = true")),
    Plan("reordering", _fault("reorder", "probability = 0.1", _span("held", 500, 3000), _IN)),
    Plan("duplicates 3 ms later", _fault("duplicate", "probability = 0.3, later_us = 3000", _IN)),
    Plan("duplicates at once", _fault("duplicate", "probability = 0.3", _IN)),
    Plan("gateway from 0.5 s on", _GATEWAY, deadline_us=7000),
    Plan("SYNCs 0-300 us late", _fault("delay", _span("delay", 0, 300), _SYNC)),
    Plan("SYNCs 1200 us late", _fault("delay", "delay_us = 1200", _SYNC)),
    Plan("SYNCs 0-12 ms late", _SYNCS_HELD),
    Plan("SYNCs 0-12 ms late, three axes", _SYNCS_HELD, axes=3),
    Plan("SYNCs twice", _fault("duplicate", "probability = 0.1, later_us = 200", _SYNC)),
    Plan(
        "loss, delay, reordering", _LOSS + _JITTER + _fault("reorder", "probability = 0.05, held_us = 2500")
    ),
    # clocks
    Plan("drift +100 ppm", _JITTER, drift_ppm=100),
    Plan("drift -100 ppm", _JITTER, drift_ppm=-100),
    Plan("drift +1000 ppm", _JITTER, drift_ppm=1000),
    Plan("drift -1000 ppm", _JITTER, drift_ppm=-1000),
    Plan("drift for a second", _fault("clock_drift", "drift_ppm = 80, from_s = 0.4, until_s = 1.4")),
    Plan("clock steps -350 us", _step(-350)),
    Plan("clock steps +2 ms", _step(2_000)),
    Plan("clock steps -2 ms", _step(-2_000)),
    Plan("clock steps +1 s", _step(1_000_000)),
    Plan("clock steps by chance", _RANDOM_STEPS),
    Plan("clock steps, delay", _JITTER + _step(-350)),
    Plan("1013h wraps", clock_starts_at_us=(1 << 32) - 1_000_000),
    # drives and hosts that are late
    Plan("slow drive 0-400 us", _slow(0, 400)),
    Plan("slow drive 1-2.5 ms", _slow(1000, 2500), deadline_us=4000),
    Plan("host 300 us late", _late(300)),
    Plan("host 900 us late", _late(900)),
    Plan("host 0-5 ms late", _late(0, 5000)),
    Plan("host 0-5 ms late, three axes", _late(0, 5000), axes=3),
    Plan("host stopped for longer than the horizon", _STOPPED),
    Plan("host stopped, readings under way", _delay(0, 1600) + _STOPPED),
    Plan("host stopped, readings under way, no stamps", _delay(0, 600) + _STOPPED, stamps=False),
    # without stamps
    Plan("no stamps", stamps=False),
    Plan("no stamps, loss", _LOSS, stamps=False),
    Plan("no stamps, SYNCs lost", _SYNC_LOSS, stamps=False),
    Plan("no stamps, delay 0-500 us", _delay(0, 500), stamps=False),
    Plan("no stamps, delay 0-1500 us", _JITTER, stamps=False, decides=False, delay_us=NO_LIMIT),
    Plan("no stamps, gateway", _GATEWAY, stamps=False, decides=False, delay_us=NO_LIMIT, deadline_us=7000),
    Plan("no stamps, slow drive", _slow(0, 400), stamps=False),
    Plan("no stamps, host late", _late(0, 5000), stamps=False),
    Plan("no stamps, three axes", axes=3, stamps=False),
    # three axes
    Plan("three axes, loss and delay", _LOSS + _delay(0, 900), axes=3),
    Plan("three axes, drift and a step", _step(-350, "nodes = [1]"), axes=3, drift_ppm=500),
    Plan("three axes, no stamps, loss", _LOSS, axes=3, stamps=False),
    # behind the echo
    Plan("SYNCs lost behind the echo", _fault("loss", "probability = 0.05", _SYNC, _BEHIND)),
    Plan("readings lost at the drive", _fault("loss", "probability = 0.1", _IN, _BEHIND)),
    # SYNCs of others
    Plan("kernel's SYNCs", sync="kernel"),
    Plan("kernel's SYNCs and PDOs lost", _SYNC_PDO_LOSS, sync="kernel"),
    Plan("kernel's SYNCs, on_sync", sync="kernel", actuation="on_sync", acts_at_age_us=2000),
    Plan("kernel's SYNCs, host 0-5 ms late", _late(0, 5000), sync="kernel"),
    Plan("another's SYNCs", sync="foreign"),
    Plan(
        "another's SYNCs, jitter and drift",
        sync="foreign",
        producer_period_us=1001,
        producer_jitter_us=200,
        drift_ppm=-1000,
    ),
    Plan(
        "another's SYNCs not heard",
        _fault("loss", "probability = 0.05", _IN, 'frames = ["sync"]'),
        sync="foreign",
    ),
    Plan("another's SYNCs, host 0-5 ms late", _late(0, 5000), sync="foreign", producer_jitter_us=200),
    Plan("another's SYNCs, overtaking", _delay(0, 2500, "reorder = true"), sync="foreign"),
    Plan("another's SYNCs, clock steps -350 us", _step(-350), sync="foreign", producer_jitter_us=200),
    Plan("another's SYNCs, commands", COMMANDS_LATE, sync="foreign", commands=True),
    Plan("kernel's SYNCs, three axes", axes=3, sync="kernel"),
    Plan("kernel's SYNCs, three axes, loss", _LOSS, axes=3, sync="kernel"),
    Plan("another's SYNCs, three axes", axes=3, sync="foreign", producer_jitter_us=200),
    # commands
    Plan("commands", commands=True, command_delay_us=10),
    Plan("commands, three axes", commands=True, axes=3, period_us=2000, command_delay_us=10),
    Plan("commands lost and late", COMMANDS_LATE, commands=True),
    Plan("commands behind the echo", COMMANDS_LATE_BEHIND, commands=True),
    Plan("commands, on_sync", COMMANDS_LATE, commands=True, actuation="on_sync"),
    Plan("commands lost and late, 3 axes", COMMANDS_LATE, commands=True, axes=3, period_us=2000),
)

SHORT: Final = (
    "quiet",
    "SYNCs and PDOs lost",
    "delay with overtaking",
    "duplicates 3 ms later",
    "drift -1000 ppm",
    "clock steps -350 us",
    "clock steps +1 s",
    "SYNCs 1200 us late",
    "SYNCs 0-12 ms late, three axes",
    "host 0-5 ms late",
    "no stamps, loss",
    "kernel's SYNCs and PDOs lost",
    "another's SYNCs, jitter and drift",
    "another's SYNCs, host 0-5 ms late",
    "kernel's SYNCs, three axes",
    "another's SYNCs, three axes",
    "three axes, loss and delay",
    "commands lost and late",
    "commands behind the echo",
)
"""What the tests run, each for a short while."""

"""``hil jog`` and ``hil homing``: one motion of a drive, by its own loops."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

from servobench.drivers.errors import BadInput
from servobench.hil.machine.parent_process import tell_parent
from servobench.hil.terminal.commands import end_with
from servobench.hil.terminal.options import (
    AllowOption,
    BitrateOption,
    DriveBusOption,
    DriveNodeOption,
    DryRunOption,
    HeartbeatTimeoutOption,
    JsonOption,
    UnwatchedOption,
    YesOption,
    allowed,
    valued,
)
from servobench.hil.terminal.output import put

if TYPE_CHECKING:
    from servobench.hil.commissioning.request import PlateLimits
    from servobench.hil.commissioning.sequence import Step


def _rpm(name: str, text: str) -> Any:
    """Declare a speed."""
    return valued(name, "RPM", text, min=0.1, max=1e6)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """Options of a single motion."""

    bus: DriveBusOption
    node: DriveNodeOption
    torque_max_percent: Annotated[
        float, valued("--torque-max-percent", "PERCENT", "Of the rated torque (6076h).", min=0.1, max=300)
    ] = 30.0
    out: Annotated[
        Path | None, valued("--out", "DIR", "Folder of journal and report; default: by command and node.")
    ] = None
    motor: Annotated[
        Path | None, valued("--motor", "NAMEPLATE.toml", "Nameplate, for a drive that lacks a unit.")
    ] = None
    yes: YesOption = False
    dry_run: DryRunOption = False
    heartbeat_timeout_ms: HeartbeatTimeoutOption = 150
    unwatched: UnwatchedOption = False
    allow: AllowOption = None
    bitrate: BitrateOption = 1_000_000
    as_json: JsonOption = False


@dataclass(frozen=True, slots=True, kw_only=True)
class HomingOptions:
    """Options of ``hil homing`` alone."""

    method: Annotated[
        int | None, valued("--method", "N", "6098h; default: the drive's.", min=-128, max=127)
    ] = None
    rpm: Annotated[float, _rpm("--rpm", "Speed of the search for a switch (6099h:1).")] = 60.0
    zero_rpm: Annotated[
        float, _rpm("--zero-rpm", "Speed of the search for the edge or the index (6099h:2).")
    ] = 12.0
    offset_turns: Annotated[
        float | None,
        valued("--offset-turns", "X", "Place of the zero behind the home (607Ch); default: the drive's."),
    ] = None
    turns_max: Annotated[
        float, valued("--turns-max", "X", "Path after which it fails.", min=0.01, max=1e4)
    ] = 10.0
    timeout_s: Annotated[
        float, valued("--timeout-s", None, "Time after which it fails.", min=0.1, max=3600)
    ] = 60.0


def jog(
    shared: MotionOptions,
    turns: Annotated[float, valued("--turns", "X", "Turns of the motor shaft; negative: backwards.")],
    rpm: Annotated[float, _rpm("--rpm", "Speed of the shaft.")] = 60.0,
) -> None:
    """Turn a drive's shaft by some turns, in a mode of speeds or positions, and disable it again.

    It says what it will do, and asks. Any key stops the shaft, and so does every end of the command. What was
    written is undone; hil restore DIR/journal.jsonl does it after a crash.

    Exit status: 0 done, 1 the shaft did not arrive, or an early end, 2 bad input, 3 bus or drive fault, or a
    key, 4 done, and disturbed by others.

    Examples:
      hil jog --bus hub:lab --node 1 --turns 2 --rpm 120 --yes
    """
    from servobench.hil.commissioning.steps_manual import jog_limits, jog_steps

    if not 0.0 < abs(turns) <= 1e4:
        raise BadInput("--turns", "", turns, "a path other than 0, up to 10000")
    move(shared, "jog", jog_limits(turns, rpm, shared.torque_max_percent), lambda: jog_steps(turns))


def homing(shared: MotionOptions, how: HomingOptions) -> None:
    """Run a drive's homing to its end, and disable it again.

    It says what it will do, and asks. Any key stops the shaft, and so does every end of the command. The
    drive knows its home until it is switched off. What was written is undone; hil restore DIR/journal.jsonl
    does it after a crash.

    Exit status: 0 done, 1 no home was found, or an early end, 2 bad input, 3 bus or drive fault, or a key, 4
    done, and disturbed by others.

    Examples:
      hil homing --bus hub:lab --node 1 --method 34 --yes
    """
    import math

    from servobench.drivers.cia402.motion import HomingSetup
    from servobench.drivers.rotation import RAD_S_PER_RPM
    from servobench.hil.commissioning.steps_manual import Home, homing_limits, homing_steps

    offset_rad = None if how.offset_turns is None else how.offset_turns * math.tau
    speeds = HomingSetup(how.rpm * RAD_S_PER_RPM, how.zero_rpm * RAD_S_PER_RPM, None, offset_rad)
    limits = homing_limits(max(how.rpm, how.zero_rpm), shared.torque_max_percent)
    move(
        shared,
        "homing",
        limits,
        lambda: homing_steps(Home(how.method, speeds, how.turns_max, how.timeout_s)),
    )


def move(
    shared: MotionOptions,
    purpose: str,
    limits: "PlateLimits",
    steps: "Callable[[], Sequence[Step]]",
    *,
    store: bool = False,
) -> NoReturn:
    """Run the steps, and leave with their status; ``store``: what they keep is stored in the drive. Raises
    BadInput or BadInputs."""
    from servobench.drivers.wire.adapters import shared_bus
    from servobench.hil.commissioning.request import CommissionRequest, Nameplate, load_nameplate
    from servobench.hil.write_lists import writes_of

    spec = shared_bus(shared.bus, "use hub:NAME and `hil simulate`", "a bus with a drive on it")
    plate = Nameplate() if shared.motor is None else load_nameplate(shared.motor)
    request = CommissionRequest(
        bus=shared.bus,
        node=shared.node,
        out=shared.out or Path(f"{purpose}-node{shared.node}"),
        nameplate=plate.model_copy(update={"limits": limits}),
        bitrate_bit_s=shared.bitrate,
        dry_run=shared.dry_run,
        store=store,
        heartbeat_timeout_ms=shared.heartbeat_timeout_ms,
        unwatched=shared.unwatched,
        allow=allowed(shared.allow),
        purpose=purpose,
    )
    from servobench.hil.commissioning.commission import commission, run_steps

    if not shared.dry_run:
        advice = f"{request.restore_command} puts back what was changed in the drive"
        tell_parent(bus=shared.bus, bitrate=shared.bitrate, nodes=[shared.node], advice=advice)
    status, figures = run_steps(
        request,
        partial(commission, steps=steps, writes=writes_of(purpose)),
        spec,
        yes=shared.yes,
    )
    put(figures, shared.as_json, lambda _figures: None)
    end_with(status)

"""``hil tune``: the gains of a drive's own loops."""

from typing import Annotated

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.jog import MotionOptions, move
from servobench.hil.terminal.options import flag, valued


def tune(
    shared: MotionOptions,
    bandwidth_hz: Annotated[
        float | None, valued("--bandwidth-hz", "F", "Bandwidth asked for, -3 dB.", min=0.1, max=2000)
    ] = None,
    phase_margin_deg: Annotated[
        float | None, valued("--phase-margin-deg", "P", "Or the margin that is kept.", min=30, max=85)
    ] = None,
    rpm: Annotated[float, valued("--rpm", "RPM", "Largest speed of the shaft.", min=1, max=1e6)] = 600.0,
    turns_max: Annotated[
        float, valued("--turns-max", "X", "Path to either side after which it ends.", min=0.1, max=1e4)
    ] = 40.0,
    apply: Annotated[bool, flag("--apply", "Write the gains, and keep them.")] = False,
    store: Annotated[bool, flag("--store", "Have the drive store them (1010h); with --apply.")] = False,
) -> None:
    """Read the gains of a drive's own speed loop, and compute, write and prove others.

    Without a demand it tells them and nothing turns. With one it measures the inertia by speed ramps and the
    loop's lag by sines on its speed, and tells bandwidth and margins before and after. It says what it will
    do, and asks. Any key stops the shaft. What was written is undone, but for what --apply keeps; hil restore
    DIR/journal.jsonl undoes that too.

    Exit status: 0 done, 1 the demand cannot be met, or an early end, 2 bad input, 3 bus or drive fault, or a
    key, 4 done, and disturbed by others.

    Examples:
      hil tune --bus socketcan:can0 --node 1   # shaft free: a real drive
    """
    from servobench.hil.commissioning.steps_tune import TuneRequest, tune_limits, tune_steps

    if store and not apply:
        raise BadInput("--store", "", None, "--apply, or nothing is there to be stored")
    if bandwidth_hz is not None and phase_margin_deg is not None:
        raise BadInput("--phase-margin-deg", "", phase_margin_deg, "one demand: this or --bandwidth-hz")
    how = TuneRequest(bandwidth_hz=bandwidth_hz, phase_margin_deg=phase_margin_deg, apply=apply)
    if apply and not how.asks:
        raise BadInput("--apply", "", None, "--bandwidth-hz or --phase-margin-deg")
    limits = tune_limits(rpm, shared.torque_max_percent, turns_max)
    move(shared, "tune", limits, lambda: tune_steps(how), store=store)

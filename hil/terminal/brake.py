"""``hil brake``: a drive's holding brake."""

from typing import Annotated

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.jog import MotionOptions, move
from servobench.hil.terminal.options import flag, valued


def brake(
    shared: MotionOptions,
    test: Annotated[bool, flag("--test", "Push against the brake, and turn the shaft without it.")] = False,
    slip_deg: Annotated[
        float, valued("--slip-deg", "DEG", "Slip allowed while it is set.", min=0.001, max=90)
    ] = 1.0,
) -> None:
    """Test a drive's holding brake by its output 60FEh: does it hold a torque, and does it release?

    It says what it will do, and asks. Any key stops the shaft, and so does every end of the command, with
    the brake left to the drive as before. hil restore DIR/journal.jsonl undoes what a crash left.

    Exit status: 0 it holds and releases, 1 it slips or sticks, or an early end, 2 bad input, 3 bus or drive
    fault, or a key, 4 done, and disturbed by others.

    Examples:
      hil brake --test --bus socketcan:can0 --node 1   # its brake: a real drive
    """
    from servobench.hil.commissioning.steps_brake import brake_limits, brake_steps

    if not test:
        raise BadInput("--test", "", None, "--test", "hil io shows what 60FEh tells")
    move(shared, "brake", brake_limits(shared.torque_max_percent), lambda: brake_steps(slip_deg))

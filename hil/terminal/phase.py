"""``hil phase``: how a drive commutates its motor."""

from typing import Annotated

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.jog import MotionOptions, move
from servobench.hil.terminal.options import flag, valued


def phase(
    shared: MotionOptions,
    turns_max: Annotated[
        float, valued("--turns-max", "X", "Turns to either side after which it ends.", min=0.01, max=100)
    ] = 2.0,
    apply: Annotated[bool, flag("--apply", "Keep what was found in the drive.")] = False,
    store: Annotated[bool, flag("--store", "Have the drive store it (1010h); with --apply.")] = False,
) -> None:
    """Find a motor's pole pairs, the order of its lines and the commutation offset, and prove them.

    For drives with mode 11, in which a master turns the field. It says what it will do, and asks. Any key
    takes the torque away, and so does every end of the command. What was written is undone, but for what
    --apply keeps; hil restore DIR/journal.jsonl undoes that too, and all after a crash.

    Exit status: 0 found and proved, 1 the rotor does not follow, or an early end, 2 bad input, 3 bus or drive
    fault, or a key, 4 done, and disturbed by others.

    Examples:
      hil phase --bus socketcan:can0 --node 1   # shaft free: a real drive
    """
    from servobench.hil.commissioning.steps_phase import phase_limits, phase_steps

    if store and not apply:
        raise BadInput("--store", "", None, "--apply, or nothing is there to be stored")
    limits = phase_limits(shared.torque_max_percent, turns_max)
    move(shared, "phase", limits, lambda: phase_steps(apply), store=store)

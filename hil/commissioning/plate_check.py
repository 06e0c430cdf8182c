"""What the nameplate says, against the drive's own objects and against nobody."""

import math
from typing import Final

from drivers.cia402.objects402 import Object
from hil.commissioning.outcome import StepFailed, StepOutcome
from hil.commissioning.request import POLE_PAIRS_MAX
from hil.commissioning.session import Session, nameplate_wins

_RATING_TOLERANCE: Final = 0.03
_RATING_SLIP: Final = 1.5
"""Between two words for one rating, as stall and continuous torque: more is a slip of plate or drive."""


def compare_ratings(session: Session, outcome: StepOutcome, torque_nm: float) -> None:
    """6076h and 6075h against the nameplate; the nameplate is believed for the torque, unless one of the two
    must be a slip: then it is asked which."""
    rating = session.request.nameplate.rating
    if rating.torque_nm is None:
        outcome.say("no nameplate: the rated torque 6076h cannot be checked, and every torque rests on it")
    elif _slip(torque_nm, rating.torque_nm) and not nameplate_wins(
        session, "rated torque", f"{rating.torque_nm:g} N m", f"{torque_nm:g} N m (6076h)"
    ):
        outcome.faults.append(
            f"nameplate: rating.torque_nm {rating.torque_nm:g} is not believed, 6076h says {torque_nm:g} N m"
        )
    elif abs(torque_nm / rating.torque_nm - 1.0) > _RATING_TOLERANCE:
        outcome.faults.append(
            f"torque unit: 6076h says {torque_nm:g} N m, the nameplate {rating.torque_nm:g} N m; "
            "the nameplate is taken"
        )
        session.overridden(rated_torque_nm=rating.torque_nm)
        outcome.figures["torque_fault"] = torque_nm / rating.torque_nm
    current_ma = session.objects.read_if_there(Object.MOTOR_RATED_CURRENT)
    if rating.current_a and current_ma and abs(current_ma / 1e3 / rating.current_a - 1.0) > _RATING_TOLERANCE:
        outcome.faults.append(
            f"current unit: 6075h says {current_ma / 1e3:g} A, the nameplate {rating.current_a:g} A rms"
        )
        outcome.figures["current_fault"] = current_ma / 1e3 / rating.current_a


def _slip(told: float, printed: float) -> bool:
    return abs(math.log(told / printed)) > math.log(_RATING_SLIP)


def confirm_pole_pairs(session: Session, outcome: StepOutcome) -> None:
    """Have the number of pole pairs said a second time: CiA 402 has no object for it, and none of torque,
    current, speed and position depends on it. With nobody there it is told to be the nameplate's word alone.
    """
    printed = session.request.nameplate.motor.pole_pairs
    if printed is None:
        return
    session.found.pole_pairs = printed
    outcome.figures["pole_pairs_confirmed"] = session.dialog.attended
    if not session.dialog.attended:
        outcome.say(f"pole pairs: not measurable over CiA 402; {printed}, by the nameplate file alone")
        return
    answer = session.dialog.line(
        "    pole pairs: not measurable over CiA 402. How many has the motor, by plate or data sheet?",
        session.idle,
    )
    if not answer.isdecimal() or not 0 < int(answer) <= POLE_PAIRS_MAX:
        raise StepFailed(
            f"pole pairs: the nameplate file says {printed}, and {answer!r} is no number of them",
            "not measurable over CiA 402",
            "look at the motor's plate, and repeat; or take motor.pole_pairs out of the nameplate file",
        )
    session.found.pole_pairs = int(answer)
    outcome.say(f"pole pairs: not measurable over CiA 402; {answer}, as it was said at the motor")
    if int(answer) != printed:
        outcome.faults.append(
            f"nameplate: motor.pole_pairs {printed} is not believed, {answer} was said at the motor"
        )

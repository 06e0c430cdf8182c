"""What the nameplate says, against the drive's own objects and against nobody."""

import math
from typing import Final

from drivers.cia402.objects402 import Object
from hil.commissioning.findings import BY_NAMEPLATE, Stated
from hil.commissioning.outcome import StepFailed, StepOutcome
from hil.commissioning.request import POLE_PAIRS_MAX
from hil.commissioning.session import Session, nameplate_wins

_RATING_TOLERANCE: Final = 0.03
"""Plates are printed with three digits, and 6075h and 6076h hold whole mA and mN m."""
_RATING_SLIP: Final = 1.5
"""Between two words for one rating, as stall and continuous torque: more is a slip of plate or drive."""


def compare_ratings(session: Session, outcome: StepOutcome, torque_nm: float) -> None:
    """6076h and 6075h against the nameplate; the nameplate is believed for the torque, unless one of the two
    must be a slip: then it is asked which."""
    rating = session.request.nameplate.rating
    if rating.torque_nm is None:
        outcome.say("no nameplate: the rated torque 6076h cannot be checked, and every torque rests on it")
    elif is_slip(torque_nm, rating.torque_nm) and not nameplate_wins(
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
    current_a, source = rated_current(session)
    if rating.current_a and current_a and not _is_rated(session, current_a / rating.current_a):
        outcome.faults.append(
            f"current unit: {source} says {current_a:g} A, the nameplate {rating.current_a:g} A rms"
        )
        outcome.figures["current_fault"] = current_a / rating.current_a


def _is_rated(session: Session, ratio: float) -> bool:
    """Told over printed rms is one, or the peak's where nobody knows which ampere is the drive's."""
    figure = session.found.motor.figures.get("rated_current_a")
    alike = (1.0, math.sqrt(2.0)) if figure is not None and figure.convention == "own" else (1.0,)
    return any(abs(ratio / each - 1.0) <= _RATING_TOLERANCE for each in alike)


def rated_current(session: Session) -> tuple[float | None, str]:
    """A rms, and the object that tells it: the maker's own, whose convention is known, before 6075h."""
    figure = session.found.motor.figures.get("rated_current_a")
    if figure is not None:
        return figure.value, figure.object
    told_ma = session.objects.read_if_there(Object.MOTOR_RATED_CURRENT)
    return (told_ma / 1e3 if told_ma else None), "6075h"


def is_slip(told: float, printed: float) -> bool:
    """One of the two must be misread, or set wrongly."""
    return abs(math.log(told / printed)) > math.log(_RATING_SLIP)


def confirm_pole_pairs(session: Session, outcome: StepOutcome) -> None:
    """Have the number of pole pairs said a second time: CiA 402 has no object for it, and none of torque,
    current, speed and position depends on it. With nobody there it is told to be the nameplate's word alone.
    """
    printed = session.request.nameplate.motor.pole_pairs
    if printed is None:
        return
    session.found.stated["pole_pairs"] = Stated(printed, BY_NAMEPLATE)
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
    session.found.stated["pole_pairs"] = Stated(int(answer), "as said at the motor")
    outcome.say(f"pole pairs: not measurable over CiA 402; {answer}, as it was said at the motor")
    if int(answer) != printed:
        outcome.faults.append(
            f"nameplate: motor.pole_pairs {printed} is not believed, {answer} was said at the motor"
        )

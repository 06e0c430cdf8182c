"""Compares the nameplate with the drive's statements, and decides which to use for unmeasurable quantities.

CiA 402 has no object for pole pairs, resistance and inductance. A maker's objects (drivers/vendors) hold
values entered into the drive, the nameplate file values read from the motor: neither is measured. If they
contradict each other by far, the user is asked.
"""

import math
from dataclasses import replace
from typing import Final

from servobench.design.motor import figure
from servobench.design.sheet_figures import Contradiction
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.told_motor import ToldFigure, ToldMotor, read_told_motor
from servobench.drivers.cia402.unit_factors import WINDING_SLIPS, likely_slip
from servobench.drivers.vendors.families import motor_objects_for
from servobench.drivers.vendors.motor_objects import POLE_PAIRS_MAX, QUANTITIES
from servobench.hil.commissioning.findings import BY_NAMEPLATE, Stated, StepFailed, StepOutcome
from servobench.hil.commissioning.request import (
    ImpossiblePlate,
    Nameplate,
    in_which_they_agree,
    refuse_impossible,
)
from servobench.hil.commissioning.session import Session

_RATING_TOLERANCE: Final = 0.03
"""Plates are printed with three digits, and 6075h and 6076h hold whole mA and mN m."""
_RATING_SLIP: Final = 1.5
"""Ratio of two statements of one rating, as stall and continuous torque: more is a slip of plate or drive."""
_POINTS_MAX: Final = 3.0
"""Stall torque over that at the rated speed: two and a half at most of one motor, if wound for high speed."""
_DC_RATIO: Final = 1.2
"""A mains voltage may be a tenth off, and so may the ripple's mean; AC volts for DC are 1.41 off."""
_DC_LINK_MIN_V: Final = 5.0
"""Less is an uncharged link: no drive runs a motor from it."""
CONSTANT_QUANTITY: Final = "torque_constant_nm_a"
CONSTANT_TOLERANCE: Final = 0.1
"""Between the stated torque constant and the measured one: ratings are rounded, and magnets differ by
percents."""
_SLIP_TOLERANCE: Final = 0.05
"""Slips lie a fifth and more apart, and a plate is good to some percent."""
_ALIKE: Final = 0.02
"""Raw values are rounded."""


def nameplate_wins(session: Session, key: str, plate: str, drive: str) -> bool:
    """Return True if the nameplate is right where the drive differs by far, and no measurement decides.

    A misread plate passes for a wrong drive as easily as the other way round: a person has to look. Raises
    StepFailed if unattended, unless the nameplate is to be trusted, or if the answer is neither.
    """
    if session.request.trust_nameplate:
        return True
    contradiction = f"{key}: the nameplate says {plate}, the drive {drive}"
    if not session.dialog.attended:
        raise StepFailed(
            contradiction,
            "nothing measured tells which is right",
            "look at the motor's plate: mend the file if it says something else, or give --trust-nameplate",
        )
    question = f"    {contradiction}. Which is right? [n = nameplate, d = drive]"
    answer = session.dialog.line(question, session.idle).lower()
    if answer not in ("n", "d"):
        raise StepFailed(contradiction, f"{answer!r} is no answer", "look at the motor's plate, and repeat")
    return answer == "n"


def doubt_plate(session: Session, outcome: StepOutcome) -> None:
    """Compare the nameplate with itself and with the DC link.

    Raises StepFailed if its figures cannot be those of one motor, whichever is trusted; an unusual value is a
    finding.
    """
    plate = session.request.nameplate
    try:
        refuse_impossible(plate, "nameplate")
    except ImpossiblePlate as error:
        raise StepFailed("the nameplate contradicts itself", str(error.value), error.expected) from error
    for doubt in plate.figures.doubts():
        outcome.faults.append(f"nameplate: {doubt}; {in_which_they_agree(plate.figures)}")
    printed, link_v = plate.rating.dc_bus_voltage_v, _dc_link_v(session)
    if printed and link_v and not 1.0 / _DC_RATIO <= link_v / printed <= _DC_RATIO:
        mains = abs(link_v / printed / math.sqrt(2.0) - 1.0) < 1.0 - 1.0 / _DC_RATIO
        outcome.faults.append(
            f"nameplate: rating.dc_bus_voltage_v {printed:g} V, while 6079h tells {link_v:.4g} V"
            + ("; an AC voltage taken for that of the DC bus?" if mains else "")
        )


def _dc_link_v(session: Session) -> float | None:
    """Return 6079h; None without it, or while the link is not charged."""
    link_v = (session.objects.read_if_there(Object.DC_LINK_CIRCUIT_VOLTAGE) or 0) / 1000.0
    return link_v if link_v >= _DC_LINK_MIN_V else None


def compare_ratings(session: Session, outcome: StepOutcome, torque_nm: float) -> None:
    """Compare 6076h and 6075h with the nameplate.

    Where they differ, the one is taken that volts, amperes and torque constant allow; if they allow both, the
    drive's for another rated point of the same motor, else the nameplate's. If one of the two must be a slip
    the user is asked. Raises StepFailed for an impossible torque of the nameplate.
    """
    rating = session.request.nameplate.rating
    current_a, source = rated_current(session)
    session.found.rated_current_a = current_a
    if rating.torque_nm is None:
        outcome.say("no nameplate: the rated torque 6076h cannot be checked, and every torque rests on it")
    elif abs(torque_nm / rating.torque_nm - 1.0) > _RATING_TOLERANCE:
        if (
            rating.current_a
            and current_a
            and _same_motor(rating.torque_nm / torque_nm, rating.current_a / current_a)
        ):
            if not 1.0 / _POINTS_MAX <= rating.torque_nm / torque_nm <= _POINTS_MAX:
                nameplate_wins(
                    session,
                    "rated torque and current",
                    f"{rating.torque_nm:g} N m at {rating.current_a:g} A",
                    f"{torque_nm:g} N m at {current_a:g} A (6076h, {source})",
                )
            outcome.say(
                f"6076h and {source} say {torque_nm:g} N m at {current_a:g} A, the nameplate "
                f"{rating.torque_nm:g} N m at {rating.current_a:g} A: two rated points of one motor; "
                "torque is in units of 6076h"
            )
            return
        _settle_torque(session, outcome, torque_nm, rating.torque_nm)
    if rating.current_a and current_a and not _is_rated(session, current_a / rating.current_a):
        outcome.faults.append(
            f"current unit: {source} says {current_a:g} A, the nameplate {rating.current_a:g} A rms"
        )
        outcome.figures["current_fault"] = current_a / rating.current_a


def _same_motor(torques: float, currents: float) -> bool:
    """Return True for ratings that differ in torque and current alike, as stall and rated ones do."""
    return abs(torques / currents - 1.0) <= CONSTANT_TOLERANCE


def _settle_torque(session: Session, outcome: StepOutcome, told_nm: float, printed_nm: float) -> None:
    """Take one of two rated torques that differ."""
    told_cannot, printed_cannot = (_impossible(session, each) for each in (told_nm, printed_nm))
    printed, told = f"{printed_nm:g} N m", f"{told_nm:g} N m (6076h)"
    if printed_cannot:
        raise StepFailed(
            f"rated torque: the nameplate says {printed}, the drive {told}",
            f"the nameplate's cannot be: {printed_cannot}",
            "look at the motor's plate, and mend the nameplate file; with rating.current_a and "
            "rating.dc_bus_voltage_v in it, 6075h and 6079h are not asked",
        )
    slip = not told_cannot and _is_slip(told_nm, printed_nm)
    if slip and not nameplate_wins(session, "rated torque", printed, told):
        outcome.faults.append(
            f"nameplate: rating.torque_nm {printed_nm:g} is not believed, 6076h says {told_nm:g} N m"
        )
        return
    because = f", for 6076h cannot be: {told_cannot}" if told_cannot else ""
    outcome.faults.append(
        f"torque unit: 6076h says {told_nm:g} N m, the nameplate {printed}; the nameplate is taken{because}"
    )
    session.overridden(rated_torque_nm=printed_nm)
    outcome.figures["torque_fault"] = told_nm / printed_nm


def _impossible(session: Session, torque_nm: float) -> Contradiction | None:
    """Return the contradiction of a rated torque with the nameplate's other figures, or the drive's."""
    figures = session.request.nameplate.figures
    current_a, _ = rated_current(session)
    constant = session.found.motor.figures.get(CONSTANT_QUANTITY)
    told = session.found.motor.figures.get("rated_current_a")
    if figures.rated_current_a is None and current_a and (told is None or told.convention != "own"):
        figures = replace(figures, rated_current_a=math.sqrt(2.0) * current_a)
    if not figures.flux and constant is not None and constant.convention != "own":
        figures = replace(figures, flux={"kt_nm_arms": constant.value})
    if figures.dc_bus_voltage_v is None:
        figures = replace(figures, dc_bus_voltage_v=_dc_link_v(session))
    return next(replace(figures, rated_torque_nm=torque_nm).contradictions(), None)


def _is_rated(session: Session, ratio: float) -> bool:
    """Return True if the stated current over the printed rms is one, or the peak's if the drive's convention
    is unknown."""
    figure = session.found.motor.figures.get("rated_current_a")
    alike = (1.0, math.sqrt(2.0)) if figure is not None and figure.convention == "own" else (1.0,)
    return any(abs(ratio / each - 1.0) <= _RATING_TOLERANCE for each in alike)


def rated_current(session: Session) -> tuple[float | None, str]:
    """Return A rms, and its object: the maker's own, whose convention is known, before 6075h."""
    figure = session.found.motor.figures.get("rated_current_a")
    if figure is not None:
        return figure.value, figure.object
    told_ma = session.objects.read_if_there(Object.MOTOR_RATED_CURRENT)
    return (told_ma / 1e3 if told_ma else None), "6075h"


def _is_slip(told: float, printed: float) -> bool:
    """Return True if one of the two must be misread, or set wrongly."""
    return abs(math.log(told / printed)) > math.log(_RATING_SLIP)


def confirm_pole_pairs(session: Session, outcome: StepOutcome) -> None:
    """Have the number of pole pairs confirmed: CiA 402 has no object for it, and no torque, current, speed or
    position depends on it. Unattended it is reported as the nameplate's statement alone."""
    printed = session.request.nameplate.motor.pole_pairs
    if printed is None:
        return
    session.found.stated["pole_pairs"] = Stated(printed, BY_NAMEPLATE)
    outcome.figures["pole_pairs_confirmed"] = session.dialog.attended
    if not session.dialog.attended:
        outcome.say(f"pole pairs: not measurable over CiA 402; {printed}, by the nameplate file alone")
        return
    answer = session.dialog.line(
        "    pole pairs: not measurable over CiA 402. How many pole pairs does the plate or data sheet give?",
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


def keeps_motor(session: Session) -> bool:
    """Return True if the maker's motor objects are known."""
    identity = session.found.identity
    return identity is not None and bool(
        motor_objects_for(identity.vendor, identity.product, identity.device_name)
    )


def read_motor(session: Session, outcome: StepOutcome) -> None:
    """Read the motor data entered into the drive."""
    identity = session.found.identity
    assert identity is not None, "the step 'identity' comes first"
    motor = read_told_motor(session.objects, identity.vendor, identity.product, identity.device_name)
    session.found.motor = motor
    outcome.lines += motor.not_told
    if motor.figures:
        outcome.figures["told_by_drive"] = {
            name: {
                "value": figure.value,
                "object": figure.object,
                "raw": figure.raw,
                "convention": figure.convention,
                "by": figure.family,
            }
            for name, figure in motor.figures.items()
        }


def settle_winding(session: Session, outcome: StepOutcome) -> None:
    """Choose the drive's or the nameplate's value for each quantity. Raises StepFailed if they contradict
    each other by far, and nobody decides."""
    session.found.stated.clear()  # of an attempt that failed
    plate, motor = session.request.nameplate, session.found.motor
    winding = plate.motor
    for name, printed in (
        ("resistance_ohm", winding.resistance_ohm),
        ("inductance_d_h", winding.inductance_d_h),
        ("inductance_q_h", winding.inductance_q_h),
        (CONSTANT_QUANTITY, plate_constant(plate)),
    ):
        _settle(session, outcome, name, printed)
    current, poles = motor.figures.get("rated_current_a"), motor.figures.get("pole_pairs")
    if current is not None:
        title, unit = _named(current)
        outcome.say(f"{title} {current.value:.4g} {unit}, {current}")
    if poles is None:
        confirm_pole_pairs(session, outcome)
    else:
        _settle_pole_pairs(session, outcome, poles)


def plate_constant(plate: Nameplate) -> float | None:
    """Return N m per A rms by a constant of the flux, else by the ratings; None without either."""
    flux = plate.figures.flux_v_s
    return None if flux is None else figure("kt_nm_arms", flux)


def _settle(session: Session, outcome: StepOutcome, name: str, printed: float | None) -> None:
    figure, stated = session.found.motor.figures.get(name), session.found.stated
    if printed is not None:
        stated[name] = Stated(printed, BY_NAMEPLATE)
    if figure is None:
        return
    title, unit = _named(figure)
    line = f"{title} {figure.value:.4g} {unit}, {figure}"
    if printed is None:
        stated[name] = Stated(figure.value, str(figure), told=True)
        outcome.say(f"{line}, and by nobody else; not measured")
        return
    if not _is_slip(figure.value, printed):
        alike = abs(figure.value / printed - 1.0) <= _ALIKE
        outcome.say(
            f"{line}, and {BY_NAMEPLATE}" if alike else f"{line}; the nameplate's {printed:.4g} is taken"
        )
        return
    drive = _by_drive(figure, f"{figure.value:.4g} {unit}", printed)
    if nameplate_wins(session, title, f"{printed:.4g} {unit}", drive):
        outcome.faults.append(f"{line}, is not believed: the nameplate says {printed:.4g} {unit}")
    else:
        stated[name] = Stated(figure.value, str(figure), told=True)
        outcome.faults.append(f"nameplate: {title} {printed:.4g} {unit} is not believed; {drive}")


def _settle_pole_pairs(session: Session, outcome: StepOutcome, figure: ToldFigure) -> None:
    told, printed = int(figure.value), session.request.nameplate.motor.pole_pairs
    session.found.stated["pole_pairs"] = Stated(told, str(figure), told=True)
    outcome.figures["pole_pairs_confirmed"] = printed == told
    if printed is None:
        outcome.say(f"pole pairs: {told}, {figure}, and by nobody else; not measurable over CiA 402")
    elif printed == told:
        outcome.say(f"pole pairs: {told}, {figure}, and {BY_NAMEPLATE}; not measurable over CiA 402")
    else:
        drive = _by_drive(figure, str(told), printed)
        if nameplate_wins(session, "pole pairs", str(printed), drive):
            session.found.stated["pole_pairs"] = Stated(printed, BY_NAMEPLATE)
            outcome.faults.append(
                f"pole pairs: {told}, {figure}, is not believed: the nameplate says {printed}"
            )
        else:
            outcome.faults.append(
                f"nameplate: motor.pole_pairs {printed} is not believed, the drive says {drive}"
            )


def _by_drive(figure: ToldFigure, value: str, printed: float) -> str:
    """Describe the drive's value and the nameplate's, with the slip that would explain the difference."""
    slip = likely_slip(figure.value / printed, WINDING_SLIPS, tolerance=_SLIP_TOLERANCE)
    return f"{value} ({figure.object}{f'; {slip}' if slip else ''})"


def compare_constant(told: ToldMotor, measured: float, outcome: StepOutcome) -> None:
    """Compare the stated torque constant with the measured one, N m/A."""
    figure = told.figures.get(CONSTANT_QUANTITY)
    if figure is None:
        return
    ratio = measured / figure.value
    outcome.figures["told_nm_a"] = figure.value
    outcome.say(f"{figure.value:.5g} N m/A, {figure}")
    if abs(ratio - 1.0) > CONSTANT_TOLERANCE:
        outcome.faults.append(
            f"torque and current contradict the torque constant {figure.value:.4g} N m/A, {figure}, by "
            f"{ratio:.4g}: 6076h, the rated current or {figure.object} is wrong"
        )


def _named(figure: ToldFigure) -> tuple[str, str]:
    quantity = QUANTITIES[figure.quantity]
    own = figure.convention == "own"
    return quantity.title, quantity.unit.replace("A rms", "A of the drive") if own else quantity.unit


def compare_inertia(session: Session, outcome: StepOutcome, inertia_kg_m2: float) -> None:
    """Check that the shaft with its load has no less than the rotor alone by the nameplate."""
    rotor = session.request.nameplate.motor.inertia_kg_m2
    if rotor is not None and inertia_kg_m2 < rotor * (1.0 - CONSTANT_TOLERANCE):
        outcome.faults.append(
            f"inertia {inertia_kg_m2:.4g} kg m^2 is less than that of the rotor alone by the nameplate, "
            f"{rotor:.4g}: the rated torque, on which it rests, is too small, or motor.inertia_kg_m2 is wrong"
        )

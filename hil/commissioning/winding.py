"""What CiA 402 has no object for: pole pairs, resistance, inductance. Whose word is taken for them.

A maker's objects (drivers/vendors) tell what somebody told the drive, the nameplate file what somebody read
off the motor: neither is measured. Where both are there and contradict each other by far, it is asked which.
"""

from typing import Final

from drivers.cia402.told_motor import ToldFigure, ToldMotor, read_told_motor
from drivers.cia402.unit_factors import WINDING_SLIPS, likely_slip
from drivers.vendors.families import motor_objects_for
from drivers.vendors.motor_objects import QUANTITIES
from hil.commissioning.findings import BY_NAMEPLATE, Stated
from hil.commissioning.outcome import StepOutcome
from hil.commissioning.plate_check import confirm_pole_pairs, is_slip
from hil.commissioning.session import Session, nameplate_wins

_CONSTANT: Final = "torque_constant_nm_a"
_CONSTANT_TOLERANCE: Final = 0.1
"""Between the torque constant that was told and the measured one: magnets differ by percents."""
_SLIP_TOLERANCE: Final = 0.05
"""Slips lie a fifth and more apart, and a plate is good to some percent."""
_ALIKE: Final = 0.02
"""Raw values are rounded."""


def keeps_motor(session: Session) -> bool:
    """It is known where the drive's maker keeps the motor."""
    identity = session.found.identity
    return identity is not None and bool(
        motor_objects_for(identity.vendor, identity.product, identity.device_name)
    )


def read_motor(session: Session, outcome: StepOutcome) -> None:
    """What the drive was told of its motor."""
    identity = session.found.identity
    assert identity is not None, "the step 'identity' comes first"
    told = read_told_motor(session.objects, identity.vendor, identity.product, identity.device_name)
    session.found.motor = told
    outcome.lines += told.not_told
    if told.figures:
        outcome.figures["told_by_drive"] = {
            name: {
                "value": figure.value,
                "object": figure.object,
                "raw": figure.raw,
                "convention": figure.convention,
                "by": figure.family,
            }
            for name, figure in told.figures.items()
        }


def settle_winding(session: Session, outcome: StepOutcome) -> None:
    """Take the drive's word or the nameplate's for each quantity. Raises StepFailed if they contradict each
    other by far, and nobody says which is right."""
    session.found.stated.clear()  # of an attempt that failed
    plate, told = session.request.nameplate, session.found.motor
    rating, winding = plate.rating, plate.motor
    constant = rating.torque_nm / rating.current_a if rating.torque_nm and rating.current_a else None
    for name, printed in (
        ("resistance_ohm", winding.resistance_ohm),
        ("inductance_d_h", winding.inductance_d_h),
        ("inductance_q_h", winding.inductance_q_h),
        (_CONSTANT, constant),
    ):
        _settle(session, outcome, name, printed)
    current, poles = told.figures.get("rated_current_a"), told.figures.get("pole_pairs")
    if current is not None:
        title, unit = _named(current)
        outcome.say(f"{title} {current.value:.4g} {unit}, {current}")
    if poles is None:
        confirm_pole_pairs(session, outcome)
    else:
        _settle_pole_pairs(session, outcome, poles)


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
    if not is_slip(figure.value, printed):
        alike = abs(figure.value / printed - 1.0) <= _ALIKE
        outcome.say(
            f"{line}, and {BY_NAMEPLATE}" if alike else f"{line}; the nameplate's {printed:.4g} is taken"
        )
        return
    slip = likely_slip(figure.value / printed, WINDING_SLIPS, tolerance=_SLIP_TOLERANCE)
    drive = f"{figure.value:.4g} {unit} ({figure.object}{f'; {slip}' if slip else ''})"
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
        slip = likely_slip(told / printed, WINDING_SLIPS, tolerance=_SLIP_TOLERANCE)
        drive = f"{told} ({figure.object}{f'; {slip}' if slip else ''})"
        if nameplate_wins(session, "pole pairs", str(printed), drive):
            session.found.stated["pole_pairs"] = Stated(printed, BY_NAMEPLATE)
            outcome.faults.append(
                f"pole pairs: {told}, {figure}, is not believed: the nameplate says {printed}"
            )
        else:
            outcome.faults.append(
                f"nameplate: motor.pole_pairs {printed} is not believed, the drive says {drive}"
            )


def compare_constant(told: ToldMotor, measured: float, outcome: StepOutcome) -> None:
    """The torque constant that was told against the measured one, N m/A."""
    figure = told.figures.get(_CONSTANT)
    if figure is None:
        return
    ratio = measured / figure.value
    outcome.figures["told_nm_a"] = figure.value
    outcome.say(f"{figure.value:.5g} N m/A, {figure}")
    if abs(ratio - 1.0) > _CONSTANT_TOLERANCE:
        outcome.faults.append(
            f"torque and current contradict the torque constant {figure.value:.4g} N m/A, {figure}, by "
            f"{ratio:.4g}: 6076h, the rated current or {figure.object} is wrong"
        )


def _named(figure: ToldFigure) -> tuple[str, str]:
    quantity = QUANTITIES[figure.quantity]
    own = figure.convention == "own"
    return quantity.title, quantity.unit.replace("A rms", "A of the drive") if own else quantity.unit

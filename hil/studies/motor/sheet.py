"""Makes a motor file from a data sheet's figures."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from servobench.design.data_sheet import DataSheet, InconsistentSheet, at_temperature, of_phase
from servobench.design.motor import CONVENTIONS
from servobench.drivers.errors import MISSING, BadInput
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.configuration.config_files import BadInputs, toml_text
from servobench.hil.configuration.motor_file import MotorFile, MotorMechanics, Rating, Windings
from servobench.hil.studies.motor.figures import GROUPS, SEVERAL, missing, option, ways
from servobench.hil.studies.numbers import short

SOURCE = "hil motor new"
WINDING_C = 20.0
"""degrees C at which a sheet gives a resistance if it is not said: most makers' convention (some have 25)."""


class Sheet(NamedTuple):
    """The entries. ``values``: figures by ``SheetFigure.key``."""

    name: str
    values: Mapping[str, float]
    delta: bool = False
    resistance_at_c: float = WINDING_C
    winding_c: float | None = None
    """degrees C to simulate the motor at; None: as on the sheet."""


def data_sheet(sheet: Sheet) -> DataSheet:
    """Return the sheet in one convention. Raises BadInputs: missing, not positive or given twice."""
    values = sheet.values
    errors = list(_errors(values))
    if errors:
        raise BadInputs(errors) if len(errors) > 1 else errors[0]
    phase = {
        key: of_phase(values[name], between_terminals="_line_" in name, delta=sheet.delta)
        for key, name in (
            ("resistance", _given(values, "resistance")),
            ("inductance_mh", _given(values, "inductance")),
        )
    }
    wanted_c = sheet.resistance_at_c if sheet.winding_c is None else sheet.winding_c
    inductance_h = 1e-3 * phase["inductance_mh"]
    quadrature_mh = values.get("lq_phase_mh")
    return DataSheet(
        name=sheet.name,
        pole_pairs=_pole_pairs(values),
        resistance_ohm=at_temperature(phase["resistance"], sheet.resistance_at_c, wanted_c),
        inductance_d_h=inductance_h,
        inductance_q_h=inductance_h
        if quadrature_mh is None
        else 1e-3 * of_phase(quadrature_mh, between_terminals=False, delta=sheet.delta),
        flux={name: values[name] for name in CONVENTIONS if name in values},
        inertia_kg_m2=values["inertia_kg_m2"]
        if "inertia_kg_m2" in values
        else 1e-4 * values["inertia_kg_cm2"],
        rated_torque_nm=values["rated_torque_nm"],
        rated_speed_rad_s=values["rated_speed_rpm"] * RAD_S_PER_RPM,
        dc_bus_voltage_v=values["dc_bus_v"],
        peak_current_a=_peak(values, "peak_current"),
        peak_torque_nm=values.get("peak_torque_nm"),
        rated_current_a=_peak(values, "rated_current"),
        friction_nm=values.get("friction_nm", 0.0),
        viscous_friction_nm_s=values.get("viscous_nm_krpm", 0.0) / (1000.0 * RAD_S_PER_RPM),
        electrical_time_s=_seconds(values, "tau_electrical_ms"),
        mechanical_time_s=_seconds(values, "tau_mechanical_ms"),
    )


def motor_text(sheet: Sheet) -> str:
    """Return the motor file. Raises BadInput or BadInputs, and InconsistentSheet."""
    contradictions = list(data_sheet(sheet._replace(winding_c=None)).contradictions())
    if contradictions:
        raise InconsistentSheet(contradictions)
    entered = data_sheet(sheet)
    motor = entered.motor()
    file = MotorFile(
        motor=Windings(
            name=motor.name,
            resistance_ohm=short(motor.resistance_ohm),
            inductance_d_h=short(motor.inductance_d_h),
            inductance_q_h=short(motor.inductance_q_h),
            flux_linkage_wb=short(motor.flux_linkage_wb),
            pole_pairs=motor.pole_pairs,
            transform="amplitude_invariant",
        ),
        mechanics=MotorMechanics(
            inertia_kg_m2=short(motor.inertia_kg_m2),
            viscous_friction_nm_s=short(motor.viscous_friction_nm_s),
            coulomb_friction_nm=short(motor.coulomb_friction_nm),
        ),
        rating=Rating(
            torque_nm=short(motor.rated_torque_nm),
            speed_rpm=short(motor.rated_speed_rad_s / RAD_S_PER_RPM),
            current_max_a=short(motor.current_max_a),
            dc_bus_voltage_v=short(motor.dc_bus_voltage_v),
        ),
    )
    return "\n".join([*_header(sheet, entered), "", toml_text(file.tables)])


def _header(sheet: Sheet, entered: DataSheet) -> list[str]:
    lines = ["# Made by hil motor new from a data sheet; currents and flux are peaks of a phase.", "#"]
    lines += [f"#   {key} = {value:g}" for key, value in sheet.values.items()]
    lines.append(
        f"#   winding: {'delta' if sheet.delta else 'star'}; the flux is that of {entered.made_flux}"
    )
    if sheet.winding_c is not None and sheet.winding_c != sheet.resistance_at_c:
        lines.append(
            f"#   resistance taken from {sheet.resistance_at_c:g} to {sheet.winding_c:g} degrees C (copper)"
        )
    return lines


def _errors(values: Mapping[str, float]) -> list[BadInput]:
    errors = [
        BadInput(SOURCE, "", MISSING, f"{GROUPS[group].question.lower()}: {_options(group)}")
        for group in missing(values)
    ]
    for key, value in values.items():
        if not (math.isfinite(value) and value > 0.0) and not (
            key in ("friction_nm", "viscous_nm_krpm") and value == 0.0
        ):
            errors.append(BadInput(SOURCE, option(key), value, "a number above zero"))
    for group in GROUPS:
        given = [figure for figure in ways(group) if figure.key in values]
        if len(given) > 1 and group not in SEVERAL and not _same_poles(group, values):
            figures = " and ".join(f"{option(figure.key)} {values[figure.key]:g}" for figure in given)
            errors.append(BadInput(SOURCE, GROUPS[group].question.lower(), figures, "one of them"))
    if not errors and not float(_pole_number(values)).is_integer():
        errors.append(
            BadInput(SOURCE, "--poles", values.get("poles"), "an even number; pairs are half of it")
        )
    return errors


def _same_poles(group: str, values: Mapping[str, float]) -> bool:
    return group == "poles" and values["poles"] == 2.0 * values["pole_pairs"]


def _options(group: str) -> str:
    return " or ".join(option(figure.key) for figure in ways(group))


def _given(values: Mapping[str, float], group: str) -> str:
    return next(figure.key for figure in ways(group) if figure.key in values)


def _pole_number(values: Mapping[str, float]) -> float:
    return values["pole_pairs"] if "pole_pairs" in values else values["poles"] / 2.0


def _pole_pairs(values: Mapping[str, float]) -> int:
    return int(_pole_number(values))


def _peak(values: Mapping[str, float], name: str) -> float | None:
    if f"{name}_arms" in values:
        return math.sqrt(2.0) * values[f"{name}_arms"]
    return values.get(f"{name}_apk")


def _seconds(values: Mapping[str, float], key: str) -> float | None:
    return 1e-3 * values[key] if key in values else None

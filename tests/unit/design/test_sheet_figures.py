"""Figures of a motor against each other: what makers print agrees, and a slip of the pen is found and named.

Yaskawa: SGM7J at 200 V (SGMMV product manual, 4.2.2, page 4-4), SGM7A-15 to -70 (5.2.4, page 5-7), SGMSH
(Sigma II user's manual, 8.1.4), SGMP (SGDB manual, 5.2): rated point, peak, torque constant per A rms, rotor
inertia. Beckhoff: AM8000 manual 2.4, stall torque and current with the rated speed at each mains voltage. The
DC bus is sqrt(2) times the mains.
"""

import math
from dataclasses import replace

import pytest

from servobench.design.data_sheet import readings
from servobench.design.motor import CONVENTIONS, figure
from servobench.design.sheet_figures import FIELDS, SheetFigures

RPM = math.pi / 30.0


def yaskawa(torque: float, peak: float, current: float, most: float, constant: float, inertia: float,
            rpm: float = 3000.0) -> SheetFigures:  # fmt: skip
    """N m, A rms, N m per A rms, 1e-4 kg m^2; at 200 V AC."""
    return SheetFigures(
        rated_torque_nm=torque, peak_torque_nm=peak, rated_current_a=math.sqrt(2.0) * current,
        peak_current_a=math.sqrt(2.0) * most, flux={"kt_nm_arms": constant}, inertia_kg_m2=1e-4 * inertia,
        rated_speed_rad_s=rpm * RPM, dc_bus_voltage_v=math.sqrt(2.0) * 200.0,
    )  # fmt: skip


def beckhoff(torque: float, current: float, rpm: float, mains: float, inertia: float | None) -> SheetFigures:
    return SheetFigures(
        rated_torque_nm=torque, rated_current_a=math.sqrt(2.0) * current, rated_speed_rad_s=rpm * RPM,
        dc_bus_voltage_v=math.sqrt(2.0) * mains, inertia_kg_m2=inertia and 1e-4 * inertia,
    )  # fmt: skip


PUBLISHED = {
    "SGM7J-A5A, 50 W": yaskawa(0.159, 0.557, 0.55, 2.0, 0.316, 0.0395),
    "SGM7J-01A, 100 W": yaskawa(0.318, 1.11, 0.85, 3.1, 0.413, 0.0659),
    "SGM7J-C2A, 150 W": yaskawa(0.477, 1.67, 1.6, 5.7, 0.321, 0.0915),
    "SGM7J-02A, 200 W": yaskawa(0.637, 2.23, 1.6, 5.8, 0.444, 0.263),
    "SGM7J-04A, 400 W": yaskawa(1.27, 4.46, 2.5, 9.3, 0.544, 0.486),
    "SGM7J-06A, 600 W": yaskawa(1.91, 6.69, 4.2, 15.3, 0.493, 0.800),
    "SGM7J-08A, 750 W": yaskawa(2.39, 8.36, 4.4, 16.9, 0.584, 1.59),
    "SGM7A-15A, 1.5 kW": yaskawa(4.90, 14.7, 9.3, 28, 0.590, 2.00),
    "SGM7A-20A, 2 kW": yaskawa(6.36, 19.1, 12.1, 42, 0.561, 2.47),
    "SGM7A-25A, 2.5 kW": yaskawa(7.96, 23.9, 15.6, 51, 0.538, 3.19),
    "SGM7A-30A, 3 kW": yaskawa(9.80, 29.4, 17.9, 56, 0.582, 7.00),
    "SGM7A-40A, 4 kW": yaskawa(12.6, 37.8, 25.4, 77, 0.519, 9.60),
    "SGM7A-50A, 5 kW": yaskawa(15.8, 47.6, 27.6, 84, 0.604, 12.3),
    "SGM7A-70A, 7 kW": yaskawa(22.3, 54.0, 38.3, 105, 0.604, 12.3),
    "SGMSH-10AA, 1 kW": yaskawa(3.18, 9.54, 5.7, 17, 0.636, 1.74),
    "SGMP-08A, 750 W": yaskawa(2.39, 7.1, 4.1, 13.9, 0.641, 2.11),
    "SGMP-15A, 1.5 kW": yaskawa(4.77, 14.3, 7.5, 23.0, 0.687, 4.03),
    "AM8011-wB": beckhoff(0.20, 0.76, 8000, 230, 0.0294),
    "AM8012-wC": beckhoff(0.38, 1.30, 8000, 230, 0.0482),
    "AM8021-wB": beckhoff(0.50, 0.85, 4000, 230, None),
    "AM8022-wD": beckhoff(0.80, 1.50, 8000, 400, None),
    "AM8031-wC": beckhoff(1.37, 1.00, 1400, 230, None),
    "AM8031-wF": beckhoff(1.40, 3.20, 6000, 230, None),
    "AM8032-wD": beckhoff(2.38, 1.70, 3000, 400, None),
    "AM8033-wJ": beckhoff(3.22, 6.80, 9000, 400, None),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_what_makers_print_is_neither_refused_nor_doubted(name: str) -> None:
    figures = PUBLISHED[name]
    assert [*figures.contradictions(), *figures.doubts()] == []
    without = replace(figures, flux={}, inertia_kg_m2=None)
    assert without.is_plausible()


@pytest.mark.parametrize("name", [name for name, figures in PUBLISHED.items() if figures.flux])
@pytest.mark.parametrize(
    ("field", "factor", "reading"),
    [
        ("rated_torque_nm", 1e3, "N mm taken for N m"),
        ("rated_torque_nm", 1e2, "N cm taken for N m"),
        ("rated_current_a", 1e3, "mA taken for A"),
        ("rated_current_a", math.sqrt(2.0), "peak taken for rms"),
        ("rated_current_a", math.sqrt(0.5), "rms taken for peak"),
        ("inertia_kg_m2", 1e4, "kg cm^2 taken for kg m^2"),
    ],
)
def test_a_slip_is_refused_and_named(name: str, field: str, factor: float, reading: str) -> None:
    figures = PUBLISHED[name]
    slipped = replace(figures, **{field: factor * getattr(figures, field)})
    assert next(slipped.contradictions(), None) is not None
    assert any(reading in text for text in readings(slipped)), readings(slipped)


@pytest.mark.parametrize("factor", [2.0, 0.5, math.sqrt(3.0), math.sqrt(1.0 / 3.0), 10.0, 0.1, 1e3])
@pytest.mark.parametrize("field", ["rated_torque_nm", "rated_current_a"])
def test_a_factor_in_torque_or_current_contradicts_the_torque_constant(field: str, factor: float) -> None:
    for figures in PUBLISHED.values():
        if figures.flux:
            slipped = replace(figures, **{field: factor * getattr(figures, field)})
            assert next(slipped.contradictions(), None) is not None


def test_power_without_a_constant_of_the_flux() -> None:
    """sqrt(3) U I of the phase voltage that U_dc/sqrt(3) makes: 283 V and 2.5 A make 866 VA."""
    figures = replace(PUBLISHED["SGM7J-04A, 400 W"], flux={}, peak_torque_nm=None)
    most_nm = math.sqrt(3.0) * (math.sqrt(2.0) * 200.0 / math.sqrt(2.0)) * 2.5 / (3000.0 * RPM)
    assert next(replace(figures, rated_torque_nm=0.99 * most_nm).contradictions(), None) is None
    found = next(replace(figures, rated_torque_nm=1.1 * most_nm).contradictions())
    assert "volts and amperes 866 VA at most" in found.difference
    assert "rated_torque_nm" in found.fields
    assert set(found.fields) <= set(FIELDS)


def test_a_speed_in_rad_s_is_doubted_and_read_right() -> None:
    """314 r/min of a motor that makes 3000 can be, and is seldom meant."""
    figures = PUBLISHED["SGM7A-30A, 3 kW"]
    slipped = replace(figures, rated_speed_rad_s=314.16 * RPM)
    assert next(slipped.contradictions(), None) is None
    assert next(slipped.doubts(), None) is not None
    assert "rated speed 3000 r/min (rad/s taken for r/min)" in readings(slipped)


def test_two_figures_in_each_others_place() -> None:
    figures = PUBLISHED["SGM7A-30A, 3 kW"]
    slipped = replace(figures, rated_torque_nm=17.9, rated_current_a=math.sqrt(2.0) * 9.8)
    assert next(slipped.contradictions(), None) is not None
    assert "rated torque and rated current in each other's place" in readings(slipped)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_every_constant_of_the_flux_is_a_witness(name: str) -> None:
    figures = PUBLISHED["SGM7J-04A, 400 W"]
    constant = figures.emf_constant_v_s
    assert constant is not None
    by_name = replace(figures, flux={name: figure(name, constant)})
    assert by_name.is_plausible()
    assert not replace(by_name, rated_torque_nm=2.54).is_plausible()

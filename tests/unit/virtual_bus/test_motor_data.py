"""The simulated motor in a maker's objects: per phase and rms, whatever the transform of its parameters."""

import math

import pytest

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.vendors.families import motor_objects_for
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.drive.data_sheet import motor_figures, tell_motor
from tests.motors import AZAIZ, LING

MAXON, EPOS4 = 0xFB, "EPOS4 50/5"
MOTORS = pytest.mark.parametrize("motor", [LING, AZAIZ], ids=["power-invariant", "amplitude-invariant"])


def dictionary(vendor: int = MAXON, name: str = EPOS4, without: int | None = None) -> ObjectDictionary:
    """A device whose objects of the motor, but for sub-index ``without``, still hold 12345."""
    made = ObjectDictionary()
    identity = made.add_record(0x1018, "Identity")
    identity.add(1, "Vendor", DataType.UNSIGNED32, default=vendor)
    identity.add(2, "Product", DataType.UNSIGNED32, default=0x60500000)
    made.add(0x1008, "Name", DataType.VISIBLE_STRING, default=name.encode() + b" \0junk")
    data = made.add_record(0x3001, "Motor data")
    for sub in range(1, 6):
        if sub != without:
            data.add(sub, f"{sub}", DataType.UNSIGNED32, default=12345)
    return made


def held(made: ObjectDictionary, sub: int) -> int | None:
    variable = made.get(0x3001, sub)
    assert variable is None or variable.value == variable.default
    return None if variable is None else int(variable.value)


@MOTORS
def test_losses_and_torque_of_three_phases_are_those_of_the_model(motor: PmsmParameters) -> None:
    """Copper losses 3 r I^2, and torque 3 p flux_rms I: the model's r k i_q^2 and k p flux i_q."""
    told = motor_figures(motor)
    in_model = motor.torque_factor * motor.resistance_ohm * motor.rated_current_a**2
    assert 3.0 * told["resistance_ohm"] * told["rated_current_a"] ** 2 == pytest.approx(in_model)
    assert told["rated_current_a"] * told["torque_constant_nm_a"] == pytest.approx(motor.rated_torque_nm)
    flux_rms = motor.flux_linkage_wb / math.sqrt(2.0 if motor is AZAIZ else 3.0)
    assert told["torque_constant_nm_a"] == pytest.approx(3.0 * motor.pole_pairs * flux_rms)
    assert told["pole_pairs"] == motor.pole_pairs
    assert (told["inductance_d_h"], told["inductance_q_h"]) == (motor.inductance_d_h, motor.inductance_q_h)


@MOTORS
def test_the_objects_of_a_maker_hold_it_by_the_maker_s_own_table(motor: PmsmParameters) -> None:
    made = dictionary()
    tell_motor(made, motor)
    ((_, known),) = motor_objects_for(MAXON, 0x60500000, EPOS4)
    figures = motor_figures(motor)
    for each in known.objects:
        if each.index == 0x3001:
            assert held(made, each.sub) == each.raw(figures[each.quantity]) != 12345
    untold = set(range(1, 6)) - {each.sub for each in known.objects if each.index == 0x3001}
    assert all(held(made, sub) == 12345 for sub in untold)


@pytest.mark.parametrize(
    "made",
    [dictionary(vendor=0x123), dictionary(name="IDX")],
    ids=["another maker", "another family"],
)
def test_of_another_device_nothing_is_touched(made: ObjectDictionary) -> None:
    tell_motor(made, LING)
    assert [held(made, sub) for sub in range(1, 6)] == [12345] * 5


def test_an_object_that_is_not_there_is_passed_over() -> None:
    made = dictionary(without=3)
    tell_motor(made, LING)
    assert held(made, 3) is None
    assert held(made, 1) != 12345

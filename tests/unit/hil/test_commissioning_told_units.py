"""The step that reads units, modes and limits of a drive, and all that it says."""

import math
from typing import Any, cast

import pytest

from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import ScaleOverride, Scaling, UnitNotTold
from servobench.drivers.sheets.fitness import told_by_sheet
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.hil.commissioning import steps_static as module
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_static import UnitsTold
from tests.unit.drivers.eds_maker import four_pdos
from tests.unit.drivers.eds_maker import sheet as sheet_of
from tests.unit.hil.simulated_shaft import LIMITS, Shaft, request_of, session_of, shaft_of

TRUTH = shaft_of(1e-3)
DRIVE = Identity("it", 0x1A, 0x2B, 0x3C, 4, 402)
CST, PV = Mode.CYCLIC_SYNCHRONOUS_TORQUE, Mode.PROFILE_VELOCITY


class Units:
    """The step on a drive whose units are ``told``, or not."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, refusal: UnitNotTold | None = None, **plate: Any
    ) -> None:
        self.overrides: list[ScaleOverride] = []
        self.refusal = refusal
        monkeypatch.setattr(module, "read_scaling", self._read_scaling)
        shaft = Shaft(TRUTH)
        self.session: Session = session_of(
            shaft,
            request=request_of(plate, trust_nameplate=True),
            dictionary=None,
            sheet_told=None,
            motion_mode=lambda: self.session.found.modes[0] if self.session.found.modes else None,
            choose_period=lambda _mode: (Duration(2 * NS_PER_MS), 47.4),
        )
        self.told: Scaling = self.session.told
        self.held = shaft.objects.held
        self.held |= {
            (Object.MOTOR_RATED_TORQUE, 0): 1600,
            (Object.SUPPORTED_DRIVE_MODES, 0): 1 << 9 | 1 << 2,
            (Object.MAX_MOTOR_SPEED, 0): 3000,
        }
        self.session.found.identity = DRIVE
        self.session.found.told = None

    def _read_scaling(self, _objects: object, override: ScaleOverride) -> Scaling:
        self.overrides.append(override)
        refusal, self.refusal = self.refusal, None
        if refusal is not None:
            raise refusal
        return self.told

    def run(self) -> StepOutcome:
        outcome = StepOutcome()
        UnitsTold().run(self.session, outcome)
        return outcome


def test_all_that_is_said_of_units_modes_limits_and_period(monkeypatch: pytest.MonkeyPatch) -> None:
    units = Units(monkeypatch)
    units.held[Object.POLARITY, 0] = 0xC0
    outcome = units.run()
    told, found = units.told, units.session.found
    assert outcome.lines == [
        "no nameplate: the rated torque 6076h cannot be checked, and every torque rests on it",
        f"one position unit is {told.position_rad:.6g} rad (608Fh)",
        f"one velocity unit is {told.velocity_rad_s:.6g} rad/s (60A9h)",
        f"one torque unit is {told.torque_nm:.6g} N m (told)",
        "polarity 607Eh is C0h",
        f"modes: {CST.title}, {PV.title}",
        f"host limits: {LIMITS.torque_nm:.4g} N m, 1500 r/min, {LIMITS.power_w:.4g} W, "
        f"{LIMITS.energy_j:.4g} J a step",
        "period 2000 us, at most 47 % bus load",
    ]
    assert outcome.figures == {
        "position_rad": told.position_rad,
        "velocity_rad_s": told.velocity_rad_s,
        "rated_torque_nm": told.rated_torque_nm,
        "polarity": 0xC0,
    }
    assert (found.told, found.override, found.limits) == (told, ScaleOverride(), LIMITS)
    assert (found.modes, found.period) == ((CST, PV), Duration(2 * NS_PER_MS))
    assert units.overrides == [ScaleOverride()]


def test_without_polarity_and_modes_that_is_said_and_no_period_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    units = Units(monkeypatch)
    units.held[Object.SUPPORTED_DRIVE_MODES, 0] = 0x20  # homing
    outcome = StepOutcome()
    with pytest.raises(StepFailed) as caught:
        UnitsTold().run(units.session, outcome)
    assert outcome.lines[4:] == ["no polarity object 607Eh", "modes: none of use here"]
    assert outcome.figures["polarity"] is None
    assert caught.value.evidence == "it has none of the modes in which the bench could move it"


@pytest.mark.parametrize("raw", [0, None])
def test_the_nameplate_s_torque_is_taken_where_6076h_tells_none(
    monkeypatch: pytest.MonkeyPatch, raw: int | None
) -> None:
    units = Units(monkeypatch, rating={"torque_nm": 1.6})
    del units.held[Object.MOTOR_RATED_TORQUE, 0]
    if raw is not None:
        units.held[Object.MOTOR_RATED_TORQUE, 0] = raw
    outcome = units.run()
    assert outcome.lines[0] == "6076h tells no rated torque; the nameplate's 1.6 N m is taken"
    assert units.overrides == [ScaleOverride(rated_torque_nm=1.6)]
    assert units.session.found.override == ScaleOverride(rated_torque_nm=1.6)


def test_the_nameplate_s_encoder_is_taken_where_no_position_unit_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refusal = UnitNotTold("608Fh is missing", "", unit="position")
    units = Units(monkeypatch, refusal, rating={"torque_nm": 1.6}, encoder={"counts_per_revolution": 4096})
    del units.held[Object.MOTOR_RATED_TORQUE, 0]
    outcome = units.run()
    assert outcome.faults == ["608Fh is missing; the nameplate's 4096 counts per turn are taken"]
    expected = ScaleOverride(math.tau / 4096, rated_torque_nm=1.6)
    assert units.overrides == [ScaleOverride(rated_torque_nm=1.6), expected]
    assert units.session.found.override == expected


@pytest.mark.parametrize(
    ("unit", "encoder", "remedy"),
    [
        ("torque", True, "6076h tells none: give rating.torque_nm in the nameplate (--motor)"),
        (
            "position",
            False,
            "608Fh, 6092h and 60A8h tell none: give encoder.counts_per_revolution, the position units in "
            "one turn, in the nameplate (--motor)",
        ),
        (
            "velocity",
            True,
            "60A9h, and 6096h with the position unit, tell none: this drive cannot be commissioned",
        ),
        (
            "acceleration",
            True,
            "60AAh, and 6097h with the position unit, tell none: this drive cannot be commissioned",
        ),
    ],
)
def test_a_unit_that_nobody_tells_ends_it_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch, unit: str, encoder: bool, remedy: str
) -> None:
    plate = {"encoder": {"counts_per_revolution": 4096}} if encoder else {}
    with pytest.raises(StepFailed) as caught:
        Units(monkeypatch, UnitNotTold("it tells none", "0", unit=unit), **plate).run()
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "it tells none",
        "0",
        remedy,
    )


@pytest.mark.parametrize("bits", [0, None])
def test_modes_that_are_not_told_are_tried_by_their_set_points(
    monkeypatch: pytest.MonkeyPatch, bits: int | None
) -> None:
    units = Units(monkeypatch)
    del units.held[Object.SUPPORTED_DRIVE_MODES, 0]
    if bits is not None:
        units.held[Object.SUPPORTED_DRIVE_MODES, 0] = bits
    outcome = units.run()
    assert units.session.found.modes == tuple(QUANTITY_OF_MODE)
    every = ", ".join(mode.title for mode in QUANTITY_OF_MODE)
    assert outcome.lines[5] == f"modes to be tried, as 6502h tells none: {every}"
    sheet = sheet_of(four_pdos(), modes="", without=(0x6071, 0x607A))
    cast(Any, units.session).sheet_told = told_by_sheet(sheet)
    assert units.run().lines[5].endswith(f"tells none: {Mode.CYCLIC_SYNCHRONOUS_VELOCITY.title}, {PV.title}")


def test_the_plan_tells_whether_its_maker_keeps_the_motor(monkeypatch: pytest.MonkeyPatch) -> None:
    step, session = UnitsTold(), Units(monkeypatch).session
    for keeps, motor in ((True, ", the motor by its maker's objects"), (False, "")):
        monkeypatch.setattr(module, "keeps_motor", lambda _session, known=keeps: known)
        assert step.plan(session) == (
            f"read ratings, resolutions, gear, feed, unit words and polarity{motor}, and compare with the "
            "nameplate"
        )

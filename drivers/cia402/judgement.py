"""One judgement of a drive: whether it is one, can be watched, and in which modes it can be commanded.

``hil eds`` judges a data sheet, ``hil commission`` the drive that answers with its sheet if it has one,
``hil run`` the sheet named in a bench file: by the same rules, so that none contradicts another.

    profile    1000h says 402; 0, no standardised profile, is taken where there is a statusword 6041h
    modes      6502h; where it tells none, each mode whose set-point object is there is tried
    a mode     6060h takes it, its set-point object is there, and the PDOs can carry what it needs
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from servobench.drivers.canopen.error_control import watch_lack
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.canopen.objects301 import Cia301, object_name
from servobench.drivers.canopen.pdo import Key
from servobench.drivers.canopen.pdo_capability import PdoCapability
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import PlanImpossible, PlanResult, plan_pdos
from servobench.drivers.cia402.pdo_plans import NEEDED_OBJECTS, STAMP, STANDARD, PlanWish
from servobench.drivers.cia402.profile import Mode, no_drive, offers_mode, tells_modes

_UNWATCHED: Final = "it is refused unless --unwatched (unwatched = true)"


@dataclass(frozen=True, slots=True)
class ToldDrive:
    """The facts on which a judgement rests."""

    device_type: int | None = None
    """1000h; None if unknown."""
    mode_bits: int | None = None
    """6502h."""
    has: Callable[[int], bool] = lambda _index: True
    """Returns True if an object exists; without a data sheet it is read when needed."""
    mode_range: tuple[int | None, int | None] = (None, None)
    """The range of 6060h; None: that of its type."""
    mode_held: int | None = None
    """The value of 6060h if it cannot be written."""
    capability: PdoCapability = STANDARD
    stamp: Key = STAMP
    """The object that holds its stamp, by its make."""


@dataclass(frozen=True, slots=True)
class ModeFitness:
    """Fitness for one mode."""

    mode: Mode
    plan: PlanResult | None
    """None: it cannot be commanded."""
    reason: str = ""
    """Why it cannot be commanded."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """The judgement of one drive."""

    obstacles: tuple[str, ...]
    """Reasons why nothing can be done with it; empty: it can be commissioned."""
    conditions: tuple[str, ...]
    """Conditions that the user must accept."""
    modes: tuple[ModeFitness, ...]
    """The requested modes that it has or may have; in the order of the request."""
    modes_told: bool
    """True if 6502h names them."""

    @property
    def usable(self) -> tuple[Mode, ...]:
        """The modes that can be commanded."""
        return tuple(each.mode for each in self.modes if each.plan is not None)


def told_by_drive(objects: RemoteObjects, device_type: int, sheet: ToldDrive | None) -> ToldDrive:
    """Collect the facts from the drive that answers, completed by its data sheet."""
    told, bits = sheet or ToldDrive(), objects.read_if_there(Object.SUPPORTED_DRIVE_MODES)
    return replace(told, device_type=device_type, mode_bits=bits or told.mode_bits)


def judge(told: ToldDrive, node_id: int, asked: Sequence[Mode]) -> Judgement:
    """Judge a drive for ``asked``, the modes in which it might be commanded."""
    obstacles = _obstacles(told)
    modes = tuple(judge_mode(told, node_id, mode) for mode in asked if offered(told, mode))
    if not obstacles and not modes:
        obstacles = ("it has none of the modes in which the bench could move it",)
    elif not obstacles and all(each.plan is None for each in modes):
        obstacles = tuple(f"{each.mode.title}: {each.reason}" for each in modes)
    return Judgement(obstacles, _conditions(told), modes, tells_modes(told.mode_bits))


def refusal(told: ToldDrive, node_id: int, mode: Mode) -> str:
    """Say why the drive cannot be commanded in ``mode``; empty if it can."""
    if obstacles := _obstacles(told):
        return "; ".join(obstacles)
    if offered(told, mode):
        return judge_mode(told, node_id, mode).reason
    by = f"6502h is {told.mode_bits:08X}h" if tells_modes(told.mode_bits) else "no object for its set-point"
    return f"it has no {mode.title} mode: {by}"


def offered(told: ToldDrive, mode: Mode) -> bool:
    """Return True if the drive has the mode, or may have it."""
    if tells_modes(told.mode_bits):
        return offers_mode(told.mode_bits, mode)
    return mode in NEEDED_OBJECTS and told.has(NEEDED_OBJECTS[mode])


def judge_mode(told: ToldDrive, node_id: int, mode: Mode) -> ModeFitness:
    """Judge one mode that is offered."""
    needed, (low, high) = NEEDED_OBJECTS[mode], told.mode_range
    if told.mode_held is not None and told.mode_held != mode:
        return ModeFitness(mode, None, f"6060h cannot be written, and holds {told.mode_held}")
    if (low is not None and mode < low) or (high is not None and mode > high):
        return ModeFitness(mode, None, f"6060h takes {_range(low, high)} by its limits, the mode is {mode:d}")
    if not told.has(needed):
        return ModeFitness(mode, None, f"{object_name(needed, 0)} is not in the dictionary")
    try:
        return ModeFitness(mode, plan_pdos(told.capability, node_id, PlanWish(mode, stamp=told.stamp)))
    except PlanImpossible as error:
        return ModeFitness(mode, None, error.evidence or error.summary)


def _range(low: int | None, high: int | None) -> str:
    return f"{low} to {high}" if None not in (low, high) else f"up to {high}" if low is None else f"{low} on"


def _obstacles(told: ToldDrive) -> tuple[str, ...]:
    texts = [] if told.device_type is None else [
        no_drive(told.device_type, lambda: told.has(Object.STATUSWORD))
    ]  # fmt: skip
    missing = [index for index in (Object.CONTROLWORD, Object.STATUSWORD) if not told.has(index)]
    if missing:
        names = " and ".join(object_name(index, 0) for index in missing)
        texts.append(f"{names} missing: it has no CiA 402 state machine")
    elif not told.has(Object.MODES_OF_OPERATION):
        texts.append("6060h:00 missing: its mode cannot be chosen")
    return tuple(filter(None, texts))


def _conditions(told: ToldDrive) -> tuple[str, ...]:
    guardable = all(map(told.has, (Cia301.GUARD_TIME, Cia301.LIFE_TIME_FACTOR)))
    lack = watch_lack(
        produced=told.has(Cia301.PRODUCER_HEARTBEAT_TIME), consumes=told.has(Cia301.CONSUMER_HEARTBEAT_TIME)
    )
    if lack is None or guardable:
        return ()
    return (f"without {lack[0]}, 100Ch and 100Dh {lack[1]}: {_UNWATCHED}",)

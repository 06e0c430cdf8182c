"""``[[signal]]``: a PDO says something else than was measured or asked for."""

from typing import Annotated, Final, Literal

from pydantic import model_validator

from servobench.drivers.canopen.objects301 import FIRST_OBJECT
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import MISSING
from servobench.virtual_bus.faults import alterations
from servobench.virtual_bus.faults.alterations import Alteration, Change
from servobench.virtual_bus.faults.fault_streams import UniformStream
from servobench.virtual_bus.faults.fault_table import LogKind, LogNumber, Number, Probability, require, within
from servobench.virtual_bus.faults.frame_fault import LinkFault
from servobench.virtual_bus.faults.mapped_objects import ObjectPlace, place_of, place_text

_HOWS: Final = ("stuck", "offset", "drift", "noise", "scale", "sign", "bits")
_KEYS: Final = {
    "offset": ("offset_raw",),
    "drift": ("drift_raw_per_s",),
    "noise": ("noise_raw_rms",),
    "scale": ("factor",),
    "bits": ("set_bits", "cleared_bits"),
    "stuck": ("stuck_raw",),
}
"""Those that belong to one way only."""
_OPTIONAL: Final = ("stuck_raw",)
_UNSIGNED: Final = frozenset(
    {
        Object.CONTROLWORD,
        Object.STATUSWORD,
        Object.ERROR_CODE,
        Object.DC_LINK_CIRCUIT_VOLTAGE,
        Object.DIGITAL_INPUTS,
    }
)
"""Unsigned objects of CiA 402-2 that drives map. Those of CiA 301 (1013h) are unsigned too."""
Mask = Annotated[int, within(0, 2**64 - 1, "a mask of bits, such as 0x1000")]
_WHERE: Final = (LogNumber("object"), LogNumber("bits_at"), LogNumber("raw"))
"""``bits_at``: the length of the field in bits times 64, plus its first bit; ``raw``: what it has now."""
BITS_AT: Final = 64


def _of_object(place: int, _node: int) -> str:
    return f"of {place_text(place)}"


def _nowhere(place: int, node: int) -> str:
    whose = f"node {node}" if node else "any node"
    return f"signal {place_text(place)}: no PDO of {whose} whose mapping was seen here carries it"


class SignalFault(LinkFault):
    """The value of an object in a PDO is replaced, in every frame or each with ``probability``.

    ``stuck``: at the first value in the window, or at ``stuck_raw``. ``offset``, ``drift`` (from ``from_s``
    on), ``noise`` (normal), ``scale``, ``sign``: that of the value. ``bits``: some always 1, some always 0.
    Amounts are raw, in the unit of the object, since a frame says nothing about units. What leaves the range
    of the object's type ends at that range. Objects of a maker count as ``signed`` unless it is false.

    Where the object lies is learnt from the SDOs on the same connection (:mod:`.seen_mappings`). Several
    signals of one object act one after the other, as they stand in the plan.
    """

    kind = "signal"
    logs = (
        *(LogKind(f"signal_{how}", _WHERE, alters=True, of=_of_object) for how in _HOWS),
        LogKind("signal_nowhere", (LogNumber("object"), LogNumber("node")), alters=True, says=_nowhere),
    )
    object: ObjectPlace
    how: Literal["stuck", "offset", "drift", "noise", "scale", "sign", "bits"]
    stuck_raw: int | None = None
    offset_raw: Number | None = None
    drift_raw_per_s: Number | None = None
    noise_raw_rms: Annotated[float, within(0.0, 1e12, "a standard deviation >= 0")] | None = None
    factor: Number | None = None
    set_bits: Mask | None = None
    cleared_bits: Mask | None = None
    signed: bool | None = None
    probability: Probability = 1.0

    @model_validator(mode="after")
    def _check_how(self) -> "SignalFault":
        own = _KEYS.get(self.how, ())
        given = [key for key in own if getattr(self, key) is not None]
        needed = [key for key in own if key not in _OPTIONAL]
        if needed:
            what = "a number" if len(needed) == 1 else " or ".join(needed)
            require(bool(given), needed[0], MISSING, f'{what}, for how = "{self.how}"')
        for how, keys in _KEYS.items():
            for key in keys if how != self.how else ():
                value = getattr(self, key)
                require(value is None, key, value, f'nothing unless how = "{how}"')
        signed = self.how != "sign" or self.is_signed
        require(signed, "how", self.how, f"another way: {self.object} has no sign")
        return self

    @property
    def place(self) -> int:
        """``object``, as in the upper 24 bits of a mapping word."""
        return place_of(self.object)

    @property
    def is_signed(self) -> bool:
        """True if the value has a sign."""
        if self.how == "bits":
            return False
        index = self.place >> 8
        return (index >= 2 * FIRST_OBJECT and index not in _UNSIGNED) if self.signed is None else self.signed

    @property
    def log_name(self) -> str:
        """Kind of its entries in the log."""
        return f"signal_{self.how}"

    def at_work(self, stream: UniformStream) -> Alteration:
        """Return its action on one link, with the random stream of that link."""
        return Alteration(self.window, self.probability, self._change(), stream)

    def _change(self) -> Change:
        if self.how == "bits":
            return alterations.bits(self.set_bits or 0, self.cleared_bits or 0)
        if self.how == "stuck":
            return alterations.stuck(self.stuck_raw)
        if self.how == "sign":
            return alterations.scale(-1.0)
        amount = getattr(self, _KEYS[self.how][0])
        change: Change = getattr(alterations, self.how)(amount)
        return change

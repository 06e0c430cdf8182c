"""Compares network and drive of a run with those that its controller was made for.

A certificate does not cover a longer delay, more losses in a row, another period, another motor or another
current loop. Known facts are checked before anything moves; the rest is watched in the cycle records as they
are made.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from servobench.drivers.errors import BadInput, LimitExceeded
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.configuration.config_files import raise_all
from servobench.hil.configuration.controller_files import (
    Certificate,
    DesignPlant,
    LossCertificate,
    MadeFor,
)
from servobench.hil.configuration.controller_kinds import (
    HinfSection,
    PidController,
    StampCompensator,
    StateFeedbackController,
)
from servobench.hil.configuration.drive_current_loop import (
    KnownLoop,
    certified_loop,
    current_loop_of,
    loop_fault,
    range_text,
    slow_for_pid,
)
from servobench.hil.configuration.network_file import Network, commands_unknown, load_network
from servobench.hil.configuration.predicting_controllers import PredictingController
from servobench.hil.execution.coupling_premise import flexible
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.scenario import Quantity
from servobench.hil.rows.recording_plan import CertifiedPlan
from servobench.virtual_bus.drive.encoder import SpeedMethod
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.node_fault import NodeFault
from servobench.virtual_bus.faults.register import TABLES

REMEDY: Final = (
    "design for this network and drive with hil design speed --network --bench, or run with "
    "--allow-uncertified, which warns instead"
)
_RELATIVE = 1e-6
"""Controller files hold the motor's figures in full: a difference beyond rounding means another motor."""
_Certified = StateFeedbackController | PredictingController | HinfSection
"""Controllers whose files may state what they were made for."""

Record = Callable[[CycleRecord], None]


@dataclass(frozen=True, slots=True)
class Allowed:
    """Worst network for which the certificate holds."""

    losses_max: int
    delay_max: Duration
    """From sample to actuator."""
    age_max: Duration
    """Longest time for which a sample acts, [Ling2012] (2.13)."""


def allowed(made_for: MadeFor, period: Duration) -> Allowed:
    """Return the worst network within ``made_for``; for a constant delay alone losses and delay share the
    age."""
    if made_for.losses_in_a_row_max is not None and made_for.delay_max_us is not None:
        delay = Duration(made_for.delay_max_us * NS_PER_US)
        if made_for.strategy is None:  # of a delay that is constant behind a SYNC, the distance of it varies
            delay = Duration(delay + delay // period * (made_for.sync_within_us or 0) * NS_PER_US)
        losses = made_for.losses_in_a_row_max
        return Allowed(losses, delay, Duration((losses + 1) * period + delay))
    age = Duration(made_for.delay_us * NS_PER_US)
    return Allowed(max(0, age // period - 1), Duration(age - period), age)


_Fault = tuple[str, object, str]


def _bench_faults(config: BenchConfig, drive: DriveConfig, made_for: MadeFor, key: str) -> list[_Fault]:
    faults: list[_Fault] = []
    period_us = config.loop.period_us
    if made_for.period_us is not None and made_for.period_us != period_us:
        faults.append((f"{key}.period_us", made_for.period_us, f"loop.period_us = {period_us}"))
    if made_for.period_us is None and 2 * period_us > made_for.delay_us:
        expected = f"at least two periods of {period_us} us: a sample acts that long without any loss"
        faults.append((f"{key}.delay_us", made_for.delay_us, expected))
    if made_for.strategy is not None:
        compensator = drive.compensator
        agreed = compensator.delay_us if isinstance(compensator, StampCompensator) else None
        if made_for.strategy != compensator.kind or agreed != made_for.agreed_delay_us:
            expected = f"the bench's compensator, {compensator.kind}"
            expected += f" at {agreed} us" if agreed is not None else ""
            at = f" at {made_for.agreed_delay_us} us" if made_for.agreed_delay_us is not None else ""
            faults.append((f"{key}.strategy", f"{made_for.strategy}{at}", expected))
    if made_for.plant is not None:
        motor = drive.motor.parameters
        for name in DesignPlant.model_fields.keys() - {"coupling"}:
            value, real = getattr(made_for.plant, name), getattr(motor, name)
            if abs(value - real) > _RELATIVE * abs(real):
                faults.append((f"{key}.plant.{name}", value, f"that of the motor {motor.name}, {real:g}"))
    return faults


def _network_faults(network: Network, made_for: MadeFor, period: Duration) -> list[_Fault]:
    limits = allowed(made_for, period)
    delay_us = limits.delay_max // NS_PER_US
    faults: list[_Fault] = []
    if network.period_us != period // NS_PER_US:
        faults.append(("network.period_us", network.period_us, f"the loop's, {period // NS_PER_US}"))
    if network.losses_max > limits.losses_max:
        expected = f"at most {limits.losses_max}, for which the controller was made"
        faults.append(("network.losses_in_a_row_max", network.losses_max, expected))
    if network.delay_max_us > delay_us:
        expected = f"at most {delay_us}, for which the controller was made"
        faults.append(("network.delay_max_us", network.delay_max_us, expected))
    if not faults and round(network.age_max_s * NS_PER_S) > limits.age_max:
        expected = f"a sample that acts for at most {limits.age_max // NS_PER_US} us, losses included"
        faults.append(("network", f"{network.age_max_s * 1e6:.0f} us", expected))
    return faults


@dataclass(slots=True)
class NetworkGuard:
    """Passes one axis's records on and judges each; a worse network stops the run, or is reported once."""

    axis: str
    limits: Allowed
    period: Duration
    record: Record
    refuse: bool
    tell: Callable[[str], None]
    stopping: Callable[[], bool]
    """Returns True while the run is being cut short, which loses readings by itself."""
    _missing: int = field(default=0, init=False)
    _told_loss: bool = field(default=False, init=False)
    _told_delay: bool = field(default=False, init=False)

    def __call__(self, record: CycleRecord) -> None:
        """Record a cycle. Raises LimitExceeded if the network is worse than the controller was made for."""
        self.record(record)
        observation = record.observation
        if not isinstance(observation, Sample):
            self._missing += 1
            if self._missing > self.limits.losses_max and not self._told_loss:
                self._told_loss = True
                self._object(
                    f"{self._missing} readings lost in a row, made for at most {self.limits.losses_max} "
                    "readings and commands"
                )
            return
        delay = self._action_delay(record, observation)
        age = (self._missing + 1) * self.period + delay
        self._missing = 0
        if self._told_delay:
            return
        if delay > self.limits.delay_max:
            self._told_delay = True
            limit_us = self.limits.delay_max / NS_PER_US
            self._object(
                f"{delay / NS_PER_US:.1f} us from sample to actuation, made for at most {limit_us:.0f} us"
            )
        elif age > self.limits.age_max and not self._told_loss:
            self._told_delay = True
            limit_us = self.limits.age_max / NS_PER_US
            self._object(
                f"a sample that acts for {age / NS_PER_US:.1f} us, made for at most {limit_us:.0f} us"
            )

    def _action_delay(self, record: CycleRecord, sample: Sample) -> int:
        """Return the certain lower bound of the delay; see
        :func:`servobench.hil.reviewing.network_meter.action_delays_ns`."""
        sending = record.sending
        if sending is None:
            return 0
        acts_at = sending.acts_after
        if acts_at is None:
            acts_at = sending.on_bus_at if sending.on_bus_at is not None else sending.handed_at
        delay = acts_at - sample.sampled_at
        late = sample.reading.received_at - sending.handed_at
        if late > 0:
            delay += -(-late // self.period) * self.period
        return delay

    def _object(self, found: str) -> None:
        text = f"{self.axis}: the network is worse than its controller's: {found}"
        if self.stopping():
            return
        if self.refuse:
            raise LimitExceeded(text, remedy=REMEDY)
        self.tell(text)


_ON_THE_DRIVE: Final = tuple(
    kind for kind, table in TABLES.items() if issubclass(table, NodeFault) and table.strikes_plant
)
"""Faults of a plan that do not concern the network."""


class Certificates:
    """The certificates of a bench's controllers: compared with the bench, its drives and its network.

    Controllers of ``replaced`` axes are not the bench's, and do not count.
    """

    def __init__(self, config: BenchConfig, replaced: Collection[str] = ()) -> None:
        self.refuse = True
        """True: a worse network ends the run; False: it is only reported."""
        self.notes: list[str] = []
        """Aspects in which bench, drives or network are worse, if the run continues."""
        self._config = config
        self._own = [axis for axis in config.axes if axis not in replaced]
        self._made_for = {
            axis: controller.made_for
            for axis in self._own
            if isinstance(controller := config.drive[axis].controller, _Certified)
            and controller.made_for is not None
        }

    def check(self, network: Path | None, allow: bool) -> None:
        """Check everything known before the run, and a measured ``network``.

        Raises BadInput or BadInputs for anything worse, unless allowed.
        """
        faults = self.faults({} if network is None else {f"--network {network}": load_network(network)})
        if faults and not allow:
            raise_all(faults)
        self.refuse = not allow
        self.notes += [str(fault) for fault in faults]

    def faults(self, networks: Mapping[str, Network]) -> list[BadInput]:
        """Return everything known to be worse before anything moves; ``networks``: measured ones, by their
        source."""
        config, faults = self._config, []
        if self._made_for:
            unknown = [commands_unknown(network, source) for source, network in networks.items()]
            faults = [fault for fault in unknown if fault is not None]
        for axis, made_for in self._made_for.items():
            faults += [BadInput(config.source, *fault, REMEDY) for fault in self._axis_faults(axis)]
            for source, network in networks.items():
                worse = _network_faults(network, made_for, config.loop.period)
                faults += [BadInput(source, *fault, REMEDY) for fault in worse]
        return faults

    def doubts(self) -> list[str]:
        """Return notes on the drives' current loops at the start: unknown ones, and too slow ones for their
        PID."""
        unknown = [
            f"{axis}: the bandwidth of the drive's current loop is not known, its controller is certified "
            f"for {range_text(certified)}; hil commission measures it"
            for axis, made_for in self._made_for.items()
            if (certified := certified_loop(made_for)) is not None and self._loop(axis) is None
        ]
        return unknown + [
            f"{axis}: {text}"
            for axis in self._own
            if isinstance(pid := self._config.drive[axis].controller, PidController)
            and (loop := self._loop(axis)) is not None
            and (text := slow_for_pid(loop, pid, self._config.drive[axis].motor.parameters))
        ]

    def plans(self) -> dict[str, CertifiedPlan]:
        """Return the certificates to compare the run with, by axis with a certified controller."""
        return {axis: self._plan(axis, made_for) for axis, made_for in self._made_for.items()}

    def watched(
        self, axis: str, record: Record, tell: Callable[[str], None], stopping: Callable[[], bool]
    ) -> Record:
        """Return the sink for the records of an axis: through a guard, if its controller was made for a
        network."""
        made_for = self._made_for.get(axis)
        if made_for is None:
            return record

        def note(text: str) -> None:
            self.notes.append(text)
            tell(text)

        period = self._config.loop.period
        return NetworkGuard(axis, allowed(made_for, period), period, record, self.refuse, note, stopping)

    def _loop(self, axis: str) -> KnownLoop | None:
        return current_loop_of(self._config, axis)

    def _axis_faults(self, axis: str) -> list[_Fault]:
        """Return the differences of an axis' bench and drive from those that its controller was made for."""
        key, made_for = f"drive.{axis}.controller.made_for", self._made_for[axis]
        faults = _bench_faults(self._config, self._config.drive[axis], made_for, key)
        loop = self._loop(axis)
        if loop is not None and (outside := loop_fault(made_for, loop, key)) is not None:
            faults.append(outside)
        return faults

    def _plan(self, axis: str, made_for: MadeFor) -> CertifiedPlan:
        config, drive = self._config, self._config.drive[axis]
        assert isinstance(drive.controller, _Certified)
        certificate = drive.controller.certificate
        limits, loop = allowed(made_for, config.loop.period), self._loop(axis)
        certified = certified_loop(made_for)
        slew = drive.limits.torque_slew_max_nm_s
        return CertifiedPlan(
            period_us=config.loop.period_us,
            delay_us=limits.delay_max / NS_PER_US,
            losses_together=limits.losses_max,
            gain=None if certificate is None else certificate.gain,
            bandwidths_hz=None
            if certified is None
            else (certified.bandwidth_min_hz, certified.bandwidth_max_hz),
            bandwidth_hz=None if loop is None else loop.bandwidth_hz,
            torque_rms_nm_max=made_for.torque_rms_nm_max,
            age_us=limits.age_max / NS_PER_US,
            torque_step_max_nm=None if slew is None else slew * config.loop.period / NS_PER_S,
            sync_within_us=float(made_for.sync_within_us or 0),
            samples_alone=isinstance(certificate, LossCertificate),
            left=tuple(self._left(axis)),
            unknown=tuple(_unknown(drive, made_for, certificate, loop)),
        )

    def _left(self, axis: str) -> Iterator[str]:
        """Yield premises that bench and drive break; see
        :mod:`servobench.hil.reviewing.certificate_meter`."""
        for key, value, expected in self._axis_faults(axis):
            yield f"{key}: {value}, expected {expected}"
        if self._config.quantity(axis) is Quantity.POSITION:
            yield f"reference.{axis}: positions, expected speeds, without a loop of the position around"
        yield from flexible(axis, self._config.drive[axis], self._config.simulated)
        yield from self._shaped(axis)
        yield from self._sensed(axis)
        if self._config.simulated:
            for name in ("resistance_factor", "inductance_factor"):
                if (factor := getattr(self._config.drive[axis].simulation, name)) != 1.0:
                    key = f"drive.{axis}.simulation.{name}"
                    yield f"{key}: {factor:g}, expected 1, the motor as its file has it"
        faults = self._config.faults
        plan = faults.as_tables() if isinstance(faults, FaultPlan) else {}
        for kind in _ON_THE_DRIVE:
            if kind in plan:
                yield f"faults.{kind}: the drive itself was struck"

    def _shaped(self, axis: str) -> Iterator[str]:
        """A torque that the drive filters, where every model has its current loop alone."""
        like = self._config.drive[axis].simulation.like if self._config.simulated else None
        if like is not None and like.set_point is not None and (parts := like.set_point.torque_parts):
            key = f"drive.{axis}.simulation.like.set_point"
            yield f"{key}: {', '.join(parts)}, expected a torque that is made as it is asked for"

    def _sensed(self, axis: str) -> Iterator[str]:
        """A speed that is made otherwise than the controller's model has it."""
        drive = self._config.drive[axis]
        controller, like = drive.controller, drive.simulation.like
        made = controller.certificate if isinstance(controller, HinfSection) else controller
        filter_hz = getattr(made, "speed_filter_hz", None)
        if filter_hz is None or like is None or like.encoder is None or not self._config.simulated:
            return
        speed = like.encoder.speed.parameters
        if speed.method is not SpeedMethod.DIFFERENCE or speed.filter_hz != filter_hz:
            corner = "no filter" if speed.filter_hz is None else f"{speed.filter_hz:g} Hz"
            key = f"drive.{axis}.simulation.like.encoder.speed"
            yield f"{key}: {like.encoder.speed.method}, {corner}, expected difference, {filter_hz:g} Hz"


def _unknown(
    drive: DriveConfig,
    made_for: MadeFor,
    certificate: Certificate | LossCertificate | None,
    own: KnownLoop | None,
) -> Iterator[str]:
    """Yield premises for which it is unknown whether bench and drive keep them, in words."""
    if isinstance(certificate, LossCertificate):
        loop = certified_loop(made_for)
        if loop is not None and own is not None and not loop.is_that_of_the_design(own.bandwidth_hz):
            yield f"bandwidth: gain certified for a current loop of {loop.bandwidth_hz:g} Hz alone"
        if isinstance(drive.controller, HinfSection) and drive.compensator.kind != "arrival":
            yield f"compensator: certified for arrival, the bench's is {drive.compensator.kind}"
    elif certificate is not None and certificate.sequences is None:
        yield "sampling: certified for a constant delay alone"
    if own is None and certified_loop(made_for) is not None:
        yield "bandwidth: that of the drive's current loop is not known"

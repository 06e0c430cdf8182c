"""``hil scan``: the adapters of this machine, and who is on the bus behind one of them."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from typing import Any, Final, NamedTuple

import can

from servobench.drivers.canopen.bus_scan import BusScan, NodeFound, Traffic
from servobench.drivers.canopen.lss import LssAddress, LssMaster
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.errors import MISSING, BadInput, BusDown, NoAnswer, PeerFault
from servobench.drivers.timebase import Clock, Duration, MonotonicClock
from servobench.drivers.wire.adapters import HUB, SOCKETCAN, BusSpec, OpenBus, open_bus
from servobench.drivers.wire.attached import (
    CanLink,
    SerialPort,
    advice_on,
    can_links,
    can_listen_only,
    detect_bitrate,
    open_listening,
    serial_adapters,
)
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.bus.hub_place import HubPlace, known_hubs

_NO_WAIT: Final = Duration(0)


@dataclass(frozen=True, slots=True)
class Adapters:
    """Possible buses of this machine."""

    can_links: tuple[CanLink, ...]
    serial_ports: tuple[SerialPort, ...]
    others: tuple[str, ...]
    """``interface:channel`` that python-can finds through vendors' libraries."""
    hubs: tuple[str, ...]
    """Hubs of this user that run."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "can_links": [{"spec": link.spec, **link._asdict()} for link in self.can_links],
            "serial_ports": [{"spec": port.spec, **port._asdict()} for port in self.serial_ports],
            "others": list(self.others),
            "hubs": list(self.hubs),
        }


@dataclass(frozen=True, slots=True)
class ScanPlan:
    """Tasks on a bus."""

    spec: BusSpec
    bitrate_bit_s: int | None
    """None: the bus's own, found out by listening where that needs to be."""
    listen: Duration
    passive: bool = False
    """Nothing is sent at all."""
    assign: tuple[int, ...] = ()
    """Node-IDs for the devices that have none, in the order in which they are found."""
    store: bool = False
    """They are to keep their node-IDs without power."""
    wait: Duration = _NO_WAIT
    """Look again for so long, until a node is there."""


@dataclass(slots=True)
class BusReport:
    """Findings on a bus."""

    spec: str
    bitrate_bit_s: int | None
    bitrate_detected: bool
    traffic: Traffic = field(default_factory=Traffic)
    nodes: list[NodeFound] = field(default_factory=list)
    unconfigured: list[LssAddress] = field(default_factory=list)
    assigned: list[tuple[int, LssAddress]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def somebody(self, passive: bool) -> bool:
        """True if a device has answered; ``passive``: if one was heard."""
        read = any(passive or node.device_type is not None for node in self.nodes)
        return read or bool(self.unconfigured or self.assigned)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "spec": self.spec,
            "bitrate_bit_s": self.bitrate_bit_s,
            "bitrate_detected": self.bitrate_detected,
            "frames_heard": self.traffic.frames,
            "broadcasts_heard": dict(self.traffic.broadcasts),
            "running": self.traffic.running,
            "nodes": [{**asdict(node), "profile": node.profile} for node in self.nodes],
            "unconfigured": [address._asdict() for address in self.unconfigured],
            "assigned": [{"node_id": node_id, **address._asdict()} for node_id, address in self.assigned],
            "notes": list(self.notes),
        }


def find_adapters() -> Adapters:
    """Look at this machine; no adapter is opened and nothing is sent."""
    from servobench.hil.machine.doctor import detected_adapters

    hubs = tuple(name for name in known_hubs() if HubPlace(name).serving)
    return Adapters(tuple(can_links()), tuple(serial_adapters()), tuple(detected_adapters()), hubs)


class OpenedBus(NamedTuple):
    """A bus to be looked at."""

    bus: OpenBus
    bitrate_bit_s: int | None
    detected: bool


def scan_bus(plan: ScanPlan, say: Callable[[str], None]) -> BusReport:
    """Look at the bus of ``plan``; ``say`` is told what is being done.

    Raises BadInput, BusDown, or NoAnswer if the bit rate is wanted and cannot be heard.
    """
    if plan.passive and plan.assign:
        raise BadInput("--assign", "", plan.assign[0], "a scan that may send", "leave --passive out")
    clock = MonotonicClock()
    ends = clock.now() + plan.wait
    while True:
        try:
            report = _look_once(plan, clock, say)
        except NoAnswer:
            if clock.now() >= ends:
                raise
        else:
            if report.somebody(plan.passive) or clock.now() >= ends:
                return report
        say("nobody has answered: looking again")


def _look_once(plan: ScanPlan, clock: Clock, say: Callable[[str], None]) -> BusReport:
    opened = open_to_look(plan, say)
    report = BusReport(str(plan.spec), opened.bitrate_bit_s, opened.detected)
    try:
        link = BusLink(opened.bus.bus, clock, opened.bus.stamps, str(plan.spec))
        network = CanopenNetwork(link, clock)
        scan = BusScan(network)
        say(f"listening for {plan.listen / 1e9:g} s")
        scan.listen(plan.listen)
        report.traffic = scan.traffic
        if not plan.passive:
            say("asking the nodes 1 to 127")
            scan.probe()
            _look_for_unconfigured(network, plan, scan, report, say)
            scan.read_booted()
        report.nodes = scan.found()
        if scan.traffic.running:
            report.notes.append("a network is running: SYNC or process data are on the bus")
        report.notes += advice_on(plan.spec)
        if link.error_frames:
            report.notes.append(f"{link.error_frames} error frames")
    finally:
        opened.bus.bus.shutdown()
    return report


def _look_for_unconfigured(
    network: CanopenNetwork, plan: ScanPlan, scan: BusScan, report: BusReport, say: Callable[[str], None]
) -> None:
    """LSS: who has no node-ID; and who gets one."""
    if scan.traffic.broadcasts["LSS request"]:
        report.notes.append("no search for devices without node-ID: another LSS master is at work")
        return
    taken = set(plan.assign) & set(scan.nodes)
    if taken:
        expected = f"a node-ID that nobody has; on the bus are {', '.join(map(str, sorted(scan.nodes)))}"
        raise BadInput("--assign", "", min(taken), expected)
    say("looking for devices without node-ID (LSS fast scan)")
    free = list(plan.assign)
    try:
        with closing(LssMaster(network)) as master:
            for address in master.search():
                if free:
                    if not master.assign(address, free[0], plan.store):
                        report.notes.append(f"node {free[0]} sent no boot-up message; switch it off and on")
                    report.assigned.append((free.pop(0), address))
                else:
                    report.unconfigured.append(address)
    except (NoAnswer, PeerFault) as error:
        if free:
            raise
        report.notes.append(f"the search for devices without node-ID was given up: {error}")
    if not report.assigned:
        if plan.assign:
            raise NoAnswer(
                f"no device without node-ID is on {plan.spec}",
                f"nodes there: {', '.join(map(str, sorted(scan.nodes))) or 'none'}",
                "a device that has a node-ID keeps it; change it by its own switches or tool",
            )
        return
    if free:
        report.notes.append(f"no further device without node-ID was there for {', '.join(map(str, free))}")
    say("asking the new nodes")
    scan.probe()


def open_to_look(plan: ScanPlan, say: Callable[[str], None]) -> OpenedBus:
    """The bus of ``plan``, its bit rate found out where it can be heard. Raises as :func:`scan_bus` does."""
    spec, bitrate = plan.spec, plan.bitrate_bit_s
    if spec.simulated:
        raise BadInput("--bus", "", str(spec), "a bus that other processes can join", "use hub:NAME")
    if spec.interface == HUB:
        try:
            bus = HubBus(spec.channel, bitrate=bitrate)
        except can.CanError as error:
            raise BusDown(f"cannot join {spec}", str(error), "leave --bitrate out") from error
        return OpenedBus(OpenBus(bus, StampSource.MONOTONIC, str(spec)), bus.bitrate_bit_s, bitrate is None)
    if spec.interface == SOCKETCAN:
        rates = [link.bitrate_bit_s for link in can_links() if link.spec == str(spec)]
        rate = rates[0] if rates else None
        return OpenedBus(open_bus(spec, bitrate or rate or 1_000_000), rate, False)
    detected = bitrate is None
    if bitrate is None:
        bitrate = _detect(spec, say)
    if plan.passive and can_listen_only(spec):
        bus_that_listens = open_listening(spec, bitrate)
        return OpenedBus(OpenBus(bus_that_listens, StampSource.RECEIPT, str(spec)), bitrate, detected)
    return OpenedBus(open_bus(spec, bitrate), bitrate, detected)


def _detect(spec: BusSpec, say: Callable[[str], None]) -> int:
    if not can_listen_only(spec):
        expected = "a bit rate, because this adapter cannot listen without taking part"
        raise BadInput("--bitrate", "", MISSING, expected, "--bitrate 500000, or what the bus runs at")
    say("listening for the bit rate")
    bitrate = detect_bitrate(spec, MonotonicClock())
    if bitrate.bitrate_bit_s is not None:
        return bitrate.bitrate_bit_s
    if bitrate.silent:
        raise NoAnswer(
            f"the bit rate of {spec} cannot be heard",
            "nothing is being sent on the bus",
            "switch the devices on, or say what the bus runs at: --bitrate 500000",
        )
    raise NoAnswer(
        f"the bit rate of {spec} was not found",
        "errors and no whole frames at each rate that the adapter has: "
        + ", ".join(str(trial.bitrate_bit_s) for trial in bitrate.trials),
        "check termination and wiring, or say what the bus runs at: --bitrate",
    )

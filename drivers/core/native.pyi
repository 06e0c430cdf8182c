"""drivers' core, written in C, as seen from Python; the sources beside this file document it."""

from collections.abc import Callable
from typing import Any, ClassVar

from servobench.drivers.timebase import Duration, Instant

SOURCES_DIGEST: str
"""Digest of the C sources of the core (servobench.design.core.build)."""

TOLD_THE_SAME: int
"""Equal torque demands, each after a further command, that a CommandWatch takes for one that stays."""

def nearest(value: float, /) -> int:
    """``round(value)`` of a float, in a third of its time. Error: ValueError, OverflowError for what is not
    finite."""

def enter(table: dict[int, Any], can_id: int, entry: object, /) -> None:
    """Set ``table[can_id]`` by the one integer that this core has of an identifier: so a frame's handlers are
    found in a third of the time."""

class Stopwatch:
    """Measures by this machine's monotonic clock, whatever time the bench has."""

    def lap(self) -> int:
        """Return the time since the last call, or since this was made, ns."""

class WireFrame:
    """A classical CAN data or remote frame. Equal to another whose fields are equal."""

    __match_args__: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        can_id: int,
        data: bytes = b"",
        extended: bool = False,
        remote: bool = False,
        remote_length: int = 0,
    ) -> None: ...
    def __eq__(self, other: object) -> bool: ...
    def __hash__(self) -> int: ...
    @property
    def can_id(self) -> int:
        """11 bits, or 29 if ``extended``."""

    @property
    def data(self) -> bytes:
        """0..8 bytes; empty for a remote frame."""

    @property
    def extended(self) -> bool: ...
    @property
    def remote(self) -> bool: ...
    @property
    def remote_length(self) -> int:
        """DLC of a remote frame; not used for a data frame."""
    handed_at: Instant
    """When its sender handed it over, if noted; -1, UNTOLD, if not. The echo on a simulated bus or a hub
    carries it, and so identifies its frame. Never on the wire, and not compared."""

def data_frame(can_id: int, data: bytes, /) -> WireFrame:
    """A data frame with an identifier of 11 bits, in a third of the time of the constructor."""

class Link:
    """Frames in and out of a bus by its port. A class on top of it has ``send_waiting(until)``, which returns
    when to look again, ``let_wait(frame, at)`` and ``tell_troubles()``; ``receiving_failed(error)``, which
    raises; ``transmitting_failed(error, at)``, which returns if the frame is to wait."""

    def __new__(cls, *arguments: Any, **named: Any) -> Any: ...
    def use(self, port: object, now: Callable[[], Instant], failures: tuple[type[Exception], ...], /) -> None:
        """Receive and transmit by ``port``, a FramePort (servobench.drivers.wire.frame_port); its errors
        ``failures`` go to the class on top. Error: ValueError if there is one already."""
    waits: bool
    """Whether frames wait for room; then each call begins with ``send_waiting``."""
    sent_frames: int
    received_frames: int
    echoed_frames: int
    ignored_frames: int
    error_frames: int
    @property
    def port(self) -> Any:
        """As given to :meth:`use`."""

    @property
    def last_id(self) -> int:
        """Identifier of the last frame fetched; ``last_data`` and ``last_at`` belong to it too."""

    @property
    def last_data(self) -> bytes: ...
    @property
    def last_at(self) -> Instant: ...
    @property
    def last_own(self) -> bool:
        """True if it is an echo."""

    @property
    def last_handed_at(self) -> Instant:
        """If it is an echo: when the frame was handed over, where the bus reports that."""

    @property
    def needs_watching(self) -> bool:
        """True if somebody must receive while time passes, or frames are stamped or sent late."""

    def show(self, tap: object, /) -> None:
        """Have ``tap``, a FrameTap, see every frame from now on. Error: ValueError for the 17th."""

    def fetch(self, until: Instant, /) -> bool:
        """Fetch a data frame or an echo by ``until`` into ``last_id``, ``last_data``, ``last_at`` and
        ``last_own``; False if none came. Lets time pass. Raises BusDown if the bus is gone."""

    def send(self, can_id: int, data: bytes, /) -> Instant:
        """Queue a frame; returns the instant just before the bus was offered it.

        Raises BusDown if the bus is gone, or has taken nothing for a second.
        """

    def hand_over(self, frame: WireFrame, /) -> Instant:
        """As :meth:`send`, of any frame."""

    def offer(self, frame: WireFrame, at: Instant, /) -> bool:
        """Offer ``frame`` to the bus at ``at``; False if it has no room for it now."""

class Pump:
    """Hands the frames of a link to their handlers; see servobench.drivers.canopen.frame_pump."""

    def __init__(
        self,
        link: Link,
        handlers: dict[int, Callable[[bytes, Instant], None]],
        echo_handlers: dict[int, Callable[[bytes, Instant, Instant], None]],
        others: Callable[[int, bytes, Instant], None],
        keep_house: Callable[[Instant], None],
        now: Callable[[], Instant],
        sleep_until: Callable[[Instant], None],
        /,
    ) -> None: ...
    housekeeping_at: Instant
    def pump_one(self, until: Instant, /) -> bool:
        """Handle the next frame and return True; False once ``until`` has come without one."""

    def pump(self, until: Instant, /) -> None:
        """Handle frames, send what falls due, and return once ``until`` has come; at once if it has passed.

        Frames already waiting are handled in either case.
        """

    def rest(self, until: Instant, /) -> None:
        """Let time pass like :meth:`pump`, but leave frames in the bus's queue until ``until``, or until
        housekeeping is due: one wake-up instead of one per frame. The bus stamps them, so nothing is lost; on
        a bus that needs watching this is :meth:`pump`."""

class CommandWatch:
    """Looks for the value that a drive reports among the last commands.

    Of the ``cycles`` after the last command that a drive has heard, half pass until that is no recent one any
    more, and half to make sure that the drive goes on with it. So a drive that acts on a command only after
    more than half of them counts as deaf. Commands that stay the same prove nothing, and raise no alarm: the
    old one is as good as the new.

    A demand that stays the same to the last digit, for as long as half of the ``cycles``, while the commands
    do not, is followed neither, whatever they are; one of torque eight times, each after a further command,
    too. That alone is asked of speeds and positions, which a drive may reach by a ramp: the commands since
    the demand came to rest spread over more than twice the margin, and none of the newest is the demand. A
    speed that stays at 0, or against the commands, is on the way to none of them, though they be constant.
    """

    def __init__(
        self,
        cycles: int,
        margin_raw: int,
        *,
        equal: bool = True,
        share: int = 0,
        least_raw: int | None = None,
        unit_cycles: int = 0,
    ) -> None:
        """``margin_raw``: of a demand that follows; ``share``: beside it, one part in so many of the command.
        ``equal``: the demand of a drive that follows is a command; False: it is on the way to one, by a ramp
        that takes ``unit_cycles`` for a unit. ``least_raw``: the least speed whose sign counts; None: the
        demand is no speed. Error: ValueError for less than two cycles, or a number below 0."""

    def sent(self, raw: int, /) -> None:
        """A command was handed to the bus."""

    def excuse(self) -> None:
        """The drive reports by other means that it does not follow, or why it cannot."""

    def told(self, raw: int, limited: bool = False, /) -> None:
        """Take in the reported demand or torque; ``limited``: the drive says that it clips a command."""

    @property
    def follows(self) -> bool:
        """False once ``cycles`` commands went by unfollowed according to the drive's reports."""

class FollowReports:
    """What 6061h and 6041h say of whether a drive follows; see servobench.drivers.cia402.follow_watch."""

    def __init__(self, changed: Callable[[Instant], None], older_max: int, /) -> None:
        """``changed`` is called with the instant of a report that changes ``shown`` or ``ignores``.
        ``older_max``: so many reports of another mode before the commanded one was shown count."""

    def aim(self, commanded: int, bit: int, /) -> None:
        """Expect this 6061h. ``bit``: of the statusword, 0 while the drive ignores its target; 0: none."""

    def end(self) -> None:
        """The drive need not follow any more."""

    def mode_told(self, shown: int, at: Instant, /) -> None:
        """Take in a 6061h that arrived."""

    def status_told(self, statusword: int, at: Instant, /) -> None:
        """Take in a 6041h that arrived."""

    @property
    def shown(self) -> int:
        """The last 6061h, or the one that is expected."""

    @property
    def mode_at(self) -> Instant:
        """When it came."""

    @property
    def ignores(self) -> bool:
        """True while the statusword says that the drive ignores its target."""

    @property
    def mode_shown(self) -> bool:
        """True once 6061h has shown the commanded mode."""

    @property
    def bit_watched(self) -> bool:
        """True once the bit was seen set."""
    lapsed: bool
    """Set by the user: the drive does not follow, and so no CommandWatch is asked."""

class LastStatusword:
    """The last statusword of a drive, by PDO or SDO."""

    def __init__(self) -> None: ...
    def take(self, statusword: int, at: Instant, /) -> None:
        """Take in a statusword of the drive, read by SDO."""

    def expect(self, bits: int, wanted: int, silence: Duration, /) -> None:
        """Expect that ``bits`` of the statusword are ``wanted``, and that it is never older than
        ``silence``."""

    def as_expected(self, now: Instant, /) -> bool:
        """Whether it is as expected at ``now``; nothing is before :meth:`expect`."""

    @property
    def statusword(self) -> int:
        """0x6041, raw; -1 before the first."""

    @property
    def at(self) -> Instant:
        """When it arrived; -1 before the first."""

    @property
    def by_pdo(self) -> int:
        """The last one by PDO; -1 before the first."""

class Reception:
    """What the TPDOs of one drive tell, as readings; see servobench.drivers.cia402.readings."""

    def __init__(
        self,
        velocity_rad_s: float,
        torque_nm: float,
        position_rad: float,
        period_ns: Duration,
        stamp_bits: int,
        count_ns: int,
        leads: bool,
        stamped: bool,
        told: LastStatusword,
        follow: FollowReports,
        syncs: object,
    ) -> None:
        """``velocity_rad_s``, ``torque_nm``, ``position_rad``: of one unit of the drive, with its sign.
        ``count_ns``: of its stamp. ``leads``: a position comes before the speed of its SYNC; ``stamped``: the
        stamp comes with the speed. ``syncs`` has ``sync_count``. Error: ValueError for times beyond 1 s."""
    watch: CommandWatch | None
    """Takes in every demand, or torque, that arrives."""
    def anchor_position(self, raw: int, at: Instant, /) -> None:
        """Anchor the position: 0x6064 as read at ``at``, from which positions are extrapolated."""

    @property
    def readings(self) -> list[bytes]:
        """Those made so far, for the user to take out: each a row of 8-octet numbers. Speed, rad/s, position,
        rad, torque, N m, as floats; stamp, ns, or -2**63, instants of the speed, the position and the torque,
        statusword and its instant."""

    @property
    def readbacks(self) -> list[bytes]:
        """The same of demands 6074h that came with a SYNC: raw, instant, readings made by then, and 1 if it
        came in the frame of the last of them."""

    @property
    def changes(self) -> list[bytes]:
        """The same of demands sent on change: raw, stamp, ns, and instant."""

    def position_rad(self, raw: int | None, /) -> float:
        """Convert a raw position near the last one, on the scale of the readings; None: the last one."""

    def tell_watch(self, watch: CommandWatch, raw: int, /) -> None:
        """Pass a demand or torque to the watch. A drive that itself reports not following needs no watch."""

    @property
    def malformed(self) -> int:
        """PDOs whose length differs from the mapping."""

    @property
    def readings_made(self) -> int: ...
    @property
    def torque_nm(self) -> float:
        """The last one told; NaN before the first."""

    @property
    def torque_told_at(self) -> Instant: ...
    @property
    def position_told_at(self) -> Instant: ...

class Inlet:
    """Unpacks the frames of one TPDO for a Reception; a handler of a Pump, which calls it without Python."""

    def __init__(
        self,
        reception: Reception,
        octets: int,
        fields: tuple[tuple[int, int, bool] | None, ...],
        on_change: bool,
        /,
    ) -> None:
        """``octets``: of a frame as mapped. ``fields``: place, octets and whether it is signed, or None, of
        statusword, mode, torque, position, speed, stamp, demand and what a CommandWatch takes in.
        ``on_change``: not sent with SYNCs. Error: ValueError for a field that the frame does not have."""

    def __call__(self, data: bytes, at: Instant, /) -> None:
        """Take in a frame."""

    def keep(self) -> None:
        """Begin to keep the frames, malformed ones included."""

    def take_kept(self) -> bytes:
        """Return those kept since the last call, rows of ``=q8sq`` as struct has it: instant, octets, and the
        count of these that are the frame's."""

class SetPointFrame:
    """An RPDO with its present values, and the commands sent in it that wait for their echoes: at most 256,
    and 16 that later ones have overtaken. A handler of a Pump's echoes, which it calls without Python."""

    def __init__(self, link: Link, can_id: int, fields: tuple[tuple[int, int], ...], /) -> None:
        """``fields``: octets and kind of each value: 0 an unsigned, 1 a signed whole number, 2 a real one, 3
        octets. All are 0 at first. Error: ValueError for more than eight octets."""

    def hold(self, place: int, value: float | bytes, /) -> None:
        """Put a value in force. Error: ValueError for one that the field does not hold."""

    def send(self) -> Instant:
        """Send the frame; errors and result as of :meth:`Link.send`."""

    def await_echo(self, command: object, /) -> None:
        """Note that the frame just sent was for ``command``, which has ``on_bus_at``, ``maybe_at`` and
        ``unsent``."""

    def given_up(self, handed_at: Instant, /) -> None:
        """Note that the frame handed over at that instant was never sent: ``unsent``."""

    def __call__(self, data: bytes, at: Instant, handed_at: Instant, /) -> None:
        """Match an echo: ``on_bus_at`` of its command is ``at``. Without an instant of hand-over it is of
        the first command with such data since the last one seen; or, if the bus let frames overtake each
        other, to the last one before. It may also belong to others waiting with the same data: their
        ``maybe_at``, the first such."""

"""Series drawn for an axis: entity, name, colour and unit of each."""

from typing import TYPE_CHECKING, Final, NamedTuple

from servobench.hil.rows.recording_plan import AxisPlan, RecordingPlan

if TYPE_CHECKING:
    import rerun as rr

Color = tuple[int, int, int]
GREY, BLUE, RED, ORANGE = (176, 197, 227), (108, 148, 251), (206, 3, 79), (252, 170, 0)
GREEN, VIOLET, YELLOW, CORAL = (73, 212, 138), (84, 58, 250), (204, 206, 20), (185, 35, 8)
"""Lines of one plot are 40 apart (CIELAB) in protanopia and deuteranopia too, and each is seen on the dark
ground of the viewer and on its light one. Marks have shapes besides."""
CHANNEL_COLORS: Final = (BLUE, GREEN, VIOLET, YELLOW, CORAL, GREY)
AXIS_COLORS: Final = (BLUE, GREEN, ORANGE, VIOLET, CORAL)
"""Colours of the axes, where one plot shows all."""

TIMELINE: Final = "run_time"
OVERVIEW: Final = "/overview"
"""Below it the envelopes, by the paths of the full rows."""
LIMITS: Final = "/limits"
"""Below it what the signals are held against, by axis and plot."""
MILLI_RATED_MAX_NM: Final = 20.0
"""Up to this rated torque it is drawn in mN m, the unit of 6076h: its ticks are then as long as those of a
speed in r/min and a delay in us, and the plots begin at one x."""


class Series(NamedTuple):
    """One line of one plot."""

    path: str
    """Below the axis."""
    name: str
    color: Color
    width: float = 1.0
    steps: bool = False
    """It holds from one point to the next."""
    of_cycles: bool = True
    """Each cycle has a value of it; others have instants and an entity of their own."""

    def styled(self, color: Color | None = None, name: str = "") -> "rr.SeriesLines":
        """Return the series in Rerun's form; ``color``, ``name`` replace its own."""
        import rerun as rr

        modes = rr.components.InterpolationMode
        return rr.SeriesLines(
            names=name or self.name,
            colors=color or self.color,
            widths=self.width,
            # The default averages neighbours where there are more points than pixels, and hides the peaks.
            aggregation_policy="MinMax",
            interpolation_mode=modes.StepAfter if self.steps else modes.Linear,
        )


class Marks(NamedTuple):
    """Points of one plot."""

    path: str
    name: str
    marker: str
    """A shape of Rerun's, by its name."""
    color: Color = RED

    def styled(self) -> "rr.SeriesPoints":
        """Return the points in Rerun's form."""
        import rerun as rr

        shape = rr.components.MarkerShape.auto(self.marker)
        return rr.SeriesPoints(names=self.name, colors=self.color, markers=shape, marker_sizes=3.0)


SERIES: Final = (
    Series("speed/reference", "reference", GREY),
    Series("speed/estimate", "estimate", VIOLET, 2.4),
    Series("speed/measured", "measured", BLUE, 1.3),
    Series("error/error", "reference - measured", ORANGE),
    Series("position/reference", "reference", GREY),
    Series("position/measured", "measured", BLUE, 1.6),
    Series("position_error/error", "reference - measured", ORANGE),
    Series("torque/command", "command", GREY),
    Series("torque/load", "load", VIOLET, steps=True),
    Series("torque/measured", "measured", GREEN, 1.4),
    Series("torque/brake", "load measured", ORANGE, 1.4, of_cycles=False),
    Series("delay/delay", "delay", YELLOW),
    Series("commands/on_bus", "on the bus", BLUE),
    Series("commands/acting", "acting, at the latest", GREEN),
    Series("commands/computing", "computing", ORANGE),
    Series("clock/lower", "at least", GREY),
    Series("clock/upper", "at most", GREY),
    Series("clock/offset", "offset", VIOLET),
)
MARKS: Final = (
    Marks("speed/dropped", "dropout", "down"),
    Marks("delay/dropped", "dropout", "cross"),
    Marks("delay/uncertain", "uncertain", "diamond", VIOLET),
    Marks("commands/lost", "lost", "cross"),
)
LIMIT_SERIES: Final = (
    Series("speed/most", "limit of the drive", CORAL),
    Series("speed/least", "limit of the drive", CORAL),
    Series("error/most", "limit", CORAL),
    Series("error/least", "limit", CORAL),
    Series("position_error/most", "limit", CORAL),
    Series("position_error/least", "limit", CORAL),
    Series("torque/most", "limit of the command", CORAL),
    Series("torque/least", "limit of the command", CORAL),
    Series("delay/deadline", "deadline", CORAL),
)


def own_series(plan: RecordingPlan, axis: str) -> tuple[Series, ...]:
    """Return the series of an axis' controller signals and of its drive's observed objects."""
    drive = plan.observed.get(axis)
    told = [(f"controller/{name}", name, True) for name in plan.channels.get(axis, ())]
    told += [(signal.path, signal.name, False) for signal in (drive.signals if drive else ())]
    colors = CHANNEL_COLORS
    return tuple(
        Series(path, name, colors[place % len(colors)], of_cycles=of_cycles)
        for place, (path, name, of_cycles) in enumerate(told)
    )


def style_of(plan: RecordingPlan, path: str) -> "rr.SeriesLines | rr.SeriesPoints":
    """How the entity of a line or of points is drawn: by the part below the axis, which may be called like
    OVERVIEW; no name in that part divides it."""
    _, axis, plot, line = path.rsplit("/", 3)
    known: tuple[Series | Marks, ...] = (*SERIES, *MARKS, *LIMIT_SERIES, *own_series(plan, axis))
    return next(each for each in known if each.path == f"{plot}/{line}").styled()


def torque_scale(axis: AxisPlan) -> tuple[float, str]:
    """By what a torque in N m is multiplied to be drawn, and the unit that it has then."""
    rated = axis.rated_torque_nm
    return (1e3, "mN m") if rated is None or rated <= MILLI_RATED_MAX_NM else (1.0, "N m")

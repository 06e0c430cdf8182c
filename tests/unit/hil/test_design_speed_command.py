"""``hil design speed``: which question its options are, and what comes of a design."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import Result

from servobench.design.delay.delay_loop import Feedback, gain_for_error
from servobench.design.errors import DesignError
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.studies.speed import controller_text, dynamic, synthesis
from servobench.hil.studies.speed.synthesis import DesignRequest, Unreachable, Way
from tests.unit.hil.asked_studies import FILE, MOTOR, RATED, SIMULATED, Studies, hil, refusal

NETWORK = "[network]\nperiod_us = 2000\nlosses_in_a_row_max = 1\ndelay_max_us = 1000\n"


class Designs(Studies):
    """Of a static feedback; ``certificate``: why its sampled loop has none, None for no sampled loop."""

    def __init__(self) -> None:
        super().__init__()
        self.certificate: str | None = None

    def design(self, request: DesignRequest, _tell: Any) -> Any:
        self.answering("design")(request)
        sampled = self.certificate
        return SimpleNamespace(
            name="plain", figures={"gamma": 7.0}, sampled=sampled if sampled is None else
            SimpleNamespace(certified=not sampled, without_certificate=sampled),
        )  # fmt: skip

    @staticmethod
    def widen(result: Any) -> Any:
        return SimpleNamespace(**(vars(result) | {"name": "wide", "figures": {"gamma": 8.0}}))


@pytest.fixture
def designs(monkeypatch: pytest.MonkeyPatch) -> Designs:
    made = Designs()
    monkeypatch.setattr(synthesis, "DesignResult", SimpleNamespace)
    monkeypatch.setattr(synthesis, "design_speed", made.design)
    monkeypatch.setattr(synthesis, "with_bandwidths", made.widen)
    monkeypatch.setattr(controller_text, "controller_of", lambda result: f"K of {result.name}")
    monkeypatch.setattr(controller_text, "controller_text", lambda controller: f"text of {controller}\n")
    return made


def design(*arguments: str | Path) -> Result:
    return hil("design", "speed", FILE, *arguments)


@pytest.mark.usefixtures("designs")
def test_losses_that_nobody_could_see_are_warned_of_before_a_design(tmp_path: Path) -> None:
    path = tmp_path / "network.toml"
    clocks = "[network.clocks.axis1]\n[network.clocks.axis2]\nreadbacks_unordered = {}\n"
    for count, warned in ((0, False), (40, True)):
        path.write_text(NETWORK + clocks.format(count))
        done = design("--network", path)
        assert ("came while frames overtook one another or came twice (40 of axis2)" in done.stderr) is warned


PLAIN = Way("exact", Feedback.FULL, False, None, False)


def asked_for(
    gamma: float | None = None,
    delay_s: float | None = None,
    network: SampledNetwork | None = None,
    way: Way = PLAIN,
    load_nm: float = RATED[0],
    speed_rad_s: float = RATED[1],
    bandwidth_hz: float = 800.0,
) -> DesignRequest:
    return DesignRequest(MOTOR, gamma, delay_s, network, way, load_nm, speed_rad_s, bandwidth_hz)


SPEED = 1500.0 * RAD_S_PER_RPM


@pytest.mark.parametrize(
    ("options", "request_"),
    [
        (("--gamma", "125"), asked_for(125.0)),
        (("--delay-ms", "64"), asked_for(None, 0.064)),
        (("--delay-ms", "0"), asked_for(None, 0.0)),
        (("--gamma", "125", "--delay-ms", "2"), asked_for(125.0, 0.002)),
        (("--error-percent", "5"), asked_for(gain_for_error(5.0, *RATED))),
        (
            ("--error-percent", "5", "--load-nm", "0.6", "--speed-rpm", "1500"),
            asked_for(gain_for_error(5.0, 0.6, SPEED), load_nm=0.6, speed_rad_s=SPEED),
        ),
        (
            ("--gamma", "1", "--method", "lmi", "--feedback", "speed", "--current-bandwidth-hz", "99"),
            asked_for(1.0, way=Way("lmi", Feedback.SPEED, False, None, False), bandwidth_hz=99.0),
        ),
        (
            ("--gamma", "1", "--method", "ccl"),
            asked_for(1.0, way=Way("ccl", Feedback.FULL, False, None, False)),
        ),
        (
            ("--gamma", "1", "--integral", "--integral-time-ms", "250"),
            asked_for(1.0, way=Way("exact", Feedback.FULL, True, 0.25, False)),
        ),
    ],
)
def test_what_is_known_and_open_is_the_request(
    designs: Designs, options: tuple[str, ...], request_: DesignRequest
) -> None:
    told = design(*options, "--json")
    assert json.loads(told.stdout) == {
        "current_bandwidth_from": "--current-bandwidth-hz" if "99" in options else SIMULATED,
        "gamma": 7.0,
    }
    assert designs.asked["design"] == (request_,)


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "network.toml"
    path.write_text(NETWORK)
    return path


@pytest.mark.parametrize(
    ("options", "strategy", "losses", "tau_s", "agreed_s"),
    [
        ((), Strategy.ARRIVAL, 1, 0.001, 0.0),
        (("--delay-margin-percent", "50", "--extra-losses", "2"), Strategy.ARRIVAL, 3, 0.0015, 0.0),
        (("--strategy", "history"), Strategy.HISTORY, 1, 0.001, 0.005),
        # acts at SYNCs: 2 periods and a half are 3
        (("--strategy", "stamp"), Strategy.STAMP, 1, 0.001, 0.006),
        # so they are 3 and a hundredth
        (("--strategy", "stamp", "--delay-margin-percent", "102"), Strategy.STAMP, 1, 0.00202, 0.006),
        (("--extra-losses", "49"), Strategy.ARRIVAL, 50, 0.001, 0.0),
    ],
)
def test_a_network_file_is_the_network_of_the_design(
    designs: Designs, network: Path, options: tuple[str, ...], strategy: Strategy, losses: int,
    tau_s: float, agreed_s: float,
) -> None:  # fmt: skip
    assert design("--network", network, *options).exit_code == 0
    (request,) = designs.asked["design"]
    over = request.network
    assert (over.strategy, over.period_s, over.losses_max) == (strategy, 0.002, losses)
    assert (over.delay_max_s, over.agreed_delay_s) == (pytest.approx(tau_s), pytest.approx(agreed_s))
    assert request.delay_s == over.constant_delay_s
    assert request.way == PLAIN


@pytest.mark.parametrize(("delay_us", "periods"), [(0, 2), (99, 2), (101, 3), (2_000, 3), (2_101, 4)])
def test_an_agreed_delay_that_exceeds_whole_periods_by_a_twentieth_is_one_more(
    designs: Designs, network: Path, delay_us: int, periods: int
) -> None:
    network.write_text(NETWORK.replace("= 1000", f"= {delay_us}"))
    design("--network", network, "--strategy", "stamp")
    (request,) = designs.asked["design"]
    assert request.network.agreed_delay_s == pytest.approx(0.002 * periods)


def test_the_sampled_loop_may_be_the_one_that_is_made_best(designs: Designs, network: Path) -> None:
    design("--network", network, "--target", "sampled")
    assert designs.asked["design"][0].way == Way("exact", Feedback.FULL, False, None, True)


CCL = "expected full feedback without integral: Algorithm 4.2 knows no other"
INTEGRAL_TIME = "--integral-time-ms: found 5.0, expected --integral and --method exact with it"
NOTHING = "expected nothing of it with --structure predictor or hinf"
TARGET = "--target: found 'sampled', expected --network and --method exact with it"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("", "hil design speed: missing, expected --gamma or --error-percent, --delay-ms or --network, or "
             "one of each"),
        ("--gamma 1 --error-percent 2",
         "--error-percent: found 2.0, expected either --gamma or --error-percent"),
        ("--delay-ms 1 --network N", "--network: found 'N', expected either --delay-ms or --network"),
        ("--gamma 1 --method ccl --feedback speed", f"--method: found 'ccl', {CCL}"),
        ("--gamma 1 --method ccl --integral", f"--method: found 'ccl', {CCL}"),
        ("--gamma 1 --integral-time-ms 5", INTEGRAL_TIME),
        ("--gamma 1 --integral --method lmi --integral-time-ms 5", INTEGRAL_TIME),
        ("--gamma 1 --target sampled", TARGET),
        ("--network N --method lmi --target sampled", TARGET),
        ("--gamma 1 --encoder-counts 16",
         "--encoder-counts: found 16, expected --structure predictor or hinf with it"),
        ("--delay-ms 2 --structure hinf --gamma 1", f"--gamma: found 1.0, {NOTHING}"),
        ("--delay-ms 2 --structure predictor --error-percent 1", f"--error-percent: found 1.0, {NOTHING}"),
        ("--delay-ms 2 --structure hinf --integral", f"--integral: found True, {NOTHING}"),
        ("--delay-ms 2 --structure hinf --integral-time-ms 5", f"--integral-time-ms: found 5.0, {NOTHING}"),
        ("--structure hinf", "--delay-ms: missing, expected at least a period of 1 ms, or --network"),
        ("--structure hinf --period-ms 2 --delay-ms 1.5",
         "--delay-ms: found 1.5, expected at least a period of 2 ms, or --network"),
    ],
)  # fmt: skip
def test_options_that_contradict_each_other_are_refused(designs: Designs, options: str, said: str) -> None:
    assert refusal(design(*options.split())) == said
    assert designs.asked == {}


@pytest.mark.parametrize(
    ("change", "options", "said"),
    [
        (("= 1\n", "= 40\n"), ("--extra-losses", "11"),
         "FILE: network.losses_in_a_row_max: found 51, expected at most 50 in all; an outage is no pattern "
         "to design for: take it out of the file, and let a limit stop the bench"),
        (("= 1000\n", '= 1000\ncommands = "not measured"\n'), (),
         "FILE: network.commands: found 'not measured', expected measured or stated: losses and delays of "
         "the commands are part of the loop; measure with a drive that tells 6074h, or state "
         "command_losses_in_a_row_max and a delay_max_us that holds to the actuator, with commands = "
         '"stated"'),
        (("= 1\n", "= 6\n"), ("--structure", "hinf"),
         "--network: network.losses_in_a_row_max: found 6, expected at most 5 in all; give --delay-ms, "
         "--period-ms and --losses-max: a run in which more are lost tells so"),
        (("", ""), ("--structure", "hinf", "--delay-ms", "5"),
         "--delay-ms: found 5.0, expected either --network or --delay-ms"),
        (("", ""), ("--structure", "hinf", "--period-ms", "5"),
         "--period-ms: found 5.0, expected either --network or --period-ms"),
        (("", ""), ("--structure", "hinf", "--losses-max", "0"),
         "--losses-max: found 0, expected either --network or --losses-max"),
    ],
)  # fmt: skip
def test_a_network_that_no_design_is_for_is_refused(
    designs: Designs, network: Path, change: tuple[str, str], options: tuple[str, ...], said: str
) -> None:
    network.write_text(NETWORK.replace(*change, 1))
    assert refusal(design("--network", network, *options)) == said.replace("FILE", str(network))
    assert designs.asked == {}


def test_a_design_is_written_with_the_bandwidths_that_it_covers(designs: Designs, tmp_path: Path) -> None:
    out = tmp_path / "controller.toml"
    told = design("--gamma", "1", "--out", out)
    assert told.stderr == f"written {out}\n"
    assert told.stdout.split() == ["current_bandwidth_from", *SIMULATED.split(), "gamma", "8"]
    assert out.read_text() == "text of K of wide\n"
    designs.certificate = ""
    assert design("--gamma", "1", "--out", out).exit_code == 0


def test_a_sampled_loop_without_a_certificate_is_not_written(designs: Designs, tmp_path: Path) -> None:
    designs.certificate = "it grows"
    told = design("--gamma", "1", "--out", tmp_path / "x.toml", "--json")
    assert json.loads(told.stdout)["gamma"] == 8.0
    expected = "expected a loop that is certified; another --strategy or a shorter period may be"
    assert (told.exit_code, told.stderr) == (2, f"hil: error: --out: found 'it grows', {expected}\n")
    assert list(tmp_path.iterdir()) == []
    assert design("--gamma", "1").exit_code == 0


class OutOfReach(Unreachable):
    """Of a design that is made up."""

    @property
    def figures(self) -> dict[str, Any]:
        return {"feasible": False}

    def __str__(self) -> str:
        return "out of reach"


def test_a_gain_out_of_reach_is_bad_input_with_its_figures(designs: Designs) -> None:
    unasked: Any = None
    designs.fails = OutOfReach(unasked, unasked, None)
    told = design("--gamma", "1", "--json")
    assert (told.exit_code, json.loads(told.stdout)) == (2, {"feasible": False})
    assert told.stderr == "hil: out of reach\n"
    plain = design("--gamma", "1")
    assert (plain.exit_code, plain.stdout, plain.stderr) == (2, "", "hil: out of reach\n")


def test_a_design_that_does_not_exist_is_bad_input(designs: Designs) -> None:
    designs.fails = DesignError("no gain is stable")
    said = "hil design speed: found 'no gain is stable', expected a design that exists"
    assert refusal(design("--gamma", "1")) == said


# ---- predictor and H-infinity -------------------------------------------------------------------------


class DynamicDesigns(Studies):
    """Of both structures: what each was given."""

    def requested(self, *given: Any, **named: Any) -> str:
        self.asked["request"] = given, named
        return "the request"

    def designing(self, name: str) -> Any:
        made = SimpleNamespace(figures={"of": name}, controller=lambda: f"K by {name}")

        def design(*given: Any) -> Any:
            self.answering(name)(*given)
            return SimpleNamespace(certified=lambda: made)

        return design


@pytest.fixture
def dynamics(monkeypatch: pytest.MonkeyPatch) -> DynamicDesigns:
    made = DynamicDesigns()
    monkeypatch.setattr(dynamic, "request_of", made.requested)
    for name in ("design_speed_hinf", "design_speed_predictor"):
        monkeypatch.setattr(dynamic, name, made.designing(name))
    monkeypatch.setattr(controller_text, "controller_text", lambda controller: f"text of {controller}\n")
    return made


DRIVE = {"encoder_counts": 65536, "speed_filter_hz": 500.0, "dead_time_us": 100.0, "uneven_s": 0.0}


def test_a_predictor_is_designed_for_the_simulated_drive_where_nothing_else_is_said(
    dynamics: DynamicDesigns,
) -> None:
    told = design("--structure", "predictor", "--delay-ms", "2.5", "--json")
    assert json.loads(told.stdout) == {"current_bandwidth_from": SIMULATED, "of": "design_speed_predictor"}
    given, named = dynamics.asked["request"]
    assert given == (MOTOR, 800.0, 0.001, pytest.approx(0.0015), RATED[0], 0.05 * RATED[0])
    assert named == DRIVE
    assert dynamics.asked["design_speed_predictor"] == ("the request", 1, False)


def test_an_h_infinity_controller_is_designed_for_what_is_said(
    dynamics: DynamicDesigns, tmp_path: Path
) -> None:
    out = tmp_path / "hinf.toml"
    told = design(
        "--structure", "hinf", "--delay-ms", "2", "--period-ms", "2", "--losses-max", "0", "--load-nm", "0.4",
        "--torque-noise-nm", "0.02", "--encoder-counts", "4096", "--speed-filter-hz", "90",
        "--drive-dead-time-us", "0", "--current-bandwidth-hz", "333", "--out", out,
    )  # fmt: skip
    assert told.exit_code == 0
    assert dynamics.asked["request"] == (
        (MOTOR, 333.0, 0.002, 0.0, 0.4, 0.02),
        {"encoder_counts": 4096, "speed_filter_hz": 90.0, "dead_time_us": 0.0, "uneven_s": 0.0},
    )
    assert dynamics.asked["design_speed_hinf"] == ("the request", 0, False)
    assert (told.stderr, out.read_text()) == (f"written {out}\n", "text of K by design_speed_hinf\n")


def test_a_predictor_over_a_network_takes_its_losses_and_delay(
    dynamics: DynamicDesigns, network: Path
) -> None:
    network.write_text(NETWORK.replace("= 1\n", "= 5\n"))
    assert design("--structure", "predictor", "--network", network).exit_code == 0
    assert dynamics.asked["request"][0][2:4] == (0.002, 0.001)
    assert dynamics.asked["design_speed_predictor"] == ("the request", 5, True)


def test_a_predictor_that_does_not_exist_is_bad_input(dynamics: DynamicDesigns) -> None:
    dynamics.fails = DesignError("no filter")
    said = "hil design speed: found 'no filter', expected a design that exists"
    assert refusal(design("--structure", "predictor", "--delay-ms", "2")) == said

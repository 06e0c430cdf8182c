"""The controller on other days: another inertia, lost and late frames, a coarse encoder, a late host."""

import tomllib

import pytest


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.3])
def test_the_inertia_may_be_a_third_off(servo_bench, bench, controller, factor):
    motor = tomllib.loads((bench.parent / "motor.toml").read_text())
    motor["mechanics"]["inertia_kg_m2"] *= factor
    run = servo_bench(bench, {"drive.spindle.motor": motor}, controllers={"spindle": controller})
    run.assert_settles(within_s=0.6, band_percent=3)


@pytest.mark.servo_bus("simulated")
@pytest.mark.parametrize("percent", [1, 5, 10])
def test_independent_losses(servo_bench, bench, controller, percent):
    loss = {"loss": [{"probability": percent / 100}]}
    run = servo_bench(bench, faults=loss, controllers={"spindle": controller})
    run.assert_dropouts_handled(at_least=1)
    run.assert_settles(within_s=0.6, band_percent=5)


@pytest.mark.servo_bus("simulated")
@pytest.mark.parametrize("delay_us", [1000, 3000])
def test_a_gateway_that_takes_its_time(servo_bench, bench, controller, delay_us):
    late = {"delay": [{"delay_us": delay_us, "direction": "host_to_drive"}]}
    run = servo_bench(bench, faults=late, controllers={"spindle": controller})
    run.assert_settles(within_s=0.6, band_percent=3)


@pytest.mark.servo_bus("simulated")
def test_losses_in_bursts(servo_bench, bench, controller):
    bursts = {"burst": [{"p_good_to_bad": 0.01, "p_bad_to_good": 0.3, "loss_bad": 0.9}]}
    run = servo_bench(bench, faults=bursts, controllers={"spindle": controller})
    run.assert_dropouts_handled(at_least=2)
    run.assert_settles(within_s=0.6, band_percent=5)


@pytest.mark.servo_bus("simulated")
def test_a_coarse_encoder(servo_bench, bench, controller):
    coarse = {"drive.spindle.simulation.encoder_counts_per_revolution": 4096}
    run = servo_bench(bench, coarse, controllers={"spindle": controller})
    run.assert_settles(within_s=0.6, band_percent=5)


@pytest.mark.servo_bus("simulated")
def test_a_host_that_is_late_now_and_then(servo_bench, bench, controller):
    stalls = {"host_stall": [{"every_s": 0.15, "late_us": 4000}]}
    run = servo_bench(bench, faults=stalls, controllers={"spindle": controller})
    run.assert_settles(within_s=0.6, band_percent=5)

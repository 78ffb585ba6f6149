# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the way from a channel map to gains without a model.

Its steps are an experiment, the response, and a scenario that flies the aircraft.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from pytest import approx
from scipy.signal import cont2discrete, dlsim
from tests.conftest import REPOSITORY, invoke, refusing
from tests.maps import MAP_FILES

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.params import AircraftConfig
from autopilot_bridge.params import ChannelMap, load_map
from control_laws import excitation
from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics.errors import best_error, error_metrics
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError
from flight_core.tape import Signal, Tape
from flight_core.units import GRAVITY
from flight_design.identification import open_loop_fit
from flight_design.identification.bridge_identification import (
    IdentifiedChannels,
    channel_models,
    channel_pairs,
    experiment,
    join,
    map_text,
    measured_trims,
    over_link,
    within_range,
)
from flight_design.identification.flying_scenario import Flyable, flying_scenario
from flight_design.identification.open_loop_fit import ChannelModel, fit_channel
from flight_design.identification.response_identification import Response, identify_response

pytestmark = pytest.mark.slow

MAP = load_map("ardupilot")
SPEED = 25.0
DELAY = 0.05  # m/s; s, by which y is late
OSPREY = load_airframe("osprey")


def aircraft() -> AircraftConfig:
    """Return the osprey with servos and noise, and with y late by DELAY.

    The map knows none of this.
    """
    servo = find_scenario("osprey_servo")
    sensors = servo.aircraft.sensors.model_dump() | {"delay": DELAY}
    return servo.vary(
        aircraft={"gusts": {}, "rate": 100.0, "step": 0.01, "sensors": sensors}
    ).aircraft


def loaded(folder: Path, name: str, airframe: str, scenario: str) -> Scenario:
    """Return a scenario whose airframe file is written as the command writes it.

    The real aircraft replaces the airframe.
    """
    (folder / f"{name}_airframe.yaml").write_text(airframe)
    (folder / f"{name}.yaml").write_text(scenario)
    return replace(load_scenario(folder / f"{name}.yaml"), aircraft=aircraft())


class Identified(NamedTuple):
    """What a flight of the experiment showed."""

    response: Response
    models: list[ChannelModel | None]
    channels: IdentifiedChannels
    flying: Flyable
    folder: Path


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> Identified:
    folder = tmp_path_factory.mktemp("experiment")
    plan = experiment(MAP, SPEED, 0.15, str(folder / "experiment_airframe.yaml"), wait=1.0)
    tape = simulate(loaded(folder, "experiment", plan.airframe, plan.scenario))
    pairing, _ = channel_pairs(MAP)
    response = identify_response(tape["y"], tape["u"], pairing.outputs, pairing.inputs)
    models = channel_models(MAP, tape, [(0, 10**18)], SPEED)
    channels = join(MAP, response, models)
    flying = flying_scenario(MAP, channels, SPEED, str(folder / "flight_airframe.yaml"))
    return Identified(
        response=response, models=models, channels=channels, flying=flying, folder=folder
    )


def test_channels_of_unknown_aircraft_identified(identified: Identified) -> None:
    response = identified.response
    channels = identified.channels
    rows = [OSPREY.outputs.index(name) for name in response.outputs]
    columns = [list(OSPREY.inputs).index(name) for name in response.inputs]
    Omega = np.diag((OSPREY.matrix_c() @ OSPREY.matrix_b())[np.ix_(rows, columns)])
    # 30 %: Omega, lag and damping change places in what 8 Hz show; a loop with a phase margin of 54
    # degrees bears twice as much
    assert_allclose(np.diag(channels.Omega), Omega, rtol=0.3)
    lag = np.array([0.02 if name != "thrust" else 0.1 for name in response.inputs])
    # u is held for a period of 10 ms, so that it acts half of one late. V has no model, and its
    # step response is slow: its lag is less certain, and its bandwidth of 1.4 rad/s turns 50 ms
    # into 4 degrees of phase.
    expected = lag + DELAY + 0.005
    assert (
        np.abs(channels.lag + channels.delay - expected) < np.where(lag > 0.05, 0.05, 0.02)
    ).all()


def test_written_scenario_flies_aircraft_and_tracks(identified: Identified) -> None:
    flyable = identified.flying
    assert flyable.controller.D == (1, 1, 1, 1)
    assert flyable.scenario.splitlines()[4].startswith("# Phase margins ")
    tape = simulate(loaded(identified.folder, "flight", flyable.airframe, flyable.scenario))
    _, error = best_error(tape)
    rms = {name: error_metrics(error[name]).rms for name in error.names}
    # the figures that a first flight of an autopilot is asked for: 10, 20, 15 mrad/s in q, p, r and
    # 0.05 m/s
    assert rms["q"] < 0.010
    assert rms["p"] < 0.020
    assert rms["r"] < 0.015
    assert rms["V"] < 0.05


def test_gains_from_log_of_the_board_are_for_the_delay_of_the_link_too(
    identified: Identified,
) -> None:
    link_delay = 0.02
    later = over_link(identified.channels, link_delay)
    slower = flying_scenario(MAP, later, SPEED, str(identified.folder / "over_link.yaml"))
    board = identified.flying
    assert slower.controller.delay == approx(board.controller.delay + link_delay)
    # bandwidth times total lag is constant by the engineering procedure: a longer delay, a lower K
    slow_gains = slower.controller.law_params()
    fast_gains = board.controller.law_params()
    assert (slow_gains.K * slow_gains.input_scale < fast_gains.K * fast_gains.input_scale).all()


@pytest.fixture(scope="module")
def of_second_order(tmp_path_factory: pytest.TempPathFactory) -> tuple[IdentifiedChannels, Flyable]:
    """Return known channels and their flight.

    q is stiff, r and V are damped, and p has y_dot = Omega u.
    """
    damping, stiffness, zero = (
        np.array([values.get(name, 0.0) for name in MAP.outputs])
        for values in (
            {"q": 39.0, "r": 22.0, "V": 2.0},
            {"q": 1000.0, "r": 470.0},
            {"q": 25.0, "r": 2.0},
        )
    )
    Omega = np.diag([5.0 if name == "V" else 80.0 for name in MAP.outputs])
    none = 0.0 * damping
    channels = IdentifiedChannels(
        Omega=Omega,
        Omega_deviation=none,
        lag=none + 0.02,
        delay=none + 0.06,  # with 0.05 the margins lower q's integral
        damping=damping,
        stiffness=stiffness,
        zero=zero,
        misfit=none,
    )
    return channels, flying_scenario(
        MAP, channels, SPEED, str(tmp_path_factory.mktemp("known") / "airframe.yaml")
    )


def test_stiff_channel_gets_integral_by_which_loop_crosses_one_at_bandwidth(
    of_second_order: tuple[IdentifiedChannels, Flyable],
) -> None:
    # a light airplane: below 30 rad/s it answers the elevator with a pitch rate, not with its
    # derivative
    channels, flying = of_second_order
    controller = flying.controller
    k = list(MAP.outputs).index("q")
    params = controller.law_params()
    i = controller.outputs.index("q")
    gain = params.K[i] * params.input_scale[i] * channels.Omega[k, k]
    # the softened sign is one too
    integral = params.Lambda[i] + params.beta[i] / (params.K[i] * params.eps[i])
    s = 1j * gain
    loop = (
        gain
        * (s + integral)
        / s
        * (s + channels.zero[k])
        / (s**2 + channels.damping[k] * s + channels.stiffness[k])
    )
    assert abs(loop) == approx(1.0, rel=1e-6)


def test_channel_of_which_nothing_is_certain_refused(identified: Identified) -> None:
    response = identified.response
    models = identified.models
    refusals = response._replace(
        refusal=(None, Refusal("V by thrust: found no movement, expected one"), None, None)
    )
    unusable = [*models[:1], None, *models[2:]]
    with refusing(r"^V by thrust: found no movement, expected one$"):
        join(MAP, refusals, unusable)


class Known(NamedTuple):
    """A channel y'' + damping y' + stiffness y = Omega v', by default of first order.

    v has a lag, and y is late by a delay.
    """

    Omega: float = 80.0
    damping: float = 12.0
    stiffness: float = 0.0
    lag: float = 0.05  # s
    delay: float = 0.08  # s

    def measured(self, noise: float) -> tuple[Signal, Signal]:
        """Return output and input of an experiment in steps of 1 ms, with noise."""
        params = experiment(MAP, SPEED, 0.2, "airframe.yaml").controller
        t = np.arange(0.0, 14.0, 0.001)
        arrays = params.law_params()
        ticks = [(arrays.amplitude * excitation.signal(k, arrays))[0] for k in t[::10]]
        u = np.repeat(ticks, 10)
        v = np.zeros_like(t)
        z = np.zeros_like(t)
        y = np.zeros_like(t)
        for k in range(len(t) - 1):
            v[k + 1] = v[k] + 0.001 * (u[k] - v[k]) / self.lag
            y[k + 1] = y[k] + 0.001 * (
                self.Omega * v[k] - self.damping * y[k] - self.stiffness * z[k]
            )
            z[k + 1] = z[k] + 0.001 * y[k + 1]
        late = np.interp(t - self.delay, t, y) + noise * np.random.default_rng(1).standard_normal(
            len(t)
        )
        stamps = np.round(t * 1e9).astype(np.int64)
        return Signal(stamps[::10], ("q",), late[::10, None]), Signal(
            stamps[::10], ("elevator",), u[::10, None]
        )


@pytest.mark.parametrize("lag", [0.03, 0.4])
def test_model_of_channel_is_that_of_own_simulation_from_any_start(
    lag: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # From a slow start the search meets the same response with a lag of 1/12 s and a pole at 20
    # 1/s.
    monkeypatch.setattr(open_loop_fit, "STARTS", ((0.03, lag, 5.0, 30.0, 6.0),))
    # rad/s, as of a gyroscope
    model = fit_channel(*Known().measured(noise=0.002), "q", "elevator", 1.0)
    assert model is not None
    assert model.is_usable
    assert model.stiffness == 0.0
    assert_allclose(model.Omega / model.damping, 80.0 / 12.0, rtol=0.02)
    assert_allclose([model.Omega, model.lag + model.delay], [80.0, 0.13], rtol=0.1)


def test_noise_as_large_as_response_leaves_model_with_standard_errors() -> None:
    # 0.1 rad/s is the rms of the response: 70 % of y is unexplained, and gain and phase of the loop
    # are certain
    model = fit_channel(*Known().measured(noise=0.1), "q", "elevator", 1.0)
    assert model is not None
    assert model.misfit > 0.5
    assert model.is_usable
    gain, phase = model.at_loop_frequency()
    s = 0.5j / (model.delay + model.lag)
    response = 80.0 / (s + 12.0) / (0.05 * s + 1.0) * np.exp(-0.08 * s)
    assert abs(gain.value - abs(response)) < 3.0 * gain.deviation  # 99.7 %
    assert abs(phase.value + np.angle(response)) < 3.0 * phase.deviation


def test_fast_oscillation_of_light_airplane_found() -> None:
    # that of PX4's airplane in yaw: 480 / s^2 is 3.5 Hz, and its response returns to 0 within 0.15
    # s
    channel = Known(Omega=500.0, damping=24.0, stiffness=480.0, lag=0.01, delay=0.02)
    model = fit_channel(*channel.measured(noise=0.02), "q", "elevator", 1.0)
    assert model is not None
    assert model.is_usable
    assert_allclose(model[2:5], [500.0, 24.0, 480.0], rtol=0.1)


def thrust_with_phugoid(amplitude: float) -> Tape:
    """Return V by thrust in Lanchester's phugoid, and the climb of the pose.

    The thrust is behind a servo of 0.1 s, and the noise is the one of an airspeed sensor.

    V_dot = -0.5 V + 14 v - g gamma and gamma_dot = 2 g V / SPEED^2, because the weight is the lift
    at SPEED, and lift grows with its square. Without damping, the frequency is sqrt(2) g / SPEED,
    here 0.09 Hz. Source: F. W. Lanchester, "Aerodonetics", 1908.
    """
    params = experiment(MAP, SPEED, amplitude, "airframe.yaml").controller
    arrays = params.law_params()
    step = 0.01  # s, exact for a u that is held so long
    place = params.inputs.index("thrust")
    t = np.arange(0.0, params.duration, step)
    u = np.array([(arrays.amplitude * excitation.signal(instant, arrays))[place] for instant in t])
    A = np.array([[-0.5, -GRAVITY, 14.0], [2.0 * GRAVITY / SPEED**2, 0.0, 0.0], [0.0, 0.0, -10.0]])
    plant = A, np.array([[0.0], [0.0], [10.0]]), np.eye(3), np.zeros((3, 1))
    _, states, _ = dlsim((*cont2discrete(plant, step)[:4], step), u)
    noise = 0.02 * np.random.default_rng(1).standard_normal(len(t))  # m/s
    stamps = np.round(t * 1e9).astype(np.int64)
    y = np.zeros((len(t), 4))
    y[:, list(MAP.outputs).index("V")] = states[:, 0] + noise
    held = np.zeros((len(t), 4))
    held[:, place] = u
    pose = Signal(stamps, ("climb",), SPEED * states[:, 1:2])
    return Tape(
        {
            "y": Signal(stamps, tuple(MAP.outputs), y),
            "u": Signal(stamps, params.inputs, held),
            "pose": pose,
        }
    )


def test_thrust_told_from_phugoid_by_climb() -> None:
    tape = thrust_with_phugoid(0.2)
    spans = [(0, 10**18)]
    place = channel_pairs(MAP)[0].outputs.index("V")
    model = channel_models(MAP, tape, spans, SPEED)[place]
    assert model is not None
    assert model.is_usable
    assert_allclose([model.Omega, model.damping], [14.0, 0.5], rtol=0.05)
    # s: a bandwidth of 1.5 rad/s turns 30 ms into 3 degrees
    assert model.lag + model.delay == approx(0.1, abs=0.03)
    of_log_alone = fit_channel(tape["y"], tape["u"], "V", "thrust", 1.0)
    assert of_log_alone is not None
    assert of_log_alone.Omega > 1.5 * 14.0, "the phugoid is large enough to matter"


def test_a_refused_experiment_leaves_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    new = tmp_path / "found"
    below_file = tmp_path / "file" / "found"
    for name, folder, sentence in (
        (str(MAP_FILES["ardupilot_2024"]), new, "map ardupilot_2024: envelope: found none of"),
        ("ardupilot", below_file, f"--write: {below_file} cannot be written (Not a directory)"),
    ):
        arguments = ["identify", "bridge", name, "--speed", "25", "--write", str(folder)]
        result = invoke(*arguments)
        assert isinstance(result.exception, ParameterError)
        assert str(result.exception).startswith(sentence)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_written_map_has_trims_that_were_sent() -> None:
    row = MAP.inputs["elevator"]
    names = tuple(f"{row.message}.{row.field}" for row in MAP.inputs.values())
    raw = np.full((20, 4), 0.25)  # of the axes; the pause after engagement is at trim
    raw[10:] = 0.9
    commands = Signal(np.arange(20) * 150_000_000, names, raw)
    trims = measured_trims(MAP, commands, 0)
    assert trims["elevator"] == approx(0.25 * row.scale)
    channel_map = ChannelMap.validate_mapping(
        yaml.safe_load(map_text(MAP, {"elevator": trims["elevator"]}, "a log")), "map"
    )
    assert channel_map.inputs["elevator"].trim == approx(0.25 * row.scale, rel=1e-4)
    assert channel_map.outputs == MAP.outputs


def test_trim_near_a_stop_narrows_the_limits_and_says_what_to_change() -> None:
    thrust = MAP.inputs["thrust"]
    trims = {name: row.trim for name, row in MAP.inputs.items()}
    assert within_range(MAP, trims)[1] == []
    narrower, sentences = within_range(MAP, trims | {"thrust": 0.85})
    assert narrower.inputs["thrust"].lower == thrust.lower
    assert narrower.inputs["thrust"].upper == approx(0.15, rel=1e-3)
    expected = (
        "thrust: its trim is 0.85, so that the upper limit is 0.15 in place of 0.3: fly "
        "slower, or trim the aircraft otherwise"
    )
    assert sentences == [expected]
    assert ChannelMap.validate_mapping(
        yaml.safe_load(map_text(narrower, {"thrust": 0.85}, "a log")), "map"
    )
    with refusing(
        r"inputs\.thrust: found a trim of 1 at its stop, expected room on both sides: fly "
        r"slower"
    ):
        within_range(MAP, trims | {"thrust": 1.0})


QUADROTOR = REPOSITORY / "examples" / "px4_quadrotor"
HOVER_MAP = load_map(str(QUADROTOR / "map.yaml"))


def test_quadrotor_identified_and_flown_without_a_name_of_a_fixed_wing(tmp_path: Path) -> None:
    """The airframe of the example is found by an experiment without an airspeed.

    Its channels are q, p, r and a vertical speed.
    """
    frame = str(QUADROTOR / "airframe.yaml")

    def flown(name: str, airframe: str, scenario: str) -> Tape:
        scenario_of_flight = loaded(tmp_path, name, airframe, scenario)
        sensors = {"noise": [0.02, 0.05, 0.02, 0.01], "delay": 0.04}
        real = {"airframe": frame, "rate": 100.0, "step": 0.01, "sensors": sensors}
        return simulate(
            replace(scenario_of_flight, aircraft=AircraftConfig.validate_mapping(real, "aircraft"))
        )

    plan = experiment(HOVER_MAP, None, 0.2, str(tmp_path / "experiment_airframe.yaml"), wait=1.0)
    tape = flown("experiment", plan.airframe, plan.scenario)
    pairing, _ = channel_pairs(HOVER_MAP)
    response = identify_response(tape["y"], tape["u"], pairing.outputs, pairing.inputs)
    channels = join(HOVER_MAP, response, channel_models(HOVER_MAP, tape, [(0, 10**18)], None))
    airframe_file = load_airframe(frame)
    # q, p, r by a noise of 20 mrad/s
    assert_allclose(np.diag(channels.Omega), np.diag(airframe_file.matrix_b()), rtol=0.1)
    flyable = flying_scenario(HOVER_MAP, channels, None, str(tmp_path / "flight_airframe.yaml"))
    assert "speed" not in yaml.safe_load(flyable.airframe)
    _, error = best_error(flown("flight", flyable.airframe, flyable.scenario))
    rms = {name: error_metrics(error[name]).rms for name in error.names}
    # the noise alone is 0.02 rad/s and 0.05 m/s; the commands have 0.15 rad/s and 1 m/s
    assert max(rms["q"], rms["p"], rms["r"]) < 0.04
    assert rms["vertical_speed"] < 0.1

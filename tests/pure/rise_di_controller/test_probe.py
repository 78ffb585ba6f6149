# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the probe of the inputs during an engagement, and the test of the response."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from pytest import approx

from c_export.constants import exportable
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_campaign.batch.batch import vehicle
from flight_core.channels import LEAST_EFFECT, UNKNOWN, reason_against_inputs
from flight_core.parameters import ParameterError
from flight_core.rates import nanoseconds
from flight_core.tape import Tape
from rise_di_controller.guard.probe import EffectTest, Probe

WINDOW = 6.0  # s, by default
JAMMED = 8.0  # s
SEEN = 8.0  # s after it: what a pilot at 150 m has
SURFACES = ("elevator", "aileron", "rudder")
EFFECT = (0.02, 0.02, 0.02, 0.0)  # rad/s, the default


def with_probe(**values: Any) -> dict[str, Any]:
    """Return the changes that give a controller a probe."""
    return {"probe": {"effect": EFFECT, "window": WINDOW} | values}


def probed(duration: float, *faults: str) -> Scenario:
    """Return the osprey with the default probe, in calm air and without commands."""
    calm = find_scenario("osprey_servo", duration)
    still = calm.reference_model.model_copy(update={"pulses": {}, "coordinated_turn": None})
    return calm.vary(
        reference_model=still, controller=with_probe(), aircraft={"actuators": {"faults": faults}}
    ).vary(aircraft={"rate": 100.0, "step": 0.005}, reference_model={"rate": 100.0})


@cache
def jammed(surface: str) -> Tape:
    return simulate(probed(JAMMED + SEEN, f"{surface} stuck {JAMMED}"))


def alarms(tape: Tape) -> list[tuple[float, str]]:
    """Return (t, sentence) for each test that finds an input without effect."""
    effects = tape["effects"]
    reasons = (reason_against_inputs(effects.names, row) for row in effects.values.tolist())
    rows = zip(tape.time("effects").tolist(), reasons, strict=True)
    return [(t, str(reason)) for t, reason in rows if reason]


@pytest.mark.parametrize("surface", SURFACES)
def test_surface_stuck_in_trim_in_calm_air_is_seen_and_no_other(surface: str) -> None:
    first, sentence = alarms(jammed(surface))[0]
    assert JAMMED < first < JAMMED + SEEN
    assert all(said.startswith(f"{surface} does not answer") for _, said in alarms(jammed(surface)))
    assert sentence.endswith("% of its effect")


def test_healthy_surfaces_are_not_called_stuck_in_commands_and_gusts() -> None:
    """No healthy surface is reported as stuck during commands and two gusts.

    More than 80 windows of three surfaces are tested.
    """
    tape = simulate(
        find_scenario("osprey_servo", 48.0).vary(
            controller=with_probe(),
            aircraft={"rate": 100.0, "step": 0.005},
            reference_model={"rate": 100.0},
        )
    )
    assert len(tape["effects"].values) > 80
    assert alarms(tape) == []


def test_flight_with_a_probe_replays_to_the_bit() -> None:
    tape = jammed("elevator")
    assert replay(tape).is_equal()


def test_sines_are_orthogonal_over_the_window_and_tell_u_alone() -> None:
    """The sines have whole numbers of periods in a window.

    So each is seen without the others.
    """
    controller = probed(20.0).controller
    probe = controller.guard().probe
    assert probe is not None
    stamps = np.arange(0, probe.window_ns, nanoseconds(0.01))
    sines = np.array([probe.at(int(stamp)) for stamp in stamps])[:, :3]
    product = sines.T @ sines / len(sines)
    assert product == approx(np.diag(probe.amplitude[:3] ** 2 / 2.0), abs=1e-12)
    assert probe.amplitude[3] == 0.0  # V is not a rate


def test_weakest_input_has_the_lowest_frequency() -> None:
    """The rudder has the lowest frequency, because its effect is a sixth of the elevator's."""
    probe = probed(20.0).controller.guard().probe
    assert probe is not None
    assert probe.harmonic[:3].argmin() == 2


def test_engagement_begins_at_the_u_of_before() -> None:
    """The first u of the law is close to the last u before the engagement.

    It differs by one step of the law, which is at most 0.01 rad/s of K e from noise.
    """
    tape = jammed("elevator")
    u = tape["internals"]
    first = u.values[:2, [u.names.index(f"u.{name}") for name in SURFACES]]
    alone = simulate(probed(0.05).vary(controller=with_probe(effect=(1e-9, 0.0, 0.0, 0.0))))
    log = alone["internals"]
    amplitudes = log.values[:2, [log.names.index(f"u.{name}") for name in SURFACES]]
    probe = probed(20.0).controller.guard().probe
    assert probe is not None
    omega = 2.0 * np.pi * probe.harmonic / WINDOW
    assert (np.abs(first - amplitudes) <= 1.01 * (probe.amplitude * omega)[:3] * 0.01).all()


def test_false_alarms_are_no_more_than_stated() -> None:
    """The rate of false alarms is at most the stated one.

    The surface has the least effect that still passes, in white noise: y = LEAST_EFFECT gain u +
    noise.
    """
    false_alarm, trials = 0.05, 400
    probe = Probe(np.array([0.01]), np.array([12.0]), nanoseconds(WINDOW))
    random = np.random.default_rng(7)
    stamps = np.arange(0, probe.window_ns + nanoseconds(0.6), nanoseconds(0.05))
    u = np.array([probe.at(int(stamp)) for stamp in stamps])
    below = 0
    for _ in range(trials):
        test = EffectTest(probe, np.array([2.0]), false_alarm)
        y = 2.0 * LEAST_EFFECT * u + 0.004 * random.standard_normal(u.shape)
        for stamp, y_k, u_k in zip(stamps.tolist(), y, u, strict=True):
            most = test.take(stamp, y_k, u_k)
            if most is not None:
                below += most[0] < LEAST_EFFECT
                break
    deviation = (false_alarm * (1.0 - false_alarm) * trials) ** 0.5
    assert below <= false_alarm * trials + 3.0 * deviation


def test_input_that_rests_at_a_limit_tells_nothing() -> None:
    probe = Probe(np.array([0.01]), np.array([12.0]), nanoseconds(WINDOW))
    test = EffectTest(probe, np.array([2.0]), 1e-3)
    results = [
        test.take(nanoseconds(0.05 * k), np.array([0.1]), np.array([0.2])) for k in range(200)
    ]
    assert {float(most[0]) for most in results if most is not None} == {UNKNOWN}


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"effect": (0.1,)}, "probe.effect"),
        ({"effect": (0.0,) * 4}, "no output to probe"),
        ({"lowest": 3.5}, "probe.lowest: found sines up to 4.83 Hz, expected at most 4 Hz"),
    ],
)
def test_probe_that_cannot_be_measured_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        find_scenario("osprey_servo").vary(controller=with_probe(**changes))


def test_what_has_no_probe_refuses_one() -> None:
    """An allocation, the C code and campaigns refuse a probe, because they do not fly one."""
    with pytest.raises(ParameterError, match="probe: found an allocation beside it"):
        find_scenario("x8_elevons").vary(controller={"probe": {"window": WINDOW}})
    with pytest.raises(ParameterError, match=r"controller\.probe"):
        exportable(probed(20.0).controller)
    with pytest.raises(ParameterError, match=r"controller\.probe"):
        vehicle(probed(20.0))

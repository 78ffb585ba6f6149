# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test guarantees in which one input has any limits: what they prove, and what is refused."""

import copy
import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.limit_attacks import ENDS, ends_of
from benchmarks.limit_attacks import loop_of as flown_loop
from tests.conftest import refusing
from tests.pure.flight_analysis.test_certificate import Content, _checker

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.certificate import limit_certificate
from flight_analysis.linear_loop.loop_margins import LinearLoop, scenario_loop
from flight_analysis.linear_loop.saturation import (
    SETTLING,
    LimitGuarantee,
    Multiplier,
    guarantee_with_limit,
)
from flight_cli.gains_saturation import limit_text

Alter = Callable[[Content], object]


def linear_loop(name: str, uncertainty: float) -> LinearLoop:
    scenario = find_scenario(name)
    return scenario_loop(scenario, scenario.controller, 1, uncertainty)


def certified(name: str, limited: str, uncertainty: float) -> Content:
    linear = linear_loop(name, uncertainty)
    guarantee = guarantee_with_limit(linear, limited)
    assert guarantee is not None
    assert guarantee.is_proved
    content: Content = json.loads(limit_certificate(linear, guarantee, {}))
    return content


@pytest.fixture(scope="module")
def rudder() -> Content:
    """Return a certificate that every aircraft within 10 % settles."""
    return certified("osprey_servo", "rudder", 0.1)


@pytest.fixture(scope="module")
def throttle() -> Content:
    """Return a certificate that no aircraft within 20 % has a periodic motion.

    The integrator of the throttle unwinds at a limited rate.
    """
    return certified("jsbsim_c172p", "throttle", 0.2)


def checked(content: Content, folder: Path) -> str:
    """Return what the checker says about a content that is signed again.

    Raises ValueError if the checker refuses it.
    """
    module = _checker()
    rest = {key: value for key, value in content.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True)
    path = folder / "certificate.json"
    path.write_text(json.dumps(rest | {"digest": hashlib.sha256(text.encode()).hexdigest()}))
    with np.errstate(all="ignore"):
        file = module.read(path)
        said: str = module.report_of(file, module.check(file))
    return said


def test_checker_proves_that_every_aircraft_settles(rudder: Content, tmp_path: Path) -> None:
    said = checked(rudder, tmp_path)
    assert "settles with any limits of rudder around where it settles, for each" in said
    assert "B[r,rudder] (B 6, 2) 10 %" in said
    assert "limits of the other inputs, rates of all" in said


def test_checker_proves_that_no_aircraft_oscillates(throttle: Content, tmp_path: Path) -> None:
    said = checked(throttle, tmp_path)
    assert "no periodic motion of up to 125.6 s, with any limits of throttle, for each" in said


def _limit(**members: Any) -> Alter:
    return lambda content: content["limit"].update(members)


def _steps(content: Content) -> list[dict[str, Any]]:
    """Return the steps of the part with the limit."""
    return next(part["steps"] for part in content["parts"] if "s" in str(part["steps"][0].keys()))


def _each_step(**members: float) -> Alter:
    """Return an alteration that adds a number to members of the steps with a limit."""

    def alter(content: Content) -> None:
        for step in _steps(content):
            for name, more in members.items():
                if name in step:
                    step[name] = (np.array(step[name]) + more).tolist()

    return alter


def _without(*names: str) -> Alter:
    def alter(content: Content) -> None:
        for step in _steps(content):
            for name in names:
                step.pop(name, None)

    return alter


@pytest.mark.parametrize(
    ("alter", "sentence"),
    [
        (_limit(taps=[math.nan]), "NaN"),
        (_limit(taps=[math.inf]), "Infinity"),
        (_limit(taps=["0.5"]), "taps"),
        (_limit(taps=[True]), "taps"),
        (_limit(taps=[-0.5]), "taps"),
        (_limit(taps=[1.0]), "a sum of at most 1"),
        (_limit(taps=[0.9999]), "a sum of at most 1"),
        (_limit(lags=[-17, 17], taps=[0.7, 0.4]), "a sum of at most 1"),
        (_limit(lags=[-17, -17], taps=[0.3, 0.3]), "ticks but 0"),
        (_limit(lags=[0]), "ticks but 0"),
        (_limit(lags=[-16.5]), "ticks but 0"),
        (_limit(lags=[-2000]), "lags"),
        (_limit(lags=[-17, -16]), "taps"),
        (_limit(lags=[], taps=[]), "not proved"),
        (_limit(lags=[17]), "not proved"),
        (_limit(taps=[0.05]), "not proved"),
        (_limit(input="aileron"), "s where an input is cut off|not proved"),
        (_limit(input="elevator"), "s where an input is cut off"),
        (_limit(input="thrust"), "s where an input is cut off"),
        (_limit(input="flap"), "an input of the file"),
        (_limit(input=1), "limit.input"),
        (_limit(slowest=-1.0), "slowest"),
        (_limit(slowest=math.nan), "NaN"),
        (_limit(slowest=400.0), "slowest"),
        (_limit(slowest=0.05), "not within"),
        (_limit(rates=0.0), "rates"),
        (lambda content: content["limit"].pop("slowest"), "slowest"),
        (lambda content: content["limit"].pop("taps"), "taps"),
        (lambda content: content.pop("limit"), "s"),
        (lambda content: content.update(limit=[]), "limit"),
        (lambda content: content.update(limits=content["limit"]), "limits"),
        (lambda content: content.update(size=30.0 * content["size"]), "not proved"),
        (lambda content: _steps(content).pop(0), "not within|boxes are not proved"),
        (lambda content: _steps(content).clear(), "boxes are not proved"),
        (lambda content: _steps(content)[0].update(s=math.nan), "NaN"),
        (lambda content: _steps(content)[0].update(s=[0.0]), " s"),
        (lambda content: content["parts"].pop(0), "no proof for"),
        (_without("s"), "s where an input is cut off"),
        (_each_step(s=6.0), "not proved"),
        (_each_step(t=4.0), "not proved"),
        (_each_step(t=-4.0), "not proved"),
    ],
)
def test_altered_certificate_of_a_limit_is_refused(
    alter: Alter, sentence: str, rudder: Content, tmp_path: Path
) -> None:
    altered = copy.deepcopy(rudder)
    alter(altered)
    with pytest.raises(ValueError, match=sentence):
        checked(altered, tmp_path)


@pytest.mark.parametrize(
    ("alter", "sentence"),
    [
        # from 0 rad/s on it is the claim that an integrator forbids
        (_limit(slowest=0.0), "a sum of at most 1|boxes are not proved|not proved"),
        (_limit(slowest=0.01), "boxes are not proved"),
        (_limit(input="rudder"), "s where an input is cut off"),
    ],
)
def test_limit_of_an_integrator_is_not_proved_to_settle(
    alter: Alter, sentence: str, throttle: Content, tmp_path: Path
) -> None:
    altered = copy.deepcopy(throttle)
    alter(altered)
    with pytest.raises(ValueError, match=sentence):
        checked(altered, tmp_path)


def test_weighted_sum_over_any_rising_curve_is_not_negative() -> None:
    """The sum of rho^-2k w (a - h * a) is not negative, for w = u - phi(u) and taps on both sides.

    phi is an asymmetric limit, or a stair with slopes between 0 and 1 through 0.
    """
    generator = np.random.default_rng(11)
    least = np.inf
    for _ in range(300):
        rho = float(generator.choice([1.0, SETTLING, 0.97]))
        lags = generator.choice(np.r_[-9:0, 1:10], 4, replace=False)
        h = generator.dirichlet(np.ones(4)) * generator.choice([0.5, 1.0])
        h = h / max(1.0, float(np.sum(h * rho ** -np.abs(lags))))
        k = np.arange(60)
        u = generator.normal(size=60).cumsum() * rho**k
        knots = np.sort(np.r_[0.0, generator.normal(size=6) * np.abs(u).max()])
        rises = np.r_[0.0, np.cumsum(generator.choice([0.0, 1.0, 0.4], 6) * np.diff(knots))]
        a = np.interp(u, knots, rises) - float(np.interp(0.0, knots, rises))
        w, b = (u - a) / rho**k, np.r_[np.zeros(60), a / rho**k, np.zeros(60)]
        late = sum(tap * b[60 - lag : 120 - lag] for tap, lag in zip(h, lags, strict=True))
        least = min(least, float(w @ (b[60:120] - late)) / max(1.0, float(np.abs(w) @ np.abs(w))))
    assert least > -1e-12


def test_taps_leave_phase_to_aircraft_of_the_box(rudder: Content) -> None:
    """Re(m S) > 0 at corners, with an S computed from the numbers of the file alone."""
    d = rudder["size"] * np.random.default_rng(4).choice([-1.0, 1.0], (12, len(rudder["part"])))
    F, W, K = flown_loop(rudder, d)
    turn = np.r_[1e-4, np.geomspace(1e-3, math.pi, 60)]
    z = SETTLING * np.exp(1j * turn)
    motion = z[:, None, None] * np.eye(F.shape[1]) - F[:, None]
    S = 1.0 + np.linalg.solve(motion, W[:, None, :, None].astype(complex))[..., 0] @ K
    lags, taps = np.array(rudder["limit"]["lags"]), np.array(rudder["limit"]["taps"])
    m = 1.0 - np.exp(-1j * np.outer(turn, lags)) @ taps
    assert (m * S).real.min() > 0.0
    assert S.real.min() < 0.0  # without taps there is no proof


def test_aircraft_of_the_box_settle_from_far_beyond_the_limits(rudder: Content) -> None:
    generator = np.random.default_rng(6)
    d = rudder["size"] * generator.choice([-1.0, 1.0], (12, len(rudder["part"])))
    assert dict(zip(ENDS, ends_of(rudder, d, generator), strict=True))["settles"] == 12


SPIRAL = {
    "A[beta,beta]": -1.0, "A[beta,p]": 1.0, "A[beta,r]": 1.0, "A[p,beta]": -1.0, "A[p,p]": -1.0,
    "A[p,r]": 1.0, "A[r,beta]": 1.0, "A[r,p]": -1.0, "A[r,r]": -1.0, "B[p,aileron]": -1.0,
    "B[p,rudder]": 1.0, "B[r,aileron]": 1.0, "B[r,rudder]": -1.0,
}  # fmt: skip


@pytest.mark.parametrize(("deviation", "grows"), [(0.1, False), (0.112, True)])
def test_aileron_at_its_limit_lets_the_spiral_of_an_aircraft_grow(
    deviation: float, *, grows: bool, rudder: Content
) -> None:
    """This is why no proof with limits of the aileron goes beyond 11.2 %."""
    held = copy.deepcopy(rudder)
    held["limit"]["input"] = "aileron"
    corner = np.array([SPIRAL.get(name, 0.0) for name in held["names"]])
    F, W, K = flown_loop(held, deviation / np.array(held["part"]) * corner[None])
    fastest = np.abs(np.linalg.eigvals(F[0] - np.outer(W[0], K))).max()
    assert (fastest > 1.0 + 1e-6) == grows


@pytest.mark.parametrize(
    ("size", "slowest", "sentence"),
    [
        (0.24, 0.0, "the loop settles for every aircraft within 24.0 %, with any limits of rudder"),
        (0.3, 0.05, "no motion is periodic up to 126 s for every aircraft within 30.0 %, with any"),
    ],
)
def test_command_says_what_holds_and_what_proves_it(
    size: float, slowest: float, sentence: str
) -> None:
    multiplier = Multiplier(slowest, np.array([1]), np.array([0.5]))
    guarantee = LimitGuarantee("rudder", 0.3, size, multiplier, [])
    said = limit_text("rudder", guarantee, "58911e12fa30")
    assert said[0].startswith(f"guarantee: {sentence}")
    assert said[0].endswith("(certificate 58911e12fa30)")
    assert "examples/check_certificate.py proves the certificate" in said[-1]
    assert guarantee.is_proved == (size == 0.3)


def test_command_says_that_nothing_holds() -> None:
    (said,) = limit_text("thrust", None, "58911e12fa30")
    assert said.startswith("guarantee: none with any limits of thrust: no taps")


def test_limit_of_an_unknown_input_is_refused() -> None:
    with refusing("limit: found flap, expected an input: elevator, aileron, rudder, thrust"):
        guarantee_with_limit(linear_loop("osprey_servo", 0.1), "flap")

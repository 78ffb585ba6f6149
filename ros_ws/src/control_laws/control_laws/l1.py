# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement L1 adaptive output control from y, y_m and the nominal Omega."""

from typing import Any, NamedTuple

import numpy as np

from control_laws.nominal_model import NominalModel, filter_gain, saturate_with_excess
from flight_core.fields import Field
from flight_core.parameters import Numbers, ParameterError, Positives, require, require_length
from flight_core.vectors import Array, FloatArray, array_namespace
from rise_di_controller.law.control_law import ControlLaw, Measurements, without_limits
from rise_di_controller.law.decomposition import DecompositionError, signs
from rise_di_controller.law.saturation import Limits
from rise_di_controller.params import ControllerConfig

ADAPTATION_POLE = 1.0
"""Pole a of the predictor, 1/s. The estimate is too small by the factor a dt / (exp(a dt) - 1),
which is 0.995 at 100 Hz. The feedback K e corrects the rest."""


class L1Params(NamedTuple):
    """Gains of L1 over m channels, (m,), and the nominal Omega."""

    K: Array  # 1/s
    bandwidth: Array  # bandwidth of the low-pass filter C(s), rad/s
    Omega: Array  # (m, m)
    inverse: Array  # inverse of Omega, (m, m)


class L1State(NamedTuple):
    """State of L1 between two ticks, each field with the shape (m,)."""

    e: Array
    y_before: Array  # y of this tick, from which the next tick predicts
    y_dot_u: Array  # Omega u, with u after saturation
    sigma_hat: Array  # estimate of y_dot - Omega u
    sigma_f: Array  # sigma_hat - sigma_r after the low-pass filter


def _control_law(*, feedforward: bool) -> ControlLaw:
    """Return the L1 law with piecewise-constant adaptation.

        y_hat     = y_p + dt Omega u_p
        sigma_hat = -Phi^-1 exp(-a dt) (y_hat - y),  Phi = (1 - exp(-a dt)) / a
        sigma_f  += (1 - exp(-bandwidth dt)) (sigma_hat - sigma_r - sigma_f)
        u         = u_r - Omega^-1 (K e + sigma_f),  sigma_r = y_m_dot - Omega u_r

    y_p and u_p belong to the previous tick, and a is ADAPTATION_POLE. y_hat is a step of the
    predictor y_hat_dot = -a (y_hat - y) + Omega u + sigma_hat. Within a tick, y_hat - y decays at
    the rate a, and sigma_hat cancels what is left of y_hat - y. The reference input is u_r = u_trim
    + Omega^-1 y_m_dot. With `feedforward`, u_r = u_trim, which then contains the feedforward. If
    y_dot - Omega u were sigma_r, u_r alone would give y_dot = y_m_dot, so only the rest of
    sigma_hat is fed back. At engagement sigma_f = -K e and u = u_r (bumpless transfer). If y_m_dot
    = 0, retuning also keeps u. As anti-windup, the predictor takes u after saturation. Source: N.
    Hovakimyan, C. Cao, "L1 Adaptive Control Theory", SIAM 2010, section 3.3.
    """

    def engage(measurements: Measurements, params: L1Params) -> L1State:
        e = measurements.y - measurements.y_m
        zero = array_namespace(e).zeros_like(e)
        return L1State(
            e=e,
            y_before=measurements.y,
            y_dot_u=params.Omega @ measurements.u_before + zero,
            sigma_hat=zero,
            sigma_f=-params.K * e,
        )

    def limited(
        state: L1State, measurements: Measurements, dt: Array, params: L1Params, limits: Limits
    ) -> tuple[L1State, Array, Array]:
        xp = array_namespace(measurements.y)
        e = measurements.y - measurements.y_m
        error = state.y_before + dt * state.y_dot_u - measurements.y
        a = ADAPTATION_POLE + xp.zeros_like(params.K)
        sigma_hat = -a * xp.exp(-a * dt) / filter_gain(a, dt) * error
        if feedforward:
            u_r = measurements.u_trim
        else:
            u_r = measurements.u_trim + params.inverse @ measurements.y_m_dot
        sigma_r = measurements.y_m_dot - params.Omega @ u_r
        sigma_f = state.sigma_f + filter_gain(params.bandwidth, dt) * (
            sigma_hat - sigma_r - state.sigma_f
        )
        u_free = u_r - params.inverse @ (params.K * e + sigma_f)
        u, _ = saturate_with_excess(u_free, measurements, dt, limits)
        return (
            L1State(
                e=e,
                y_before=measurements.y,
                y_dot_u=params.Omega @ u,
                sigma_hat=sigma_hat,
                sigma_f=sigma_f,
            ),
            u_free,
            u,
        )

    def retune(state: L1State, old: L1Params, new: L1Params) -> L1State:
        nu = old.inverse @ (old.K * state.e + state.sigma_f)
        y_dot_u = new.Omega @ (old.inverse @ state.y_dot_u)
        return state._replace(y_dot_u=y_dot_u, sigma_f=new.Omega @ nu - new.K * state.e)

    return ControlLaw(
        state=L1State, engage=engage, step=without_limits(limited), limited=limited, retune=retune
    )


CONTROL_LAWS = {feedforward: _control_law(feedforward=feedforward) for feedforward in (False, True)}
"""The L1 law without and with a feedforward in u_trim."""


def params_of(gains: dict[str, FloatArray], model: NominalModel) -> L1Params:
    """Return the parameters for N sets of the gains K and bandwidth, each (m, N)."""
    return L1Params(gains["K"], gains["bandwidth"], model.Omega, model.inverse)


class L1Config(ControllerConfig):
    """The controller under L1 adaptive output control."""

    K: Positives = Field(description="proportional gain, 1/s")
    bandwidth: Positives = Field(
        description="bandwidths of the low-pass filter of the estimate, rad/s"
    )
    Omega: Numbers = Field(description="nominal Omega = C B, one row per output")

    def check_law(self) -> None:
        """Check that there is a value for each channel, and that Omega has the controller's D."""
        for key in ("K", "bandwidth"):
            require_length(key, getattr(self, key), self.outputs)
        m = len(self.outputs)
        require(
            len(self.Omega) == m * m,
            "Omega",
            f"{len(self.Omega)} values",
            f"{m * m}: {m} rows of {m}",
        )
        try:
            D = [int(sign) for sign in signs(np.reshape(self.Omega, (m, m)))]
        except DecompositionError as error:
            raise ParameterError(
                f"Omega: found a matrix without a D ({error}), expected D = {list(self.D)}"
            ) from None
        require(
            list(self.D) == D,
            "Omega",
            f"a matrix with D = {D}",
            f"D = {list(self.D)}, the controller's D",
        )

    def control_law(self) -> ControlLaw:
        """Return the L1 law, in the form for a feedforward if there is one."""
        return CONTROL_LAWS[self.feedforward is not None]

    def law_params(self) -> Any:
        """Return the arrays of the law."""
        m = len(self.outputs)
        Omega = np.reshape(self.Omega, (m, m))
        return L1Params(np.array(self.K), np.array(self.bandwidth), Omega, np.linalg.inv(Omega))

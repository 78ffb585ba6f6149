# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement linear-quadratic Gaussian control (LQG).

The observer corrects the trim, and there is no other feedback.
"""

from typing import NamedTuple

from control_laws.nominal_model import NominalModel
from flight_core.parameters import require
from flight_core.vectors import Array, FloatArray
from rise_di_controller.law.control_law import ControlLaw, Measurements, without_limits
from rise_di_controller.law.saturation import Limits, saturate
from rise_di_controller.params import ControllerConfig


class LqgParams(NamedTuple):
    """Parameters of LQG, which are empty because all parameters belong to the observer."""


class LqgState(NamedTuple):
    """State of LQG, which is empty because the whole state belongs to the observer."""


def _limited(
    state: LqgState, measurements: Measurements, dt: Array, params: LqgParams, limits: Limits
) -> tuple[LqgState, Array, Array]:
    """Limit u_trim, shape (m,), and return both u_trim and the limited u_trim.

    The law adds nothing to u_trim, which already contains u_o of the observer.
    """
    u = saturate(measurements.u_trim, measurements.u_before, dt, limits)
    return state, measurements.u_trim, u


CONTROL_LAW = ControlLaw(
    state=LqgState,
    engage=lambda measured, params: LqgState(),
    step=without_limits(_limited),
    limited=_limited,
    retune=lambda state, old, new: state,
)


def params_of(gains: dict[str, FloatArray], model: NominalModel) -> LqgParams:
    """Return the empty parameters, because all gains belong to the observer."""
    return LqgParams()


class LqgConfig(ControllerConfig):
    """The controller under LQG."""

    def check_law(self) -> None:
        """Check that there is an observer, because it is the whole feedback."""
        require(
            self.observer is not None,
            "observer",
            "none",
            "a section: the observer is the feedback of lqg",
        )

    def control_law(self) -> ControlLaw:
        """Return the law u = u_trim, which the observer extends."""
        return CONTROL_LAW

    def law_params(self) -> LqgParams:
        """Return the empty parameters of the law."""
        return LqgParams()

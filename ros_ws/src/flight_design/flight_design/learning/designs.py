# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a design takes from the learner: delay margin, deviations, an input without effect."""

from collections.abc import Mapping

from aircraft_sim.airframe import Airframe
from flight_analysis.closed_loop.learning_loop import Entry
from flight_analysis.closed_loop.loop_margins import linear_loop
from flight_core.vectors import FloatArray
from flight_design.identification.likelihood import PRIOR
from flight_design.identification.model_identification import with_entries
from rise_di_controller.linear_loop import is_stable
from rise_di_controller.rise_di_config import RiseDiConfig

# s, delay margin beyond the latest delay: a loop of 30 ms flew well with u 20 ms late
DELAY_LEFT = 0.01
FAINT = 1e-3  # 1, of an effect: none, with its sign, which the search keeps


def margin_of(controller: RiseDiConfig) -> float:
    """The delay margin that a controller loads with, s."""
    assert controller.observer is not None  # noqa: S101 - a controller that learns has one
    return controller.observer.margin


def with_margin(controller: RiseDiConfig, margin: float) -> RiseDiConfig:
    """A controller that loads with another delay margin, s."""
    assert controller.observer is not None  # noqa: S101 - a controller that learns has one
    return controller.model_copy(
        update={"observer": controller.observer.model_copy(update={"margin": margin})}
    )


def margin_behind(delay: float, start: RiseDiConfig) -> float:
    """The delay margin of an input that is late by a delay, s: that of the start, or more.

    Beyond the delay at least DELAY_LEFT is left, or what the start leaves beyond its own delay.
    """
    reserve = min(max(margin_of(start) - start.delay, 0.0), DELAY_LEFT)
    # 0.1 ms, as few digits as the file of a scenario
    return max(margin_of(start), round(delay + reserve, 4))


def tolerates(controller: RiseDiConfig, model: Airframe, late: FloatArray) -> bool:
    """Whether the linear loop of a controller around a model is stable with u late, s, (m,)."""
    linear = linear_loop(controller, model, model.matrix_a()[None], model.matrix_b()[None])
    return is_stable(linear.nominal, linear.law, linear.loop._replace(delay=0.0), late)


def with_deviations(designed: RiseDiConfig, deviation: Mapping[str, float]) -> RiseDiConfig:
    """A controller whose model of the feedforward has the standard deviations of B, given by entry
    and relative to it, PRIOR for an entry that no flight has shown.
    """
    model = designed.feedforward
    assert model is not None  # noqa: S101 - a design has one
    names = [f"B[{state}, {name}]" for state in model.states for name in designed.inputs]
    values = tuple(
        abs(value) * deviation.get(name, PRIOR) for name, value in zip(names, model.B, strict=True)
    )
    return designed.model_copy(
        update={"feedforward": model.model_copy(update={"deviation": values})}
    )


def without_effect(model: Airframe, name: str) -> Airframe:
    """A model with almost no effect of an input."""
    column = model.matrix_b()[:, list(model.inputs).index(name)].tolist()
    effects = zip(model.states, column, strict=True)
    return with_entries(
        model,
        [Entry("B", row, name, value, FAINT - 1.0, 0.0, value) for row, value in effects if value],
    )

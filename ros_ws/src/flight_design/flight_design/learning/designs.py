# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Derive what a design must meet from learned models: margins, and the uncertainty of B."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.uncertainty import Spread
from flight_analysis.closed_loop.learning_loop import ModelGuarantee
from flight_analysis.linear_loop.delay_margin import delay_margin
from flight_analysis.linear_loop.guarantee import Guarantee, quick_guarantee
from flight_analysis.linear_loop.input_margins import input_margins
from flight_analysis.linear_loop.loop_margins import LinearLoop, linear_loop, with_box
from flight_core.vectors import FloatArray
from flight_design.gains.observer_search import RESOLUTION, SelectedObserver
from flight_design.gains.requirement import OBSERVER_REQUIREMENT, Requirement
from flight_design.identification.likelihood import PRIOR
from rise_di_controller.learning.learned_channels import with_channels_of
from rise_di_controller.rise_di_config import DEFAULT_MARGIN, RiseDiConfig

# s, delay margin that is kept beyond the latest delay. A loop with 30 ms flew well while u was 20
# ms late.
DELAY_LEFT = 0.01
# Weight of the activity of u in the cost of a design for a learned model. A design for the
# rough model of the airframe file has 1. If learned models had 1 too, their loops would have 5 ms
# more delay margin than the loop for the airframe file, and 2 % more error. A weight of 0 was no
# better than 0.5.
ACTIVITY = 0.5
SPEED = "V"  # the output whose observer needs the observers of the other outputs
# Half-width of the box of a learned model, which holds the intervals of the entries of uncertain
# aircraft, in standard deviations of the identification.
DEVIATIONS = 2.0
# How far a guarantee is sought, in the same unit.
MOST_DEVIATIONS = 4.0
ROUNDED = 1.001  # factor on the required margins of a loop, so that it has them despite rounding


class Goal(NamedTuple):
    """Margins and further conditions that the design for a learned model must meet."""

    margin: FloatArray  # (m,) delay margin of each input, s
    needed: Requirement
    # the design for the airframe file, from which the search begins
    first: SelectedObserver | None = None
    is_free: Sequence[bool] | None = None  # (m,) channels whose gains may change; if None, all may


Design = Callable[[RiseDiConfig, Airframe, Goal], SelectedObserver]
"""Designs the feedforward and the observer for a model. Raises ParameterError if no design meets
the goal."""

DesignOfFile = Callable[[RiseDiConfig], SelectedObserver]
"""Designs the feedforward and the observer for the rough model, and allows for its errors. Raises
ParameterError if no design has the required margins."""


class Known(NamedTuple):
    """Properties of one part of a learned model: delays of its inputs, and standard deviations."""

    deviation: Mapping[str, float]  # relative deviation of each entry, by name
    latest: Mapping[str, float]  # delay of each input plus two standard deviations, s
    delays: tuple[float, ...]  # delay of each input, s


class LearnedLoop(NamedTuple):
    """The loop of proposed parameters around a learned model."""

    controller: RiseDiConfig
    model: Airframe
    known: tuple[Known, ...]
    unlearned: float  # relative deviation of an entry that was not learned

    def linear(self) -> LinearLoop:
        """Return the linear loop around the model, with a box of uncertain aircraft.

        In the box, each entry deviates by up to DEVIATIONS standard deviations. The loop is linear,
        without the limits of u. Every u is late by the longest delay in `known`, or by the delay in
        the controller's parameters if this is longer.
        """
        model = self.model
        deviation = chain.from_iterable(part.deviation.items() for part in self.known)
        entries = {name.replace(", ", ","): DEVIATIONS * value for name, value in deviation}
        linear = linear_loop(self.controller, model, model.matrix_a()[None], model.matrix_b()[None])
        delay = max([linear.loop.delay, *chain.from_iterable(part.delays for part in self.known)])
        linear = linear._replace(loop=linear.loop._replace(delay=delay))
        spread = Spread(entries)
        return with_box(linear, model, self.controller, DEVIATIONS * self.unlearned, 0, spread)

    def proof(self) -> tuple[LinearLoop, Guarantee]:
        """Return the linear loop, and a proof of how far an aircraft may deviate and stay stable.

        The proof goes up to MOST_DEVIATIONS standard deviations of each entry.
        """
        linear = self.linear()
        return linear, quick_guarantee(linear, MOST_DEVIATIONS / DEVIATIONS)

    def guarantee(self) -> ModelGuarantee:
        """Compute within how many standard deviations of the model every aircraft is stable."""
        _, proved = self.proof()
        return ModelGuarantee(deviations_covered(proved), proved.loop)


def deviations_covered(proved: Guarantee) -> float:
    """Return how many standard deviations of each entry the proof of a model covers."""
    return DEVIATIONS * proved.stable / proved.uncertainty


def margin_of(controller: RiseDiConfig) -> float:
    """Return the delay margin, s, that a controller checks when it loads its parameters."""
    assert controller.observer is not None  # noqa: S101 - a controller that learns has one
    return controller.observer.margin


def asked_margin(start: RiseDiConfig) -> float:
    """Return the delay margin that a learned design should keep, s.

    This is `learn.margin`. If it is not set, it is the delay margin of the controller with which
    the flight started.
    """
    asked = None if start.learn is None else start.learn.margin
    return margin_of(start) if asked is None else asked


def is_late(start: RiseDiConfig, latest: Mapping[str, float]) -> bool:
    """Return whether an input needs a larger delay margin than `asked_margin`.

    `latest` has the latest delay of each input, s, by name. The margin that an input needs is its
    latest delay plus DELAY_LEFT.
    """
    return max(latest.values(), default=0.0) + DELAY_LEFT > asked_margin(start)


def price(selected: SelectedObserver, margin: float, other: SelectedObserver, kept: float) -> str:
    """Say what a larger delay margin costs in tracking error.

    `selected` is the design with the delay margin `margin`, s, and `other` is a design that keeps
    only the margin `kept`, s.
    """
    ratio = math.exp((selected.cost - other.cost) / len(selected.relaxation))
    return (
        f"{ratio:.2f} times the error of a design with {1e3 * kept:.0f} ms of delay margin, "
        f"because {1e3 * margin:.0f} ms are asked for"
    )


def goal(
    start: RiseDiConfig,
    design_of_file: SelectedObserver | None,
    model: Airframe,
    parts: Collection[tuple[str, ...]],
    latest: Mapping[str, float],
    dead: Collection[str] = (),
) -> Goal:
    """Return the goal of a design for a model that has some learned parts.

    A part is a group of states and inputs that does not couple with the rest. `parts` has the
    outputs of each part. Each part needs a delay margin:

    - If `learn.margin` is set, it is this margin.
    - If there is no `learn.margin` and no design for the airframe file, it is the margin of the
      controller with which the flight started.
    - If there is no `learn.margin` but a `design_of_file`, it is about the margin that the loop
      with this design has around the learned model, but at most the margin at the start of the
      flight. A learned part needs at least DEFAULT_MARGIN, or the margin at the start if this is
      smaller.

    A `dead` output does not use this design, so it needs no margin. In any case an input must
    tolerate DELAY_LEFT, s, beyond its `latest` delay, s. The sensitivity must be at most 2. This
    bounds the phase and gain margins (Astrom, Murray, "Feedback Systems", 10.5). If the loop with
    the `design_of_file` is stable around the model but falls short of the required sensitivity,
    phase, gain or damping, only what it reaches is required.
    """
    outputs = start.outputs
    margin = np.full(len(outputs), margin_of(start))
    needed = OBSERVER_REQUIREMENT
    is_free = None
    if design_of_file is not None:
        linear = linear_loop(
            design_of_file.controller, model, model.matrix_a()[None], model.matrix_b()[None]
        )
        undelayed = linear.loop._replace(delay=0.0)
        learned = {output for part in parts for output in part}
        is_free = [output in learned for output in outputs]
        others = tuple(output for output in outputs if output not in {*learned, *dead})
        for part in (*parts, others):
            share = np.array([float(output in part) for output in outputs])
            if not part:
                continue
            kept = delay_margin(linear.nominal, linear.law, undelayed, share)
            kept = min(kept, margin_of(start)) - RESOLUTION
            if part in parts:
                kept = max(kept, min(DEFAULT_MARGIN, margin_of(start)))
            else:
                # The gains of this part stay. Its margin cannot grow, so a little less is required.
                kept -= RESOLUTION
            margin = np.where(share > 0.0, max(kept, 0.0), margin)
        margins = input_margins(linear.nominal, linear.law, linear.loop, together=False)
        if margins.stable:
            most = max(needed.sensitivity, ROUNDED * float(margins.sensitivity.max()))
            needed = needed._replace(
                sensitivity=most,
                phase=min(needed.phase, 2.0 * math.asin(0.5 / most)),
                gain=min(needed.gain, most / (most - 1.0)),
                damping=min(needed.damping, float(margins.damping) / ROUNDED),
            )
    asked = None if start.learn is None else start.learn.margin
    if asked is not None:
        margin = np.full(len(outputs), asked)
    margin = np.where([output in dead for output in outputs], 0.0, margin)
    # 0.1 ms is the resolution of delays in the file of a scenario
    late = [round(latest[name] + DELAY_LEFT, 4) if name in latest else 0.0 for name in start.inputs]
    return Goal(np.maximum(margin, late), needed, design_of_file, is_free)


def by_law_of_start(
    start: RiseDiConfig, left: Mapping[tuple[str, ...], str | None], *, has_file: bool
) -> set[str]:
    """Return the outputs that are controlled by the law with which the flight started.

    `left` has the parts of the aircraft that are left to this law, each with its dead input. A part
    is a group of states and inputs that does not couple with the rest.

    - If the dead input is None, the controller no longer uses a model of the part. The law then
      controls all outputs of the part.
    - If a part has a dead input and no design for the airframe file is in use, the law controls all
      outputs of the part.
    - If a part has a dead input and the design for the file is in use (`has_file`), the law only
      controls the output of the dead input, and V if it is in the part.

    In flights without an elevator, the error of V with the observer was four times the error under
    the law. The other outputs keep the design, because their inputs work. In flights without a
    rudder, the error of p with the design was half of the error under the law.
    """
    driven = dict(zip(start.inputs, start.outputs, strict=True))
    return {
        output
        for part, dead in left.items()
        for output in part
        if dead is None or not has_file or output in {driven.get(dead), SPEED}
    }


def with_flown_channels(
    start: RiseDiConfig,
    designed: RiseDiConfig,
    model: Airframe,
    flying: Collection[str],
    left: Mapping[tuple[str, ...], str | None],
) -> RiseDiConfig:
    """Combine a design for the outputs `flying` with the initial law of the flight for all others.

    `left` has the parts of the aircraft that are left to this law, as in `by_law_of_start`. The law
    does not move their dead inputs. If any part is left and there is an observer, the margin in the
    controller is set by `with_own_margin`.
    """
    bare = [output not in flying for output in start.outputs]
    mixed = with_channels_of(
        start, designed, bare, [name in left.values() for name in start.inputs]
    )
    has_other_margin = bool(left) and mixed.observer is not None
    return with_own_margin(mixed, model, margin_of(start)) if has_other_margin else mixed


def with_own_margin(controller: RiseDiConfig, model: Airframe, most: float) -> RiseDiConfig:
    """Set `observer.margin` to the delay margin of the loop around a model, at most `most`."""
    linear = linear_loop(controller, model, model.matrix_a()[None], model.matrix_b()[None])
    undelayed = linear.loop._replace(delay=0.0)
    kept = delay_margin(linear.nominal, linear.law, undelayed) - RESOLUTION
    assert controller.observer is not None  # noqa: S101 - a design has one
    observer = controller.observer.model_copy(update={"margin": min(max(kept, 0.0), most)})
    return controller.model_copy(update={"observer": observer})


def with_deviations(designed: RiseDiConfig, deviation: Mapping[str, float]) -> RiseDiConfig:
    """Put the standard deviations of B into the model of a controller's feedforward.

    `deviation` has the relative standard deviation of each entry, by the entry's name. An entry
    that is not in `deviation` gets PRIOR.
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

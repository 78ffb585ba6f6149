# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the margins of a scenario's linear loop, for the nominal and uncertain aircraft."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim import random_streams
from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import (
    UNIFORM,
    Spread,
    deviations,
    drawn_places,
    nominal_and_sampled,
    row_sizes,
)
from flight_analysis.closed_loop.scenario import Scenario, as_scenario
from flight_analysis.linear_loop.delay_margin import MAX_DELAY_MARGIN, delay_margin
from flight_analysis.linear_loop.input_margins import Margins, SlowModes, input_margins, slow_modes
from flight_analysis.linear_loop.told import PLANNED, Comparison, Difference, FlightFacts, compare
from flight_analysis.linear_loop.told import loop_of as loop_of  # noqa: PLC0414 - other modules import it from here
from flight_analysis.linear_loop.uncertain_loop import Box, plants_at
from flight_analysis.linear_loop.worst_case import worst_in_box
from flight_core.arguments import as_count, as_number
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from rise_di_controller.law.law import Sign
from rise_di_controller.law.linear_loop import (
    SPECTRAL_RADIUS_TOLERANCE,
    LinearLaw,
    LinearPlant,
    LoopTiming,
    closed_loop,
    is_stable,
    linear_law,
)
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

LAG_ENTRY = "1/lag"  # beginning of the name of an uncertain entry that is the lag of an actuator
LEAST_LAG = 2.0  # least lag of an actuator that can be uncertain, periods
MOST_OF_LAG = 0.8
"""The largest deviation d of 1 / lag for which a proof holds. With a lag of LEAST_LAG, the two
Legendre coefficients of a period leave out less than a thousandth of the deviation. This is a fifth
of the reserve in each region of a proof. For a larger d they leave out more."""

BARE = (
    "; each output integrates its inputs, without drag and phugoid: the margins cover Omega alone"
)


ROUNDING = 1e-9  # relative deviation of an entry that is taken as 0
# significant digits of the numbers in a digest: two ways to the same loop differ only by rounding
DIGITS = 10


class LinearLoop(NamedTuple):
    """The loop of a controller around a model of its aircraft.

    Its channels are in the order of the control law.
    """

    model: str  # a few words on what the plant models
    states: tuple[str, ...]  # states of the aircraft; `plant_states` has all states of `plant`
    outputs: tuple[str, ...]  # outputs that the law reads, with the vanes last
    inputs: tuple[str, ...]
    plant: LinearPlant  # N aircraft, with the nominal one first: A (N, n, n), B (N, n, m)
    law: LinearLaw
    loop: LoopTiming
    box: Box | None = None  # box of the uncertain aircraft, or None if there are none
    # how the aircraft that flies differs from what the controller was told
    differences: tuple[Difference, ...] = ()
    # How far A and B of the aircraft that flies are from the airframe file. The deviation of each
    # entry is divided by its deviation in the box. The largest ratio, times the largest deviation
    # in the box, can be compared with `Guarantee.stable`.
    off: float = 0.0

    @property
    def nominal(self) -> LinearPlant:
        """Nominal aircraft."""
        return LinearPlant(self.plant.A[0], self.plant.B[0], self.plant.C)

    @property
    def plant_states(self) -> tuple[str, ...]:
        """States of the aircraft, and a state u[INPUT] for each actuator whose lag deviates."""
        entries = () if self.box is None else self.box.names
        lags = [name for name in entries if name.startswith(LAG_ENTRY)]
        return (*self.states, *(f"u{name.removeprefix(LAG_ENTRY)}" for name in lags))

    @property
    def digest(self) -> str:
        """SHA-256 of the loop and its box: of their names, and of their numbers to DIGITS digits.

        The box is scaled to the size 1 first, because the size is a result of a guarantee.
        """
        loop = self.loop
        arrays = [*self.nominal, *self.law, loop.lag, loop.delay, loop.period]
        names = [self.plant_states, self.outputs, self.inputs]
        if self.box is not None:
            size = self.box.part.max()
            arrays += [self.box.part / size, self.box.E, self.box.F / size, self.box.G / size]
            names += [self.box.effectors, self.box.names]
        values = np.concatenate([np.ravel(np.asarray(array)) for array in arrays]) + 0.0  # no -0
        numbers = (f"{value:.{DIGITS - 1}e}" for value in values.tolist())
        text = " ".join([json.dumps(names), *numbers])
        return hashlib.sha256(text.encode()).hexdigest()


class LoopMargins(NamedTuple):
    """Margins of a loop, with the channels in the order of the control law."""

    inputs: tuple[str, ...]
    nominal: Margins
    modes: SlowModes  # slow modes of the nominal aircraft
    delay: float  # delay margin of the nominal aircraft if u is late in all inputs, s
    channel_delay: tuple[float, ...]  # delay margin if u is late in this input only, s
    # least value of each margin among the uncertain aircraft; None if there are none
    worst: Margins | None = None
    worst_delay: float | None = None  # least delay margin of the uncertain aircraft, s
    aircraft: int = 0  # number of uncertain aircraft that were drawn
    stable: int = 0  # number of stable ones among them
    is_searched: bool = False  # whether `worst` comes from a search over the box, not from samples


def margins(
    scenario: Scenario,
    aircraft: int = 0,
    uncertainty: float = 0.3,
    seed: int = 1,
    spread: Spread = UNIFORM,
) -> LoopMargins:
    """Compute the margins of a scenario's loop, and the least margins among uncertain aircraft.

    In an uncertain aircraft, every entry of A and B deviates by up to `uncertainty`, or by the
    deviation that `spread` has for this entry. Entries in the rows of theta, phi and psi do not
    deviate. A lag deviates only if `spread` has an entry 1/lag[INPUT]. The uncertainty in the
    scenario itself is ignored.

    The least margins lie at corners of the box of these deviations, where no drawn sample falls. A
    search therefore finds them, and the drawn samples only serve to count the stable aircraft. Lags
    and delay come from the aircraft that flies, even if the controller was designed for others.

    Args:
        scenario: Scenario with the aircraft and the controller.
        aircraft: Number of uncertain aircraft that are drawn. 0 is the nominal aircraft alone.
        uncertainty: Largest relative deviation of each entry of A and B, 0 to 1.
        seed: Seed of the uncertain aircraft.
        spread: Distribution of the deviations, and deviations by entry.

    Returns:
        Margins of the nominal aircraft, and the least margins that were found. Delays are in s.

    Raises:
        ParameterError: The law has the literal sign, the aircraft is one of JSBSim and its
            controller has no model of it, or `spread` has an unknown entry.

    Examples:
        >>> rise_di.margins(rise_di.find_scenario("osprey_servo")).delay > 0.03
        True
    """
    flight = as_scenario(scenario)
    count = as_count(aircraft, "aircraft", 0)
    numbered = as_count(seed, "seed", 0)
    deviation = as_number(uncertainty, "uncertainty", 0.0, 1.0)
    return loop_margins(
        scenario_loop(flight, flight.controller, count, deviation, numbered, spread)
    )


def loop_margins(linear: LinearLoop) -> LoopMargins:
    """Compute the margins of the nominal aircraft, and the worst margins of the uncertain ones."""
    if linear.box is not None and len(linear.plant.A) > 1:
        return _assessed_by_search(linear, linear.box)
    together = input_margins(linear.plant, linear.law, linear.loop)
    nominal = together.at(0)
    uncertain = together.at(slice(1, None))
    delay = delay_margin(linear.nominal, linear.law, linear.loop)
    each = tuple(
        delay_margin(linear.nominal, linear.law, linear.loop, share)
        for share in np.eye(len(linear.inputs))
    )
    result = LoopMargins(
        inputs=linear.inputs,
        nominal=nominal,
        modes=slow_modes(linear.nominal, linear.law, linear.loop),
        delay=delay,
        channel_delay=each,
    )
    count = len(linear.plant.A) - 1
    if not count:
        return result
    stable = int(uncertain.stable.sum())
    return result._replace(
        worst=uncertain.worst(),
        worst_delay=_least_delay(linear._replace(plant=_some(linear.plant, slice(1, None))), delay),
        aircraft=count,
        stable=stable,
    )


def _assessed_by_search(linear: LinearLoop, box: Box) -> LoopMargins:
    """Search the box for the worst margins, and count the stable ones of the drawn aircraft."""
    nominal = loop_margins(linear._replace(plant=_some(linear.plant, slice(1)), box=None))
    samples = closed_loop(
        _some(linear.plant, slice(1, None)), linear.law, linear.loop, np.zeros(len(linear.inputs))
    )
    radii = np.abs(np.linalg.eigvals(samples)).max(axis=-1)
    search = worst_in_box(linear.nominal, linear.law, linear.loop, box)
    aircraft = plants_at(_some(linear.plant, slice(1)), box, search.corners)
    return nominal._replace(
        worst=search.worst,
        worst_delay=_least_delay(linear._replace(plant=aircraft), nominal.delay),
        aircraft=len(radii),
        stable=int((radii <= 1.0 + SPECTRAL_RADIUS_TOLERANCE).sum()),
        is_searched=True,
    )


def _least_delay(linear: LinearLoop, nominal: float) -> float:
    """Find the smallest delay margin among the N aircraft of a loop, s.

    The result is at most `nominal`, the nominal margin. All aircraft are tried together. The delay
    rises in steps of half a period, or of 1/12 of the nominal margin if this is longer.
    """
    longest = min(nominal, MAX_DELAY_MARGIN)
    uncertain = linear.plant
    for delay in np.append(
        np.arange(0.0, longest, max(linear.loop.period / 2.0, longest / 12.0)), longest
    ):
        matrices = closed_loop(
            uncertain, linear.law, linear.loop, np.full(len(linear.inputs), delay)
        )
        radii = np.abs(np.linalg.eigvals(matrices)).max(axis=-1)
        unstable = np.flatnonzero(radii > 1.0 + SPECTRAL_RADIUS_TOLERANCE)
        if len(unstable):
            least = longest
            for k in unstable[np.argsort(-radii[unstable])]:
                plant = LinearPlant(uncertain.A[k], uncertain.B[k], uncertain.C)
                if not is_stable(
                    plant, linear.law, linear.loop, np.full(len(linear.inputs), least)
                ):
                    least = min(least, delay_margin(plant, linear.law, linear.loop))
            return least
    return nominal


def scenario_loop(
    scenario: Scenario,
    controller: ControllerConfig,
    aircraft: int = 0,
    uncertainty: float = 0.3,
    seed: int = 1,
    spread: Spread = UNIFORM,
    flight: FlightFacts = PLANNED,
) -> LinearLoop:
    """Build the loop of a controller around the nominal and uncertain aircraft of a scenario.

    Lags and delay of the aircraft that flies are used. They come from the scenario or from
    `flight`. Raises ParameterError as `margins` does.
    """
    airframe = scenario_model(scenario, controller)
    comparison = compare(scenario, controller, flight)
    matrices, _ = of_matrices_and_lags(spread, comparison.timing, controller.inputs)
    A, B = nominal_and_sampled(airframe, uncertainty, aircraft, seed, matrices)
    T = distribution(airframe, controller)  # B of each effector is drawn
    airframe_of_law = through_allocation(airframe, controller)
    linear = linear_loop(controller, airframe_of_law, A, B @ T, comparison.timing)
    linear = with_box(linear, airframe, controller, uncertainty, seed, spread)
    if flight.is_simulated:
        return as_compared(linear, scenario, comparison)
    return linear._replace(differences=comparison.differences)


def as_compared(linear: LinearLoop, scenario: Scenario, comparison: Comparison) -> LinearLoop:
    """Return the loop with the differences of a comparison, and with `off` by `_with_deviation`."""
    return _with_deviation(linear._replace(differences=comparison.differences), scenario)


def _with_deviation(linear: LinearLoop, scenario: Scenario) -> LinearLoop:
    """Return the loop with `off`: how far the scenario's aircraft is from its airframe file.

    `off` is 0 if the aircraft flies as the file says. It is infinite if the scenario changes an
    entry that is exact in the box.
    """
    if linear.box is None or scenario.aircraft.is_jsbsim:
        return linear
    frames = scenario.aircraft.nominal_airframe(), scenario.aircraft.sampled_airframe()
    (A, B), (A_flown, B_flown) = ((each.matrix_a(), each.matrix_b()) for each in frames)
    published = {"A": A, "B": B}
    flown = {"A": A_flown, "B": B_flown}
    parts = dict(zip(linear.box.names, linear.box.part.tolist(), strict=True))
    off = 0.0
    for name, (matrix, i, j) in drawn_places(frames[0]).items():
        deviation = abs(flown[matrix][i, j] / published[matrix][i, j] - 1.0)
        if deviation > ROUNDING:
            part = parts.get(name, 0.0)
            off = max(off, deviation / part if part else np.inf)
    return linear._replace(off=float(off * linear.box.largest))


def linear_loop(
    controller: ControllerConfig,
    airframe: Airframe,
    A: FloatArray,
    B: FloatArray,
    timing: LoopTiming | None = None,
) -> LinearLoop:
    """Build the loop of a controller around N aircraft, A (N, n, n) and B (N, n, m).

    The airframe gives the states and channels. If `timing` is None, the loop has the timing in the
    controller's parameters. Raises ParameterError for the literal sign.
    """
    rows, columns = law_order(airframe, controller)
    loop = loop_of(controller) if timing is None else timing
    # The model y_dot = Omega u has no angles, so the observer without vanes is used.
    if not set(controller.vanes) <= set(airframe.states):
        controller = controller.without_vanes()
    states = np.array(list(airframe.states))
    vane_rows = [(states == name).astype(np.float64) for name in controller.vanes]
    C = np.vstack([airframe.matrix_c()[rows], *vane_rows])
    plant = LinearPlant(A + airframe.matrix_gravity(), B[:, :, columns], C)
    model = f"model: {airframe.name}{'' if A.any() else BARE}"
    return LinearLoop(
        model=model,
        states=tuple(airframe.states),
        outputs=(*controller.outputs, *controller.vanes),
        inputs=controller.inputs,
        plant=plant,
        law=linear_law(controller.tuned_law(), len(rows), loop.period),
        loop=loop,
    )


def with_box(
    linear: LinearLoop,
    airframe: Airframe,
    controller: ControllerConfig,
    uncertainty: float,
    seed: int,
    spread: Spread,
) -> LinearLoop:
    """Return the loop with a box: intervals of entries that contain every aircraft of the loop.

    The box is None if nothing deviates. If a lag deviates, its actuator becomes a state of the
    plant, and the lag becomes 0 in the timing of the loop:

        x_dot = A x + B u_a,  u_a_dot = (1 + d) / lag (u - u_a),  states x and u_a

    Raises ParameterError as `of_matrices_and_lags` does.
    """
    box = box_of(airframe, controller, uncertainty, spread)
    _, parts = of_matrices_and_lags(spread, linear.loop, controller.inputs)
    if parts:
        linear, box = with_lags_pulled_out(linear, box, parts, seed, spread)
    return linear._replace(box=box) if box.part.any() else linear


def of_matrices_and_lags(
    spread: Spread, timing: LoopTiming, inputs: Sequence[str]
) -> tuple[Spread, dict[int, float]]:
    """Separate the entries of A and B in `spread` from the entries of lags, named 1/lag[INPUT].

    The second result has the relative deviation of 1 / lag by the index of the law's input. Raises
    ParameterError for an unknown entry, a lag below LEAST_LAG periods, or a deviation not in [0,
    1).
    """
    least = LEAST_LAG * timing.period
    known = {
        f"{LAG_ENTRY}[{name}]": i
        for i, name in enumerate(inputs)
        if timing.lag[i] >= least * (1.0 - 1e-9)
    }
    matrices = {}
    lags = {}
    for name, part in spread.entries.items():
        if name.startswith(("A[", "B[")):
            matrices[name] = part
            continue
        expected = (
            f"a lag of {least:g} s or more: {', '.join(known) or 'none'}; or an entry of A or B, "
            "as A[q,q]"
        )
        require(name in known, "entry", name, expected)
        require(0.0 <= part < 1.0, name, part, "a part of 1 / lag, 0 <= part < 1")
        lags[known[name]] = part
    return spread._replace(entries=matrices), lags


def with_lags_pulled_out(
    linear: LinearLoop, box: Box, parts: Mapping[int, float], seed: int, spread: Spread
) -> tuple[LinearLoop, Box]:
    """Return the loop and its box with the actuators of some inputs as states of the plant.

    `parts` has the largest relative deviation of 1 / lag, by the index of such an input. The lags
    of the drawn aircraft follow from `seed` and from the distribution of `spread`.
    """
    places = [*parts]
    count, n, m = linear.plant.B.shape
    size = len(places)
    rate = 1.0 / linear.loop.lag[places]
    part = np.array([*parts.values()])
    uniform = random_streams.uniform(0, count - 1, m, random_streams.EQUIPMENT, seed)[:, places]
    d = np.vstack([np.zeros(size), deviations(uniform, spread.distribution)])
    # S selects the inputs whose actuators become states u_a, and `others` the other inputs.
    S = np.eye(m)[:, places]
    others = np.eye(m) - S @ S.T
    rates = (rate * (1.0 + part * d))[:, :, None] * np.eye(size)
    none = np.zeros((count, size, n))
    plant = LinearPlant(
        np.block([[linear.plant.A, linear.plant.B @ S], [none, -rates]]),
        np.concatenate([linear.plant.B @ others, rates @ S.T], axis=1),
        np.hstack([linear.plant.C, np.zeros((len(linear.plant.C), size))]),
    )
    changes = np.diag(part * rate)
    E = np.pad(box.E, ((0, size), (0, size)))
    E[n:, len(box.names) :] = np.eye(size)
    wider = box._replace(
        names=(*box.names, *(f"{LAG_ENTRY}[{linear.inputs[i]}]" for i in places)),
        part=np.append(box.part, part),
        E=E,
        F=np.block([[box.F, box.G @ S], [none[0], -changes]]),
        G=np.vstack([box.G @ others, changes @ S.T]),
    )
    loop = linear.loop._replace(lag=others @ linear.loop.lag)
    return linear._replace(plant=plant, loop=loop), wider


def box_of(
    airframe: Airframe,
    controller: ControllerConfig,
    uncertainty: float,
    spread: Spread = UNIFORM,
) -> Box:
    """Return the box (intervals of the entries of A and B) that `nominal_and_sampled` draws from.

    The channels of the box are in the law's order. If there is an allocation, B of every effector
    is uncertain. If `spread.zeros` is above 0, entries that are 0 in the file deviate as well, by
    this fraction of their `row_sizes`.
    """
    airframe_of_law = through_allocation(airframe, controller)
    T = distribution(airframe, controller)[:, law_order(airframe_of_law, controller)[1]]
    published = drawn_places(airframe)
    places = drawn_places(airframe, zeros=spread.zeros > 0.0)
    zeros = tuple(name for name in places if name not in published)
    default = [spread.zeros if name in zeros else uncertainty for name in places]
    part = np.array(
        [spread.entries.get(name, of) for name, of in zip(places, default, strict=True)]
    )
    n = len(airframe.states)
    E = np.zeros((n, len(places)))
    F = np.zeros((len(places), n))
    G = np.zeros((len(places), T.shape[1]))
    sizes = row_sizes(airframe)
    units = {"A": airframe.matrix_a() + sizes["A"], "B": airframe.matrix_b() + sizes["B"]}
    for entry, (matrix, i, j) in enumerate(places.values()):
        E[i, entry] = 1.0
        size = part[entry] * units[matrix][i, j]
        if matrix == "A":
            F[entry, j] = size
        else:
            G[entry] = size * T[j]
    effectors = list(airframe.inputs)
    if not _has_effectors(airframe, controller):
        # here the effectors are the inputs of the law, in its order
        order = [effectors.index(name) for name in controller.inputs]
        effectors, T = list(controller.inputs), T[order]
    names = tuple(places)
    return Box(names=names, part=part, E=E, F=F, G=G, effectors=tuple(effectors), T=T, zeros=zeros)


def _some(plant: LinearPlant, names: slice) -> LinearPlant:
    return LinearPlant(plant.A[names], plant.B[names], plant.C)


def through_allocation(airframe: Airframe, controller: ControllerConfig) -> Airframe:
    """Return the airframe with the inputs v of the control law in place of u = T v.

    If there is no allocation, the airframe stays as it is.
    """
    if not _has_effectors(airframe, controller):
        return airframe
    return airframe.through(distribution(airframe, controller), controller.inputs)


def distribution(airframe: Airframe, controller: ControllerConfig) -> FloatArray:
    """Return the allocation matrix T, (p, m), with its rows in the order of the airframe's inputs.

    T is the identity if no allocation drives these inputs.
    """
    allocation = controller.allocation
    if allocation is None or not _has_effectors(airframe, controller):
        return np.eye(len(airframe.inputs))
    T = np.reshape(allocation.T, (len(allocation.effectors), -1))
    return T[[allocation.effectors.index(name) for name in airframe.inputs]]


def _has_effectors(airframe: Airframe, controller: ControllerConfig) -> bool:
    """Return whether an allocation stands between the law and the inputs of an airframe.

    The model of a JSBSim aircraft already has the inputs of the law, so for it the result is False.
    """
    return controller.allocation is not None and set(airframe.inputs) != set(controller.inputs)


def delay_margins(
    scenario: Scenario, controller: ControllerConfig, flight: FlightFacts = PLANNED
) -> dict[str, Any]:
    """Compute the delay margins of the nominal linear loop, s.

    "delay_margin" is for u late in every channel. "channels" has the margin for u late in a single
    channel, by the name of its output. "least" is the least margin that is allowed. The result is
    empty if there is no linear loop, as for an aircraft of JSBSim or the literal sign. A margin is
    0 if the loop is unstable without further delay.
    """
    if scenario.aircraft.is_jsbsim or is_literal(controller):
        return {}
    loop = scenario_loop(scenario, controller, flight=flight)
    each = {
        name: delay_margin(loop.nominal, loop.law, loop.loop, share)
        for name, share in zip(controller.outputs, np.eye(len(controller.outputs)), strict=True)
    }
    return {
        "delay_margin": delay_margin(loop.nominal, loop.law, loop.loop),
        "channels": each,
        "least": loop.loop.period,
    }


def is_literal(controller: ControllerConfig) -> bool:
    """Return whether a controller samples the literal sign, which has no linear loop."""
    return isinstance(controller, RiseDiConfig) and controller.sampled_sign() is Sign.LITERAL


def law_order(airframe: Airframe, controller: ControllerConfig) -> tuple[list[int], list[int]]:
    """Return the indices of a law's outputs and inputs among an airframe's.

    Raises ParameterError if the airframe lacks any of them.
    """
    for key, known in (("outputs", airframe.outputs), ("inputs", tuple(airframe.inputs))):
        names = getattr(controller, key)
        expected = f"{key} of {airframe.name}: {', '.join(known)}"
        require(set(names) <= set(known), f"controller.{key}", ", ".join(names), expected)
    columns = [list(airframe.inputs).index(name) for name in controller.inputs]
    return [airframe.outputs.index(name) for name in controller.outputs], columns


def scenario_model(scenario: Scenario, controller: ControllerConfig) -> Airframe:
    """Return the airframe of a scenario, or the model y_dot = Omega u for an aircraft of JSBSim.

    The model y_dot = Omega u has the inputs of the law. Its Omega comes from the feedforward of the
    controller. Without a feedforward, Omega is diagonal with abs(Omega_ii) = omega / input_scale of
    RISE-DI, which is an upper bound.
    """
    aircraft = scenario.aircraft
    if not aircraft.is_jsbsim:
        return load_airframe(aircraft.airframe)
    # The controller has A and B of its feedforward, or a bound of Omega.
    if controller.feedforward is not None and set(controller.feedforward.states) == set(
        controller.outputs
    ):
        names = controller.feedforward.states
        A = np.reshape(controller.feedforward.A, (len(names), -1))
        B = np.reshape(controller.feedforward.B, (len(names), -1))
    elif isinstance(controller, RiseDiConfig):
        names = controller.outputs
        A = np.zeros((len(names), len(names)))
        B = np.diag(np.array(controller.D) * controller.omega / controller.input_scale)
    else:
        expected = "a controller with a feedforward, or RISE-DI with its omega"
        raise ParameterError(
            f"{scenario.name}: found no linear model of {aircraft.airframe}, expected {expected}"
        )
    # The airframe has the units and signs of the inputs of the aircraft.
    channels = aircraft.channels()
    inputs = {
        name: {
            "unit": channels.inputs.get(name, "1"),
            "positive": channels.positive.get(name, f"more {name}"),
        }
        for name in controller.inputs
    }
    values = {
        "name": f"y_dot = Omega u for {aircraft.airframe}",
        "source": "the controller",
        "speed": channels.speed,
        "inputs": inputs,
    }
    states = {name: channels.outputs[name] for name in names}
    matrices = {
        "states": states,
        "outputs": list(controller.outputs),
        "A": A.tolist(),
        "B": B.tolist(),
    }
    return Airframe.validate_mapping(values | matrices, f"model of {aircraft.airframe}")

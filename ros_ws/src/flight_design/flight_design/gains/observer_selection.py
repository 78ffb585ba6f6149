# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Select the feedforward and the observer of a controller, together with the gains of the law.

`with_aircraft_observer` uses the model of an airframe, and `with_extended_state_observer` only
Omega and the lags. Both return a controller whose nominal linear loop has a delay margin and meets
a requirement on phase, gain, sensitivity and damping.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.airframes.airspeed import at_speed
from aircraft_sim.atmosphere.disturbance import AIR_STATE, AXES
from aircraft_sim.atmosphere.turbulence import MODERATE, dryden, roll_gust
from aircraft_sim.uncertainty import Spread, nominal_and_sampled
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import (
    Names,
    ObserverDesign,
    ObserverModel,
    Weights,
    aircraft_model,
    aircraft_observer,
    extended_state_observer,
    feedback_gain,
    vane_correction,
)
from flight_analysis.linear_loop.loop_margins import (
    distribution,
    law_order,
    loop_of,
    through_allocation,
)
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from flight_design.gains.airframe_properties import fastest_zero
from flight_design.gains.extended_state import extended_state_weights, integrator_model
from flight_design.gains.feedforward_model import with_feedforward
from flight_design.gains.linear_error import Air, discrete_gust
from flight_design.gains.nominal import activity_units, airframe_model
from flight_design.gains.observer_gains import ObserverGains
from flight_design.gains.observer_search import (
    WORST_OF,
    AtSpeed,
    ObserverSearch,
    SelectedObserver,
    least_error,
)
from flight_design.gains.requirement import OBSERVER_REQUIREMENT, Requirement
from rise_di_controller.extensions.model_sections import VanesConfig, require_same_signs
from rise_di_controller.law.linear_loop import LinearPlant
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

# relative deviation of the uncertain aircraft, whose least phase margin counts
WORST_UNCERTAINTY = 0.3
# Entries of A and B that are 0 in the file may become this part of their row in the uncertain
# aircraft. With 0.05, K of q would be a tenth smaller, and the gains with vanes would change as
# well.
WORST_ZEROS = 0.02
# 1/s. An aircraft with a zero to the right of this value diverges while its outputs are held.
FASTEST = 1e-3
WORST_SEED = 1

# factor on the noise of the wind in the filter of an observer with a vane. With a factor of 10, u
# moves three times as much.
GUST_WITH_VANE = 2.0
# s, wing span divided by trim speed for an airframe without a span: the value of the osprey
SPAN_TIME = 0.12
STILL = 1.4  # motion of a vane that counts as rest, as a multiple of its noise


def model_for(airframe: Airframe, controller: ControllerConfig, noise: FloatArray) -> NominalModel:
    """Build the model of an airframe for a controller, in the law's order.

    `noise`, (m,), is the noise of the measured outputs, rms per sample.
    """
    model = airframe_model(
        airframe, controller.outputs, controller.inputs, noise, loop_of(controller)
    )
    return _limited(model, controller)


def _limited(model: NominalModel, controller: ControllerConfig) -> NominalModel:
    """Return a model with the limits of u and the D of a controller."""
    limits = controller.guard().limits
    return model._replace(
        D=np.array(controller.D, dtype=np.float64), lower=limits.lower, upper=limits.upper
    )


def with_aircraft_observer(
    controller: RiseDiConfig,
    airframe: Airframe,
    sets: Sequence[ObserverGains],
    noise: FloatArray,
    margin: float | FloatArray,
    requirement: Requirement = OBSERVER_REQUIREMENT,
    vanes: Mapping[str, float] = MappingProxyType({}),
    *,
    uncertain: bool = True,
    speeds: tuple[float, float] | None = None,
    keeps_gains: bool = False,
    earlier_design: SelectedObserver | None = None,
    is_free: Sequence[bool] | None = None,
    activity: float = 1.0,
    progress: Callable[[str], None] = lambda _: None,
) -> SelectedObserver:
    """Add the feedforward and the observer of an airframe to a controller, and select its gains.

    A search lowers or raises the gains of each channel by a factor, the relaxation. Among the
    linear loops with the required margins, it takes the loop with the least error in moderate
    turbulence with the noise of the sensors. The search is made with each of the gain `sets`, and
    the result with the least error is taken. With `keeps_gains` the gains stay as they are, and are
    only lowered if the margins need it.

    `margin` is the least delay margin, s, either one value for all inputs, or one for each, (m,).
    If the airframe is `uncertain`, the worst of WORST_OF uncertain aircraft must also have the
    phase margin. Aircraft with a zero in the right half plane are left out, because no gains can
    hold all of their outputs. `speeds` are two airspeeds, divided by the trim speed. With them the
    controller gets a schedule, and the loop must also have the margins at these speeds. `vanes` has
    the noise of each vane, rms per sample in rad, by its channel, alpha or beta.

    If there is an `earlier_design`, the search begins at its loop with the new feedforward. The
    search changes the relaxation of free channels only, so this loop stays if no change lowers the
    error. `activity` is the weight of the activity of u against the error. `progress` gets a
    sentence for each loop.

    Raises ParameterError for margins that no relaxation reaches. It is also raised for an airframe
    that has another D, has no wind, or cannot be the model of a feedforward.
    """
    activity_unit = law_activity_unit(airframe, controller) / activity
    airframe = through_allocation(airframe, controller)
    designs = _AircraftDesigns.around(controller, airframe, noise)
    if speeds is not None:
        _require_no_vanes(vanes, controller.outputs)
    model = designs.model
    plant = designs.plant(WORST_OF * uncertain, vanes)
    # Search with each gain set, and take the result with the least error.
    searches = []
    for gains in sets:
        section = None
        if vanes:
            section = _vanes(airframe, model, designs.names, gains.weights, vanes)
        search = ObserverSearch(
            base=designs.base,
            model=model,
            plant=plant,
            gains=gains,
            design=designs.observer(model, gains),
            margin=np.broadcast_to(margin, model.lag.shape),
            needed=requirement,
            vanes=section,
            others=[designs.at_speed(ratio, gains) for ratio in speeds or ()],
            air=None if keeps_gains else _air(airframe, model, vanes),
            activity_unit=activity_unit,
            earlier_design=earlier_design,
            is_free=is_free,
        )
        searches.append(search)
    selected = least_error(searches, progress)
    selected = selected._replace(left_out=1 + WORST_OF * uncertain - len(plant.A))
    if speeds is None:
        return selected
    return _with_schedule(selected, searches[selected.place], controller, airframe)


def law_activity_unit(airframe: Airframe, controller: ControllerConfig) -> FloatArray:
    """Return the unit of activity of each input v of the law, (m,).

    The unit is the mean abs(v_dot) that costs as much as a unit of error.

        unit_i = min_j unit_j / abs(T_ji),  u = T v

    unit_j is the result of `activity_units` for effector j.
    """
    T = distribution(airframe, controller)
    cost = (np.abs(T) / activity_units(airframe)[:, None]).max(axis=0)
    inputs = list(through_allocation(airframe, controller).inputs)
    columns = [inputs.index(name) for name in controller.inputs]
    with np.errstate(divide="ignore"):
        unit: FloatArray = 1.0 / cost[columns]
    return unit


def _with_schedule(
    selected: SelectedObserver,
    search: ObserverSearch,
    controller: RiseDiConfig,
    airframe: Airframe,
) -> SelectedObserver:
    """Add a schedule to a selected observer, with the models of the search at two other speeds."""
    slow, fast = (speed.model(selected.relaxation).model_dump() for speed in search.others)
    schedule = {"speed": airframe.speed, "slow": slow, "fast": fast}
    if controller.schedule is not None:
        schedule["time"] = controller.schedule.time
    scheduled = RiseDiConfig.validate_mapping(
        selected.controller.model_dump() | {"schedule": schedule}, "controller"
    )
    return selected._replace(controller=scheduled)


def _air(airframe: Airframe, model: NominalModel, vanes: Mapping[str, float]) -> Air:
    """Return moderate turbulence, gusts from below and from the side, and the noise of all sensors.

    The turbulence has a rotary gust in roll if p is a state. Without the rotary gust, only noise
    would move a symmetrical aircraft in roll.
    """
    speed = airframe.speed
    spectrum = dryden(**MODERATE, sigma=0.0)
    axes = [AXES.index(axis) for axis in airframe.gusts]
    peak, duration = discrete_gust(speed)
    wind = model.wind
    time = spectrum.length[axes] / speed
    sigma = spectrum.sigma[axes]
    gust = np.array([0.0 if axis == "longitudinal" else peak for axis in airframe.gusts])
    if "p" in airframe.states:
        turning, lag = roll_gust(spectrum, speed, airframe.span or SPAN_TIME * speed)
        column = -model.A[:, list(airframe.states).index("p")] * (1.0 - model.kinematic)
        wind = np.column_stack([wind, column])
        time = np.append(time, lag)
        sigma = np.append(sigma, turning)
        gust = np.append(gust, 0.0)
    m = len(model.noise)
    reading = np.zeros((m + len(vanes), len(time)))
    for k, name in enumerate(vanes):
        for column_of, axis in enumerate(airframe.gusts):
            if AIR_STATE[axis] == name:
                reading[m + k, column_of] = -1.0 / speed
    noise = np.append(model.noise, list(vanes.values()))
    return Air(
        wind=wind,
        reading=reading,
        time=time,
        sigma=sigma,
        noise=noise,
        gust=gust,
        gust_duration=duration,
    )


class _AircraftDesigns(NamedTuple):
    """Designs observers for a controller from the model of an airframe."""

    base: RiseDiConfig  # with the feedforward, without an observer
    airframe: Airframe
    noise: FloatArray  # (m,) noise of the outputs
    model: NominalModel
    names: Names

    @classmethod
    def around(
        cls, controller: RiseDiConfig, airframe: Airframe, noise: FloatArray
    ) -> "_AircraftDesigns":
        """Prepare the designs.

        Raises ParameterError if the airframe fits no observer of the controller.
        """
        require(
            bool(airframe.gusts),
            f"airframe {airframe.name}",
            "no gusts",
            "the effect of wind: the observer estimates it",
        )
        rows, columns = law_order(airframe, controller)
        Omega = airframe.matrix_c()[rows] @ airframe.matrix_b()[:, columns]
        require_same_signs(Omega, controller.D, f"airframe {airframe.name}")
        bare = controller.model_copy(update={"observer": None, "schedule": None})
        states = tuple(airframe.states)
        names = Names(states, controller.inputs, controller.outputs, tuple(airframe.gusts))
        model = model_for(airframe, controller, noise)
        return cls(with_feedforward(bare, airframe), airframe, noise, model, names)

    def plant(self, count: int, vanes: Iterable[str]) -> LinearPlant:
        """Return the nominal aircraft and up to `count` uncertain ones.

        Uncertain aircraft that no gains can hold are left out. In C, the rows of the vanes come
        below the rows of the outputs.
        """
        spread = Spread(zeros=WORST_ZEROS)
        A, B = nominal_and_sampled(self.airframe, WORST_UNCERTAINTY, count, WORST_SEED, spread)
        _, columns = law_order(self.airframe, self.base)
        states = np.array(list(self.airframe.states))
        vane_rows = [(states == name).astype(np.float64) for name in vanes]
        A = A + self.model.gravity
        B = B[:, :, columns]
        zeros = [fastest_zero(*pair, self.model.C) for pair in zip(A, B, strict=True)]
        is_stable = np.array(zeros) < FASTEST
        is_stable[0] = True  # keep the nominal aircraft, whose margins say more
        return LinearPlant(A[is_stable], B[is_stable], np.vstack([self.model.C, *vane_rows]))

    def observer(
        self, model: NominalModel, gains: ObserverGains
    ) -> Callable[[FloatArray], ObserverDesign]:
        """Return a function that designs the observer of a model for a relaxation, (m,).

        The relaxation changes only F, the gain from the estimates to u_o.
        """
        observer = aircraft_observer(model, self.names, gains.weights)
        model_by_tick = ObserverModel(observer.states, observer.Phi, observer.Gamma, observer.H)
        return lambda slower: observer._replace(
            F=feedback_gain(model_by_tick, model, slower * gains.weights.effort)
        )

    def at_speed(self, ratio: float, gains: ObserverGains) -> AtSpeed:
        """Design the observer for `ratio` times the trim speed."""
        outputs = self.base.outputs
        frame = at_speed(self.airframe, ratio, self.base.inputs[outputs.index("V")])
        model = model_for(frame, self.base, self.noise)
        feedforward = with_feedforward(self.base, frame).feedforward
        assert feedforward is not None  # noqa: S101 - it was added
        plant = LinearPlant(model.A + model.gravity, model.B, model.C)
        scale = np.array([1.0 if name == "V" else ratio**-2.0 for name in outputs])
        return AtSpeed(
            ratio=ratio,
            plant=plant,
            feedforward=feedforward,
            scale=scale,
            design=self.observer(model, gains),
        )


def _require_no_vanes(vanes: Mapping[str, float], outputs: Sequence[str]) -> None:
    """Check that a design at several speeds has the output V and no vanes, which it cannot use.

    Raises ParameterError if V is missing or if there is a vane.
    """
    require(
        not vanes,
        "speeds",
        f"the vanes {', '.join(vanes)}",
        "none: they read the model of the trim speed",
    )
    require("V" in outputs, "speeds", f"the outputs {', '.join(outputs)}", "V among them")


def _vanes(
    airframe: Airframe,
    model: NominalModel,
    names: Names,
    weights: Weights,
    vanes: Mapping[str, float],
) -> VanesConfig:
    """Build the section of the vanes.

    A vane measures its angle, alpha or beta, minus the wind on the angle's axis divided by V0.
    """
    model_by_tick = aircraft_model(model, names, weights.wind_time)
    H = []
    L = []
    blowing = {AIR_STATE[axis]: f"wind.{axis}" for axis in airframe.gusts}
    for name, noise in vanes.items():
        parts = {f"x.{name}": 1.0, blowing.get(name, ""): -1.0 / airframe.speed}
        row = np.array([parts.get(state, 0.0) for state in model_by_tick.states])
        with_vane = weights._replace(gust=GUST_WITH_VANE * weights.gust)
        H += row.tolist()
        L += (
            vane_correction(model_by_tick, model, (weights, with_vane), row, noise).ravel().tolist()
        )
    least = [STILL * noise for noise in vanes.values()]
    return VanesConfig(channels=tuple(vanes), H=tuple(H), L=tuple(L), least=tuple(least))


def with_extended_state_observer(
    controller: RiseDiConfig,
    Omega: FloatArray,
    noise: FloatArray,
    size: FloatArray,
    margin: float,
    requirement: Requirement = OBSERVER_REQUIREMENT,
) -> SelectedObserver:
    """Add an observer to a controller that knows Omega and the lags, but no A, f or wind.

    The gains of the law stay, unless the margin needs slower gains. The model of the feedforward is
    y_dot = Omega u, and the model of the observer is y_dot = diag(Omega) u. The observer must not
    have all of Omega: it would use the elevator to correct V, and this would pitch the aircraft.
    Omega, (m, m), is in the law's order. `noise`, (m,), is the noise of the outputs, rms per
    sample. `size`, (m,), holds the units of the outputs, 1 m/s or 0.1 rad/s. Raises ParameterError
    as `with_aircraft_observer` does.
    """
    m = len(controller.outputs)
    require_same_signs(Omega, controller.D, "Omega")
    values = controller.model_dump() | {
        "observer": None,
        "feedforward": integrator_model(controller, Omega).model_dump(),
    }
    base = RiseDiConfig.validate_mapping(values, "controller")
    model = _integrators(controller, np.diag(Omega), noise, size)
    names = Names(controller.outputs, controller.inputs, controller.outputs, ())
    law = controller.law_params()
    weights = extended_state_weights(controller.outputs, model.total_lag)
    # y_dot for a unit of scaled input: the gains are for a unit response
    response = np.abs(np.diag(Omega)) * law.input_scale
    unused = Weights(
        effort=weights.effort,
        drift=weights.drift,
        gust=np.zeros(0),
        wind_time=np.zeros(0),
        loose=np.zeros(1),
    )
    softening = np.broadcast_to(controller.softening, (m,))
    gains = ObserverGains(
        K=law.K * response,
        Lambda=law.Lambda,
        beta=law.beta * response,
        softening=softening,
        weights=unused,
    )

    def design(slower: FloatArray) -> ObserverDesign:
        drift = weights.drift / slower
        rate_drift = weights.rate_drift / slower**2
        new_weights = weights._replace(
            effort=slower * weights.effort, drift=drift, rate_drift=rate_drift
        )
        return extended_state_observer(model, names, new_weights)

    plant = LinearPlant(np.zeros((1, m, m)), Omega[None], np.eye(m))
    search = ObserverSearch(
        base=base,
        model=model,
        plant=plant,
        gains=gains,
        design=design,
        margin=np.full(m, margin),
        needed=requirement,
    )
    return least_error([search])


def _integrators(
    controller: RiseDiConfig, effects: FloatArray, noise: FloatArray, size: FloatArray
) -> NominalModel:
    """Build the model y_dot = diag(effects) u with the loop of a controller."""
    m = len(effects)
    none = np.zeros((m, m))
    ones = np.ones(m)
    loop = loop_of(controller)
    model = NominalModel(
        A=none,
        B=np.diag(effects),
        C=np.eye(m),
        gravity=none,
        wind=np.zeros((m, 0)),
        noise=noise,
        kinematic=np.zeros(m),
        size=size,
        input_scale=1.0 / np.abs(effects),
        D=ones,
        lag=loop.lag,
        total_lag=loop.total,
        period=loop.period,
        lower=-ones,
        upper=ones,
    )
    return _limited(model, controller)

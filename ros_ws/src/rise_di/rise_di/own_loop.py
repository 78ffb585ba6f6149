# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Use the controller in a loop of the user, tick by tick.

The plant of the loop is a function, or a system of python-control.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from flight_analysis.closed_loop import stations
from flight_analysis.report.account import account
from flight_analysis.report.shortfalls import judge
from flight_core.arguments import as_number
from flight_core.installation import require_package
from flight_core.modes import Mode
from flight_core.outcome import COMPLETED, FlightEnded, Refusal
from flight_core.parameters import require, require_channels
from flight_core.rates import nanoseconds, period_ns, seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray, StampedVector, as_array
from reference_model.params import ReferenceModelConfig
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.guard.guard import law_within_limits
from rise_di_controller.law.control_law import Measurements, fields, restored
from rise_di_controller.law.linear_loop import linear_law
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

if TYPE_CHECKING:
    import control

Plant = Callable[[float, FloatArray, float], ArrayLike]
"""A function plant(t, u, dt) -> y that advances from t to t + dt with u (p,) held, and then
measures y (m,), as deviations from trim in SI."""


class Loop:
    """The controller behind its guard, with a call for each tick.

    The ROS 2 node runs the same `Controller`, so that u has the same bits.

    Args:
        controller: Parameters of the controller, or a mapping of them as in the section
            `controller` of a scenario.

    Raises:
        ParameterError: The controller does not accept the parameters.

    Examples:
        >>> loop = rise_di.Loop(rise_di.find_scenario("osprey_servo").controller)
        >>> loop.step(0.0, np.zeros(4), np.zeros(4)).tolist()
        [0.0, 0.0, 0.0, 0.0]
    """

    def __init__(self, controller: ControllerConfig | Mapping[str, Any]) -> None:
        if not isinstance(controller, ControllerConfig):
            controller = AnyLaw.validate_mapping(controller, "controller")
        self.config = controller
        self._controller = Controller(self.config)
        self.outputs = self.config.outputs
        self.inputs = self.config.effectors
        self.measured = self.config.measured
        self.period = seconds(self._controller.period_ns)
        self._now_ns = -1  # instant of the last tick
        # Output of the last tick, or None if no u is to be sent.
        self.output: ControlOutput | None = None
        self.lost: Refusal | None = None  # why a sample of the last tick was not accepted

    @property
    def mode(self) -> Mode:
        """Mode of the guard.

        The mode is WAITING until y and y_m are fresh, then ENGAGED, and a failsafe mode if y or y_m
        is too old.
        """
        return self._controller.mode

    @property
    def names(self) -> tuple[str, ...]:
        """Channels of `output.internals`."""
        return self._controller.names

    def step(self, t: float, y: ArrayLike | None, y_m: ArrayLike | None) -> FloatArray:
        """Compute u of a tick at t.

        A sample that is None is lost. A sample whose values no aircraft can give counts as lost,
        too. `lost` then has the reason, and the first of several such ticks in a row gives a
        RuntimeWarning. Another RuntimeWarning says why the law engages again after a jump or a gap
        of the samples. y and y_m belong to t, which may jitter but must grow from tick to tick. The
        failsafe of the guard starts if samples are older than `max_age`.

        Args:
            t: Instant of the tick, s.
            y: Outputs, shape (m,), SI, as deviations from trim in the order of `outputs`. If the
                observer has vanes, they are in the order of `measured`. None is a lost sample.
            y_m: Reference, shape (m,), SI, in the order of `outputs`. None is a lost sample.

        Returns:
            u, shape (m,), or (p,) with an allocation, as a deviation from trim in SI. It is in the
            order of the inputs, or of the effectors, and 0 before the engagement.

        Raises:
            ParameterError: t does not grow, a length is wrong, or a value is not finite.
        """
        now_ns = nanoseconds(as_number(t, "t", 0.0, unit="s"))
        last_ns = self._now_ns
        require(
            now_ns > last_ns,
            "t",
            f"{t:g} s",
            f"more than {seconds(last_ns):g} s, the t of the last tick",
        )
        self._now_ns = now_ns
        before = self.lost
        self.lost = None
        for key, value, take in (
            ("y", y, self._controller.take_y),
            ("y_m", y_m, self._controller.take_y_m),
        ):
            if value is not None:
                names = self.measured if key == "y" else self.outputs
                self.lost = (
                    take(StampedVector(now_ns, self.vector(value, key, names)), now_ns) or self.lost
                )
        if self.lost is not None and before is None:
            warnings.warn(f"sample lost at t = {t:g} s: {self.lost}", RuntimeWarning, stacklevel=2)
        self.output = self._controller.tick(now_ns)
        if (reason := self._controller.pop_restart_reason()) is not None:
            warnings.warn(
                f"the law engages again at t = {t:g} s: {reason}", RuntimeWarning, stacklevel=2
            )
        return self._controller.state.command.copy()

    def retune(self, controller: ControllerConfig) -> None:
        """Replace the parameters before the next tick, without a jump of u.

        Args:
            controller: The new parameters, of the same law.

        Raises:
            ParameterError: As in `Controller.retune`.
        """
        self._controller.retune(controller)
        self.config = controller

    def vector(self, value: ArrayLike, key: str, names: Sequence[str]) -> FloatArray:
        """Check a sample of y or y_m, and copy it to an array with a value for each name.

        Args:
            value: The sample, shape (k,), SI.
            key: Name of the sample for the error message.
            names: The k channels.

        Returns:
            A copy, shape (k,), float64.

        Raises:
            ParameterError: The length is wrong, or a value is not finite.
        """
        expected = f"{len(names)} finite numbers: {', '.join(names)}"
        vector = as_array(value, key, expected)
        require(
            vector.shape == (len(names),) and bool(np.isfinite(vector).all()), key, value, expected
        )
        return vector.copy()


def fly_plant(
    plant: Plant,
    controller: ControllerConfig | Mapping[str, Any],
    reference_model: ReferenceModelConfig | Mapping[str, Any],
    duration: float,
) -> Tape:
    """Fly a plant of the user under the controller, and return the tape.

    `plant(t, u, dt)` advances by dt with u held, and returns y. The first call has t = dt = 0.
    Outputs and inputs have the order of the controller. If the plant raises FlightEnded, the flight
    ends early, and the `outcome` of the tape has the reason. The outcome also says whether errors
    are larger than the linear loop around y_dot = Omega u allows.

    Args:
        plant: Function (t, u, dt) -> y, with t and dt in s. u has the shape (p,) and y has (m,), as
            deviations from trim in SI.
        controller: Parameters of the controller, or a mapping as in a scenario.
        reference_model: Parameters of the reference model, or a mapping as in a scenario.
        duration: Duration of the flight, s.

    Returns:
        The tape with y, y_m, u and internals, SI.

    Raises:
        ParameterError: Parameters or y are invalid, or the outputs or rates of the sections do not
            fit together.

    Examples:
        >>> scenario = rise_di.find_scenario("osprey_servo")
        >>> def still(t, u, dt):
        ...     return np.zeros(4)
        >>> tape = rise_di.fly_plant(still, scenario.controller, scenario.reference_model, 0.1)
        >>> str(tape.outcome)
        'completed'
    """
    loop = Loop(controller)
    config = _reference_model(reference_model, loop)
    topics = stations.Topics()
    plant_station = _PlantStation(plant, loop, topics)
    reference = stations.ReferenceStation(config, topics, plant_station.period_ns)
    remainder = plant_station.period_ns % period_ns(config.rate, "reference_model.rate")
    multiple = f"a whole multiple of controller.rate ({loop.config.rate:g} Hz)"
    require(remainder == 0, "reference_model.rate", f"{config.rate:g} Hz", multiple)
    length_ns = nanoseconds(as_number(duration, "duration", loop.period, unit="s"))
    outcome = COMPLETED
    try:
        stations.FlightLoop([plant_station, reference, _LoopStation(loop, topics)]).run(length_ns)
    except FlightEnded as error:
        outcome = error.outcome
    signals = topics.pop_signals()
    y_m = signals["y_m"]
    values = np.column_stack([y_m[name] for name in loop.outputs])
    signals["y_m"] = Signal(y_m.stamp_ns, loop.outputs, values)
    tape = Tape(signals, outcome=outcome)
    flight_account = account(tape, None, outcome)
    return replace(tape, outcome=judge(outcome, tape, None, flight_account, loop.config))


class _PlantStation:
    """A plant of the user, which publishes y and holds the last u."""

    def __init__(self, plant: Plant, loop: Loop, topics: stations.Topics) -> None:
        self._plant = plant
        self._loop = loop
        self._topics = topics
        self._u = np.zeros(len(loop.inputs))
        self.period_ns = nanoseconds(loop.period)
        topics.advertise("y", loop.measured)
        topics.subscribe("u", self._take_u)

    def _take_u(self, sample: StampedVector, _t_ns: int) -> None:
        self._u = sample.value

    def step(self, t_ns: int) -> None:
        """Advance the plant to flight time t, and publish y."""
        dt = self._loop.period if t_ns else 0.0
        y = self._plant(seconds(t_ns) - dt, self._u.copy(), dt)
        value = self._loop.vector(y, "y of the plant", self._loop.measured)
        self._topics.publish("y", StampedVector(t_ns, value), t_ns)


class _LoopStation:
    """A `Loop` that steps with y and y_m of the same instant, and publishes u and internals."""

    def __init__(self, loop: Loop, topics: stations.Topics) -> None:
        self._loop = loop
        self._topics = topics
        self._samples: dict[str, FloatArray] = {}
        self.period_ns = nanoseconds(loop.period)
        for topic in ("y", "y_m"):
            names = loop.measured if topic == "y" else loop.outputs
            topics.subscribe(topic, partial(self._take, topic), names)
        topics.advertise("u", loop.inputs)
        topics.advertise("internals", loop.names)

    def _take(self, topic: str, sample: StampedVector, _t_ns: int) -> None:
        self._samples[topic] = sample.value

    def step(self, t_ns: int) -> None:
        """Step the loop with the last y and y_m, and publish u and internals."""
        u = self._loop.step(seconds(t_ns), self._samples["y"], self._samples["y_m"])
        if self._loop.output is not None:
            self._topics.publish("u", StampedVector(t_ns, u), t_ns)
            internals = StampedVector(t_ns, self._loop.output.internals)
            self._topics.publish("internals", internals, t_ns)


def _reference_model(
    config: ReferenceModelConfig | Mapping[str, Any], loop: Loop
) -> ReferenceModelConfig:
    """Return the validated parameters of a reference model for the outputs of a loop.

    Raises ParameterError if they are invalid or have other outputs.
    """
    if not isinstance(config, ReferenceModelConfig):
        config = ReferenceModelConfig.validate_mapping(config, "reference_model")
    expected = "the outputs of the controller"
    require_channels("reference_model.outputs", config.outputs, loop.outputs, expected)
    return config


def as_control(
    controller: ControllerConfig | Mapping[str, Any], *, linear: bool = False
) -> "control.NonlinearIOSystem":
    """Return the engaged law as a discrete system of python-control.

    The inputs are `y_NAME` and `y_m_NAME`, and the outputs `u_NAME`. The system has limits and
    anti-windup. Its state vector begins with the state of the law, followed by u and y_m of the
    last tick. All states are 0 right after an engagement in trim. With an allocation the outputs
    are the effectors, and the effectors are also the last values of the state.

    If `linear`, the result is the law near e = 0 without limits, for Bode plots and margins. It is
    a StateSpace from `y_NAME` to `u_NAME`. With an allocation it has the effectors T u as outputs,
    where T is the matrix of the allocation.

    Args:
        controller: Parameters of the controller, or a mapping as in a scenario.
        linear: Whether to return the linear law as a StateSpace.

    Returns:
        The system, with inputs and outputs in SI and the period of the controller.

    Raises:
        ParameterError: python-control is missing, the controller has a feedforward, which is no
            part of the law, or `linear` is True and the controller has `sign: literal`, which is
            not linear.

    Examples:
        >>> law = rise_di.as_control(rise_di.find_scenario("osprey_servo").controller, linear=True)
        >>> law.ninputs, law.noutputs
        (4, 4)
    """
    require_package("control")
    import control  # noqa: PLC0415 - an extra

    config = Loop(controller).config
    require(
        config.feedforward is None,
        "controller.feedforward",
        "a section",
        "none: as_control has the law alone",
    )
    dt = 1.0 / config.rate
    tuned = config.tuned_law()
    guard = config.guard()
    m = len(config.outputs)
    channels = [f"y_{name}" for name in config.outputs]
    names = [f"u_{name}" for name in config.effectors]
    if linear:
        matrices = _linear_matrices(config)
        return control.ss(*matrices, dt, inputs=channels, outputs=names, name=config.law)
    law, params = tuned
    zero = np.zeros(m)
    p = 0 if guard.allocation is None else len(names)
    in_trim = Measurements(y=zero, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero)
    start = fields(law.engage(in_trim, params))
    sizes = [value.size for value in start.values()]
    # With this offset, x = 0 is the engagement in trim.
    offset = np.concatenate([value.ravel() for value in start.values()])
    ends = np.cumsum(sizes)

    def tick(x: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        parts = np.split(offset + x[: ends[-1]], ends[:-1])
        values = zip(start.items(), parts, strict=True)
        state = restored(law, {name: part.reshape(first.shape) for (name, first), part in values})
        u_before, y_m_before, effectors = np.split(x[ends[-1] :], [m, 2 * m])
        sample = Measurements(
            y=v[:m], y_m=v[m:], y_m_dot=(v[m:] - y_m_before) / dt, u_trim=zero, u_before=u_before
        )
        after, _, u, allocated = law_within_limits(
            state, sample, np.float64(dt), tuned, guard, effectors if p else None
        )
        flat = np.concatenate([value.ravel() for value in fields(after).values()])
        commanded = np.asarray(u if allocated is None else allocated)
        return np.concatenate([flat - offset, u, v[m:], commanded[:p]]), commanded

    return control.nlsys(
        lambda t, x, v, _: tick(x, v)[0],
        lambda t, x, v, _: tick(x, v)[1],
        dt=dt,
        states=int(ends[-1]) + 2 * m + p,
        inputs=[*channels, *(f"y_m_{name}" for name in config.outputs)],
        outputs=names,
        name=config.law,
    )


def _linear_matrices(config: ControllerConfig) -> tuple[FloatArray, ...]:
    """Return A, B, C and D of the law near e = 0, from y to the effectors T u."""
    m = len(config.outputs)
    near = linear_law(config.tuned_law(), m, 1.0 / config.rate)
    allocation = config.guard().allocation
    T = np.eye(m) if allocation is None else allocation.T
    return near.A, near.B, T @ near.C, T @ near.D

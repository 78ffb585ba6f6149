# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guidance without ROS: the step of `modes` with state, the last samples, the program and the log.

The node and the simulation in one process use the same class `Guidance`.
"""

import zlib
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from flight_core.channels import POSE, UNKNOWN
from flight_core.failures import Failures, sentence
from flight_core.parameters import require
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import (
    ChannelError,
    FloatArray,
    StampedVector,
    require_newer,
    require_not_future,
)
from flight_guidance import guidance_state
from flight_guidance.guidance_state import (
    TARGETS,
    Begin,
    GuidanceMode,
    GuidanceParams,
    GuidanceState,
    Inputs,
    Lateral,
    StepCommands,
    Target,
    Vertical,
)
from flight_guidance.modes import modes, targets
from flight_guidance.multicopter import multicopter
from flight_guidance.notices import (
    FAILED,
    LAST_GOES_ON,
    LEARNED,
    LINK_AGE,
    STALE_TIME,
)
from flight_guidance.params import GuidanceConfig
from flight_guidance.reach import Authority, RollTest, authority_of
from flight_guidance.steering import path
from flight_guidance.steering.path import Line, Route

LIMITED = ("bank", "theta", "climb", "V", "slew")
STATE = ("phi", "theta", "alpha", "alpha_trim", "slip", "psi")
WIND = ("north", "east")


class GuidanceOutput(NamedTuple):
    """Output of a step."""

    u_m: FloatArray  # the commands in the order of the parameters' outputs, then ATTITUDE
    log: FloatArray  # in the order of `names`
    notices: tuple[str, ...] = ()


class GuidanceSample(NamedTuple):
    """What a step leaves for the log: inputs, state after the step, commands."""

    inputs: Inputs
    state: GuidanceState
    commands: StepCommands
    route: int  # a `digest`
    link_age: float  # s since the last message of an operator, 0 without a limit
    failed: int  # number of failed steps

    @property
    def pose_age(self) -> float:
        """Age of the pose, s."""
        return seconds(self.inputs.pose_age_ns)

    @property
    def given(self) -> int:
        """The new commands, as `bits`."""
        return guidance_state.bits(self.inputs.commands)


def _tuple(*values: float) -> tuple[float, ...]:
    return values


class LogChannels(NamedTuple):
    """Channels of the log, and the attribute of a `GuidanceSample` that they hold."""

    names: Sequence[str]
    attribute: str
    kind: Callable[..., Any] = float  # makes the attribute of the logged numbers

    def logged(self, sample: GuidanceSample) -> Sequence[float]:
        """The numbers of the channels."""
        value = attrgetter(self.attribute)(sample)
        return value if isinstance(value, tuple) else (value,)

    def restored(self, numbers: Mapping[str, float]) -> Any:
        """The attribute."""
        return self.kind(*(numbers[name] for name in self.names))


def channels(outputs: Sequence[str]) -> tuple[LogChannels, ...]:
    """The channels of the log, in its order."""
    return (
        LogChannels(["mode"], "state.mode", GuidanceMode),
        LogChannels(["mode.lateral"], "state.lateral", Lateral),
        LogChannels(["mode.vertical"], "state.vertical", Vertical),
        LogChannels(["leg"], "state.leg", int),
        LogChannels(["route"], "route"),
        LogChannels(["xtrack"], "commands.xtrack"),
        LogChannels(["to_go"], "commands.to_go"),
        LogChannels(["joining"], "state.joining"),
        LogChannels(["track"], "commands.track"),
        LogChannels(["missed"], "commands.missed"),
        LogChannels(["fence.action"], "state.fence"),
        LogChannels(["fence.clearance"], "commands.clearance"),
        LogChannels(["fence.predicted"], "commands.predicted"),
        LogChannels(["phi_c"], "commands.phi_c"),
        LogChannels(["theta_c"], "commands.theta_c"),
        LogChannels(["climb_c"], "state.climb_c"),
        LogChannels(["V_c"], "state.V_c"),
        *(LogChannels([f"limited.{name}"], f"commands.{name}_limited") for name in LIMITED),
        LogChannels(["age.pose"], "pose_age"),
        LogChannels([LINK_AGE], "link_age"),
        LogChannels([FAILED], "failed"),
        LogChannels(["begin"], "inputs.begin", Begin),
        LogChannels(["given"], "given", int),
        LogChannels(LEARNED, "inputs.authority", Authority),
        LogChannels([f"target.{name}" for name in TARGETS], "state.target", Target),
        *(LogChannels([f"state.{name}"], f"state.{name}") for name in STATE),
        LogChannels([f"wind.{name}" for name in WIND], "state.wind", _tuple),
        LogChannels(["loitered"], "state.loitered"),
        LogChannels([f"pose.{name}" for name in POSE], "inputs.pose", _tuple),
        LogChannels([f"y.{name}" for name in outputs], "inputs.y", _tuple),
        LogChannels([f"u_m.{name}" for name in outputs], "state.u_m", _tuple),
    )


def names(outputs: Sequence[str]) -> tuple[str, ...]:
    """Names of the channels of the log."""
    return tuple(chain.from_iterable(each.names for each in channels(outputs)))


def require_channels(logged: Collection[str]) -> None:
    """Raise ParameterError for a log of guidance without one of the channels of `names`."""
    missing = [name for name in names(()) if name not in logged]
    require(not missing, "guidance", f"a log without {', '.join(missing)}", "all of its channels")


def u_m(state: GuidanceState) -> FloatArray:
    """What is published as u_m.

    The commands in the order of the parameters' outputs, then ATTITUDE.
    """
    return np.array([*state.u_m, state.phi, state.theta - state.alpha])


def row(sample: GuidanceSample, outputs: Sequence[str]) -> FloatArray:
    """A sample of the log, in the order of `names`."""
    values = chain.from_iterable(each.logged(sample) for each in channels(outputs))
    return np.array([*values], dtype=np.float64)


def restored(
    t_ns: int, logged: Mapping[str, float], outputs: Sequence[str]
) -> tuple[Inputs, GuidanceState]:
    """The inputs of a step and the state after the step, from a sample of the log."""
    attributes = {each.attribute: each.restored(logged) for each in channels(outputs)}

    def group(prefix: str) -> dict[str, Any]:
        return {
            name.removeprefix(prefix): value
            for name, value in attributes.items()
            if name.startswith(prefix)
        }

    state = GuidanceState(
        t_ns=t_ns,
        velocity=(logged["pose.v_north"], logged["pose.v_east"]),
        **group("state."),
    )
    given = attributes["given"]
    inputs = Inputs(
        t_ns=t_ns,
        pose_age_ns=nanoseconds(attributes["pose_age"]),
        commands={
            name: value
            for k, (name, value) in enumerate(state.target._asdict().items())
            if given >> k & 1
        },
        **group("inputs."),
    )
    return inputs, state


def step(
    state: GuidanceState | None, inputs: Inputs, route: Route | None, params: GuidanceParams
) -> tuple[GuidanceState, StepCommands]:
    """The step of the kind of aircraft: `modes.step`, or `multicopter.step`."""
    flown = modes.step if params.multicopter is None else multicopter.step
    return flown(state, inputs, route, params)


def digest(route: Route | None) -> int:
    """A number to distinguish routes; 0 for none."""
    return 0 if route is None else zlib.crc32(repr(route).encode())


class Guidance:
    """`modes.step` with state, the last pose and y, the route and the program of targets."""

    def __init__(self, parameters: GuidanceConfig) -> None:
        self._params: GuidanceParams = parameters.params()
        self.period_ns = self._params.period_ns
        self.names = names(parameters.outputs)
        waypoints = parameters.waypoints()
        self.route = parameters.plan(waypoints) if waypoints else None
        self._digest = digest(self.route)
        self._lander = parameters.lander(self.route)
        self._program = deque(
            (nanoseconds(start), target) for start, target in parameters.program_steps()
        )
        self._pose: StampedVector | None = None
        self._y: StampedVector | None = None
        self._commands: dict[str, float] = {} if self.route is None else {"leg": 0.0}
        self._route_waits = self.route is not None  # no step has flown it yet
        self._state: GuidanceState | None = None
        self._is_engaged = True
        self._paused = False
        self._begin = Begin.HOLD
        self._notices = parameters.notices()
        # for a pose that is young enough, or a step that does not fail
        self._waits_from_ns: int | None = None
        self._failures = Failures()
        self._failure = ""  # why there is no u_m, as a sentence; empty where it waits for a pose
        # the instant of the operator's last message, or of the first step
        self._operated_ns: int | None = None
        self._link_lost = False
        self._authority = Authority()
        self._roll = RollTest()

    @property
    def mode(self) -> GuidanceMode:
        """Mode of the last step."""
        return (
            GuidanceMode.OFF
            if self._state is None or self._begin is not Begin.NO
            else self._state.mode
        )

    @property
    def failed(self) -> int:
        """Number of failed steps."""
        return self._failures.count

    @property
    def state(self) -> GuidanceState | None:
        """The state after the last step, None before the first."""
        return self._state

    def take_pose(self, sample: StampedVector, now_ns: int) -> None:
        """Take a pose in the order of `channels.POSE`.

        Raises ChannelError for a stamp not newer than the last or in the future, for a value beyond
        LARGEST, and for a pose equal to the last in every value.
        """
        last = self._pose
        newest = self._newest(self._pose, sample, now_ns)
        if last is not None and np.array_equal(last.value, newest.value):
            raise ChannelError(
                "frozen", "pose: found every value as before, expected an aircraft that moves"
            )
        self._pose = newest

    def take_y(self, sample: StampedVector, now_ns: int) -> None:
        """Take a y in the order of the parameters' outputs.

        Raises ChannelError as `take_pose` does, but for equal values.
        """
        self._y = self._newest(self._y, sample, now_ns)

    def take_authority(self, channels: Mapping[str, float]) -> None:
        """Limit the steps from now on by what the inputs can do.

        The channels are those of the topic `authority`.
        """
        self._authority = authority_of(channels)._replace(roll=self._authority.roll)

    def _newest(
        self, last: StampedVector | None, sample: StampedVector, now_ns: int
    ) -> StampedVector:
        require_not_future(sample.stamp_ns, now_ns, self._params.max_age_ns)
        if last is not None:
            require_newer(sample.stamp_ns, last.stamp_ns)
        if not (largest := float(np.max(np.abs(sample.value)))) <= guidance_state.LARGEST:
            raise ChannelError(
                "bounds",
                f"found a value of {largest:g}, expected at most {guidance_state.LARGEST:g} in SI",
            )
        return sample

    def take_target(self, values: Mapping[str, float]) -> None:
        """Take commands by channel of Target; commands of the same instant come in one call.

        Raises ChannelError.
        """
        targets.read_target(values, self._params, self.route, degrees=True)
        # A lateral or vertical command replaces the command of the mode before.
        channels = self._params.channels
        for table in (channels.lateral, channels.vertical):
            if any(name in table for name in values):
                self._commands = {
                    name: value for name, value in self._commands.items() if name not in table
                }
        self._commands |= values

    def take_route(self, route: Route) -> None:
        """Fly a route from its first leg on.

        While guidance is off, the route waits for the engagement. Commands before the route and not
        taken by a step yet are void, and so are the legs of the program.
        """
        self.route = route
        self._lander = None  # that of the parameters lands on their route
        self._digest = digest(route)
        self._commands = {}
        self._route_waits = True
        program = self._program
        self._program = deque()
        for start, step in program:
            targets = {name: value for name, value in step.items() if name != "leg"}
            if targets:
                self._program.append((start, targets))
        self.take_target({"leg": 0.0})

    def keep_link(self) -> None:
        """Know that an operator is there: the age of the link counts from the next step on."""
        self._operated_ns = None
        self._link_lost = False

    def hold(self) -> bool:
        """Hold the heading, the altitude and the airspeed of now, or of a multicopter the place.

        False while guidance does not fly.
        """
        if self.mode is not GuidanceMode.ENGAGED or self._pose is None or self._y is None:
            return False
        hold_of_kind = modes.hold_now if self._params.multicopter is None else multicopter.hold
        self.take_target(hold_of_kind(self.pose(), tuple(self._y.value.tolist()), self._params))
        return True

    def home(self) -> bool:
        """Fly home and orbit there; False while guidance does not fly."""
        if self.mode is not GuidanceMode.ENGAGED or self._pose is None:
            return False
        self.take_target(
            targets.home(self.pose(), targets.within_reach(self._params, self._authority))
        )
        return True

    def skip(self) -> bool:
        """Leave the waypoint ahead out and fly to the next waypoint.

        False while no route is flown, and on the last leg.
        """
        state = self._state
        route = self.route
        if (
            self.mode is not GuidanceMode.ENGAGED
            or state is None
            or state.lateral is not Lateral.ROUTE
            or route is None
        ):
            return False
        later = range(state.leg + 1, len(route.legs))
        leg = next(
            (k for k in later if isinstance(route.legs[k], Line) or route.legs[k].end is None), None
        )
        if leg is None:
            return False
        self.take_target({"leg": float(leg), "along": path.length(route.legs[leg])})
        return True

    def resume(self) -> bool:
        """Fly the last leg again from the nearest point.

        False while the route is flown, and without a route.
        """
        state = self._state
        route = self.route
        if (
            self.mode is not GuidanceMode.ENGAGED
            or state is None
            or state.lateral is Lateral.ROUTE
            or route is None
        ):
            return False
        pose = self.pose()
        along = path.nearest(route.legs[state.leg], (pose["north"], pose["east"]))
        self.take_target({"leg": float(state.leg), "along": along})
        return True

    def engage(self, *, engaged: bool) -> None:
        """Engage, with the heading, the altitude and the airspeed of then; or command nothing."""
        if engaged and not self._is_engaged:
            self._begin = Begin.HOLD
            self._forget_commands()
        self._is_engaged = engaged

    def pause(self, *, paused: bool, forget: bool) -> None:
        """Command nothing while the controller does not fly.

        `forget`: then hold what is measured, else go on as before.
        """
        if forget:
            self._begin = Begin.HOLD
        if self._paused and not paused and self._begin is Begin.HOLD:
            self._forget_commands()
        self._paused = paused

    def _forget_commands(self) -> None:
        """Forget commands given while guidance did not fly, but a route.

        Before the first step commands wait.
        """
        if self._state is not None:
            self._commands = {
                name: value
                for name, value in self._commands.items()
                if name == "leg" and self._route_waits
            }

    def pose(self) -> dict[str, float]:
        """The last pose by channel; empty before the first pose."""
        return {} if self._pose is None else dict(zip(POSE, self._pose.value.tolist(), strict=True))

    def y(self) -> dict[str, float]:
        """The last y by channel; empty before the first y."""
        return (
            {}
            if self._y is None
            else dict(zip(self._params.outputs, self._y.value.tolist(), strict=True))
        )

    def ages(self, now_ns: int) -> dict[str, float]:
        """Ages of the last received y and pose, s; a channel never received is absent."""
        samples = {"y": self._y, "pose": self._pose}
        return {
            name: seconds(now_ns - sample.stamp_ns)
            for name, sample in samples.items()
            if sample is not None
        }

    def waits(self, now_ns: int) -> str:
        """Why there is no u_m; "" where there is one.

        Guidance then has waited for STALE_TIME for a young pose or a step without a failure.
        """
        since = self._waits_from_ns
        pose = self._pose
        if since is None or pose is None or now_ns - since < nanoseconds(STALE_TIME):
            return ""
        if self._failure:
            return f"no u_m: a step of guidance failed: {self._failure}"
        age = seconds(now_ns - pose.stamp_ns)
        limit = seconds(self._params.max_age_ns)
        return f"no u_m: pose is {age:.2f} s old, guidance.max_age {limit:g} s"

    def _watch_link(self, now_ns: int) -> None:
        """Fly home, once, where the age of the operator's link exceeds the limit."""
        if not self._params.link_timeout_ns:
            return
        if self._operated_ns is None:
            self._operated_ns = now_ns
        if now_ns - self._operated_ns > self._params.link_timeout_ns and not self._link_lost:
            self._link_lost = self.home()  # again at the next step while guidance does not fly

    def _link_age(self, now_ns: int) -> float:
        """Age of the operator's link, s, 0 without a limit."""
        return 0.0 if self._operated_ns is None else seconds(now_ns - self._operated_ns)

    def _test_roll(self, y: Sequence[float]) -> None:
        """Add to the authority whether p follows the command of the last step."""
        state = self._state
        params = self._params
        if state is None or params.multicopter is not None:
            return
        at_p = params.outputs.index("p")
        dt = seconds(params.period_ns)
        self._roll = self._roll.after(dt, state.u_m[at_p], y[at_p], params.attitude.roll_rate)
        self._authority = self._authority._replace(roll=0.0 if self._roll.ignored else UNKNOWN)

    def _land(self) -> None:
        """Add the commands of the landing, unless an operator or the program has others."""
        state = self._state
        if self._lander is None or self.route is None or state is None:
            return
        if any(
            name in guidance_state.LATERAL or name in guidance_state.VERTICAL
            for name in self._commands
        ):
            self._lander.leave()
        elif self._begin is Begin.NO:
            self._commands |= self._lander.commands(state, self.pose(), self.route)

    def step(self, now_ns: int, t_ns: int) -> GuidanceOutput | None:
        """A step at an instant and flight time t.

        None without fresh y, before the first pose, and while disengaged. After steps of None the
        filters start again at the measured values. A step fails by an exception or a value that is
        not finite: the state stays, commands wait for the next step, and the last u_m goes on up to
        the age limit.
        """
        try:
            return self._step(now_ns, t_ns)
        except Exception as error:  # whatever it is, the next step is tried
            is_said = self._failures.add(seconds(t_ns))
            return self._last_goes_on(now_ns, sentence(error), is_said=is_said)

    def _last_goes_on(self, now_ns: int, cause: str, *, is_said: bool) -> GuidanceOutput | None:
        """The output of a failed step: the last u_m; None beyond the age limit."""
        state = self._state
        pose = self._pose
        y = self._y
        is_old = state is None or now_ns - state.t_ns > self._params.max_age_ns
        if is_old or state is None or pose is None or y is None or self._begin is not Begin.NO:
            self._begin = max(self._begin, Begin.AGAIN)
            self._waits_from_ns = now_ns if self._waits_from_ns is None else self._waits_from_ns
            self._failure = cause
            return None
        inputs = self._inputs(now_ns, pose, y)._replace(commands={})
        log = self._row(inputs, state, StepCommands(), now_ns)
        notices = (f"{LAST_GOES_ON}: {cause}",) if is_said else ()
        return GuidanceOutput(u_m(state), log, notices)

    def _row(
        self, inputs: Inputs, state: GuidanceState, commands: StepCommands, now_ns: int
    ) -> FloatArray:
        """The sample of the log of a step at an instant."""
        sample = GuidanceSample(
            inputs=inputs,
            state=state,
            commands=commands,
            route=self._digest,
            link_age=self._link_age(now_ns),
            failed=self.failed,
        )
        return row(sample, self._params.outputs)

    def _inputs(self, now_ns: int, pose: StampedVector, y: StampedVector) -> Inputs:
        """What a step takes at an instant."""
        return Inputs(
            t_ns=now_ns,
            begin=self._begin,
            pose=tuple(pose.value.tolist()),
            pose_age_ns=max(now_ns - pose.stamp_ns, 0),
            y=tuple(y.value.tolist()),
            commands=self._commands,
            authority=self._authority,
        )

    def _step(self, now_ns: int, t_ns: int) -> GuidanceOutput | None:
        while self._program and self._program[0][0] <= t_ns:
            self.take_target(self._program.popleft()[1])
        y = self._y
        pose = self._pose
        flies = self._is_engaged and not self._paused
        if pose is None or y is None or now_ns - y.stamp_ns > self._params.max_age_ns or not flies:
            self._begin = max(self._begin, Begin.AGAIN)
            return None
        is_stale = now_ns - pose.stamp_ns > self._params.max_age_ns
        if self._begin is not Begin.NO and is_stale:
            self._waits_from_ns = now_ns if self._waits_from_ns is None else self._waits_from_ns
            self._failure = ""
            return None
        self._watch_link(now_ns)
        self._land()
        self._test_roll(y.value.tolist())
        inputs = self._inputs(now_ns, pose, y)
        route_notes = self.route.notes if self.route is not None and self._route_waits else ()
        state, commands = step(self._state, inputs, self.route, self._params)
        log = self._row(inputs, state, commands, now_ns)
        output = u_m(state)
        if not np.isfinite(np.append(log, output)).all():
            raise ArithmeticError("a value that is not finite")
        notices = self._notices.take(
            seconds(t_ns), dict(zip(self.names, log.tolist(), strict=True))
        )
        self._state = state
        self._begin = Begin.NO
        self._commands = {}
        self._route_waits = False
        self._waits_from_ns = None
        return GuidanceOutput(output, log, (*route_notes, *(notice.text for notice in notices)))

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run guidance without ROS: `modes.step` with its state, the last samples, and timed commands.

The node and the simulation in one process use the same class `Guidance`.
"""

import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from flight_core.channels import POSE, UNKNOWN
from flight_core.failures import Failures, sentence
from flight_core.outcome import Refusal
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import (
    ChannelError,
    FloatArray,
    SampleFault,
    StampedVector,
    is_finite,
    require_newer,
    require_not_future,
)
from flight_guidance import guidance_log, guidance_state
from flight_guidance.guidance_state import (
    Begin,
    GuidanceMode,
    GuidanceParams,
    GuidanceState,
    Inputs,
    Lateral,
    StepCommands,
)
from flight_guidance.modes import modes, targets
from flight_guidance.multicopter import multicopter
from flight_guidance.notices import (
    LAST_REPEATED,
    STALE_TIME,
)
from flight_guidance.params import GuidanceConfig
from flight_guidance.reach import Authority, RollTest, authority_of
from flight_guidance.steering import path
from flight_guidance.steering.path import Line, Route


class GuidanceOutput(NamedTuple):
    """Output of a step of guidance."""

    u_m: FloatArray  # the commands in the order of the parameters' outputs, then ATTITUDE
    log: FloatArray  # values of the log, in the order of `guidance_log.names`
    notices: tuple[str, ...] = ()


def u_m(state: GuidanceState) -> FloatArray:
    """Return the values that are published as u_m.

    First come the commands, in the order of the parameters' outputs, and then the channels of
    ATTITUDE.
    """
    return np.array([*state.u_m, state.phi, state.theta - state.alpha])


def step(
    state: GuidanceState | None, inputs: Inputs, route: Route | None, params: GuidanceParams
) -> tuple[GuidanceState, StepCommands]:
    """Take a step, by `modes.step` for an airplane or `multicopter.step` for a multicopter."""
    step_of_kind = modes.step if params.multicopter is None else multicopter.step
    return step_of_kind(state, inputs, route, params)


def digest(route: Route | None) -> int:
    """Return a number that identifies a route, or 0 for no route."""
    return 0 if route is None else zlib.crc32(repr(route).encode())


class Guidance:
    """The guidance of an aircraft: its state, the last pose and y, its route and timed commands."""

    def __init__(self, parameters: GuidanceConfig) -> None:
        self._params: GuidanceParams = parameters.params()
        self.period_ns = self._params.period_ns
        self.names = guidance_log.names(parameters.outputs)
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
        self._route_waits = self.route is not None  # whether no step has flown the route yet
        self._state: GuidanceState | None = None
        self._is_engaged = True
        self._paused = False
        self._begin = Begin.HOLD
        self._notices = parameters.notices()
        # Instant since which guidance has waited for a young pose, or for a step that does not
        # fail. It is None if guidance does not wait.
        self._waits_from_ns: int | None = None
        self._failures = Failures()
        # why the last step failed; None if guidance waits for a pose
        self._failure: str | None = None
        # Instant of the operator's last message, or of the first step before the first message.
        self._operated_ns: int | None = None
        self._link_lost = False
        self._authority = Authority()
        self._roll = RollTest()

    @property
    def mode(self) -> GuidanceMode:
        """Mode of the last step."""
        if self._state is None or self._begin is not Begin.NO:
            return GuidanceMode.OFF
        return self._state.mode

    @property
    def failed(self) -> int:
        """Number of steps that failed."""
        return self._failures.count

    @property
    def state(self) -> GuidanceState | None:
        """State after the last step, None before the first."""
        return self._state

    def take_pose(self, sample: StampedVector, now_ns: int) -> None:
        """Take a pose in the order of `channels.POSE`.

        Raises ChannelError if the stamp is not newer than the stamp of the last pose, or is in the
        future. It is also raised if a value is beyond LARGEST, and if every value is the same as in
        the last pose.
        """
        last = self._pose
        newest = self._newest(self._pose, sample, now_ns)
        if last is not None and np.array_equal(last.value, newest.value):
            raise ChannelError(
                SampleFault.FROZEN,
                "pose: found every value as before, expected an aircraft that moves",
            )
        self._pose = newest

    def take_y(self, sample: StampedVector, now_ns: int) -> None:
        """Take a y in the order of the parameters' outputs.

        Raises ChannelError as `take_pose` does, but equal values are allowed.
        """
        self._y = self._newest(self._y, sample, now_ns)

    def take_authority(self, channels: Mapping[str, float]) -> None:
        """Limit the next steps by the authority of the inputs.

        `channels` are the channels of the topic `authority`.
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
                SampleFault.BOUNDS,
                f"found a value of {largest:g}, expected at most {guidance_state.LARGEST:g} in SI",
            )
        return sample

    def take_target(self, values: Mapping[str, float]) -> None:
        """Take commands by channel of Target, to be flown from the next step on.

        Commands that belong together must come in one call. Raises ChannelError for a command that
        guidance cannot fly.
        """
        targets.read_target(values, self._params, self.route, degrees=True)
        # A new lateral or vertical command replaces one of another mode that still waits.
        channels = self._params.channels
        for table in (channels.lateral, channels.vertical):
            if any(name in table for name in values):
                self._commands = {
                    name: value for name, value in self._commands.items() if name not in table
                }
        self._commands |= values

    def take_route(self, route: Route) -> None:
        """Take a new route, to be flown from its first leg on.

        While guidance is off, the route waits for the engagement. Commands that no step has taken
        yet are dropped, and so are the commands over time that name a leg.
        """
        self.route = route
        self._lander = None  # the lander belongs to the route of the parameters
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
        """Note a sign of life of the operator. The age of the link is the time since it."""
        self._operated_ns = None
        self._link_lost = False

    def hold(self) -> bool:
        """Hold the present heading, altitude and airspeed, or the place of a multicopter.

        Returns False if guidance is not flying.
        """
        if self.mode is not GuidanceMode.ENGAGED or self._pose is None or self._y is None:
            return False
        hold_of_kind = modes.hold_now if self._params.multicopter is None else multicopter.hold
        commands = hold_of_kind(self.pose(), tuple(self._y.value.tolist()), self._params)
        self.take_target(targets.permitted(commands, self._params))
        return True

    def home(self) -> bool:
        """Fly home and orbit there. Returns False if guidance is not flying."""
        if self.mode is not GuidanceMode.ENGAGED or self._pose is None:
            return False
        params = targets.within_reach(self._params, self._authority)
        self.take_target(targets.permitted(targets.home(self.pose(), params), params))
        return True

    def skip(self) -> bool:
        """Leave out the waypoint ahead and fly to the next one.

        Returns False if no route is flown, or if the route has no further leg.
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
        """Fly the last leg of the route again, from its nearest point on.

        Returns False if the route is already flown, or if there is no route.
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
        """Start guidance with the present heading, altitude and airspeed, or stop its commands."""
        if engaged and not self._is_engaged:
            self._begin = Begin.HOLD
            self._forget_commands()
        self._is_engaged = engaged

    def pause(self, *, paused: bool, forget: bool) -> None:
        """Pause guidance because the controller does not fly, or let it fly again.

        When guidance flies again, it continues with its last commands. If `forget` was set in the
        meantime, it holds the measured heading, altitude and airspeed.
        """
        if forget:
            self._begin = Begin.HOLD
        if self._paused and not paused and self._begin is Begin.HOLD:
            self._forget_commands()
        self._paused = paused

    def _forget_commands(self) -> None:
        """Forget the commands that came while guidance did not fly, except a route.

        Commands from before the first step are kept.
        """
        if self._state is not None:
            self._commands = {
                name: value
                for name, value in self._commands.items()
                if name == "leg" and self._route_waits
            }

    def pose(self) -> dict[str, float]:
        """Return the last pose by channel, or an empty dict if no pose has come yet."""
        return {} if self._pose is None else dict(zip(POSE, self._pose.value.tolist(), strict=True))

    def y(self) -> dict[str, float]:
        """Return the last y by channel, or an empty dict if no y has come yet."""
        if self._y is None:
            return {}
        return dict(zip(self._params.outputs, self._y.value.tolist(), strict=True))

    def ages(self, now_ns: int) -> dict[str, float]:
        """Return the ages of the last y and pose, s; a signal that never came is absent."""
        samples = {"y": self._y, "pose": self._pose}
        return {
            name: seconds(now_ns - sample.stamp_ns)
            for name, sample in samples.items()
            if sample is not None
        }

    def reason_to_wait(self, now_ns: int) -> Refusal | None:
        """Return why guidance has published no u_m for longer than STALE_TIME, or None.

        The reason is that the pose is too old, or that the steps fail.
        """
        since = self._waits_from_ns
        pose = self._pose
        if since is None or pose is None or now_ns - since < nanoseconds(STALE_TIME):
            return None
        if self._failure is not None:
            return Refusal(f"no u_m: a step of guidance failed: {self._failure}")
        age = seconds(now_ns - pose.stamp_ns)
        limit = seconds(self._params.max_age_ns)
        return Refusal(f"no u_m: pose is {age:.2f} s old, guidance.max_age {limit:g} s")

    def _watch_link(self, now_ns: int) -> None:
        """Begin to fly home if the operator's link has been silent for longer than its limit."""
        if not self._params.link_timeout_ns:
            return
        if self._operated_ns is None:
            self._operated_ns = now_ns
        if now_ns - self._operated_ns > self._params.link_timeout_ns and not self._link_lost:
            # If guidance does not fly, the next step tries `home` again.
            self._link_lost = self.home()

    def _link_age(self, now_ns: int) -> float:
        """Return the age of the operator's link, s, or 0 if the parameters set no limit for it."""
        return 0.0 if self._operated_ns is None else seconds(now_ns - self._operated_ns)

    def _test_roll(self, y: Sequence[float]) -> None:
        """Test whether p follows its command, and note the result in the authority as `roll`."""
        state = self._state
        params = self._params
        if state is None or params.multicopter is not None:
            return
        at_p = params.outputs.index("p")
        dt = seconds(params.period_ns)
        self._roll = self._roll.after(dt, state.u_m[at_p], y[at_p], params.attitude.roll_rate)
        self._authority = self._authority._replace(roll=0.0 if self._roll.is_ignored else UNKNOWN)

    def _land(self) -> None:
        """Add the commands of the landing, unless there are other commands for this step."""
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
        """Take a step at the instant `now_ns` and the flight time `t_ns`.

        Returns None if y is not fresh, if no pose has come yet, or if guidance is disengaged. When
        guidance continues after that, its filters start again at the measured values. If a step
        raises an exception or gives a value that is not finite, the state stays and commands wait
        for the next step. The last u_m is then repeated until the age limit.
        """
        try:
            return self._step(now_ns, t_ns)
        except Exception as error:
            # Whatever the error is, the next step tries again.
            is_said = self._failures.add(seconds(t_ns))
            return self._last_goes_on(now_ns, sentence(error), is_said=is_said)

    def _last_goes_on(self, now_ns: int, cause: str, *, is_said: bool) -> GuidanceOutput | None:
        """Return what is published after a failed step: the last u_m, or None beyond the age limit.

        `cause` is a sentence on the error, and becomes a notice if `is_said`.
        """
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
        notices = (f"{LAST_REPEATED}: {cause}",) if is_said else ()
        return GuidanceOutput(u_m(state), log, notices)

    def _row(
        self, inputs: Inputs, state: GuidanceState, commands: StepCommands, now_ns: int
    ) -> FloatArray:
        """Return the row of the log for a step at an instant."""
        sample = guidance_log.GuidanceSample(
            inputs=inputs,
            state=state,
            commands=commands,
            route=self._digest,
            link_age=self._link_age(now_ns),
            failed=self.failed,
        )
        return guidance_log.row(sample, self._params.outputs)

    def _inputs(self, now_ns: int, pose: StampedVector, y: StampedVector) -> Inputs:
        """Collect the inputs of a step at an instant."""
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
            self._failure = None
            return None
        self._watch_link(now_ns)
        self._land()
        self._test_roll(y.value.tolist())
        inputs = self._inputs(now_ns, pose, y)
        route_notes = self.route.notes if self.route is not None and self._route_waits else ()
        state, commands = step(self._state, inputs, self.route, self._params)
        log = self._row(inputs, state, commands, now_ns)
        output = u_m(state)
        if not (is_finite(log) and is_finite(output)):
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

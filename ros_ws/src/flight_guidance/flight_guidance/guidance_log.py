# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write a step of guidance as a row of the log, and restore a step from such a row."""

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from flight_core.channels import POSE
from flight_core.parameters import require
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray
from flight_guidance import guidance_state
from flight_guidance.fence.fence import FenceAction
from flight_guidance.guidance_state import (
    TARGETS,
    Begin,
    GuidanceMode,
    GuidanceState,
    Inputs,
    Lateral,
    StepCommands,
    Target,
    Vertical,
)
from flight_guidance.notices import FAILED, LEARNED, LINK_AGE
from flight_guidance.reach import Authority
from flight_guidance.steering.path import Side

LIMITED = ("bank", "theta", "climb", "V", "slew")
STATE = ("phi", "theta", "alpha", "alpha_trim", "slip", "psi")
WIND = ("north", "east")


class GuidanceSample(NamedTuple):
    """A step as the log holds it: the inputs of the step, the state after it, and its commands."""

    inputs: Inputs
    state: GuidanceState
    commands: StepCommands
    route: int  # `guidance.digest` of the route
    link_age: float  # s since the last message of an operator; 0 if the link has no limit
    failed: int  # number of failed steps

    @property
    def pose_age(self) -> float:
        """Age of the pose, s."""
        return seconds(self.inputs.pose_age_ns)

    @property
    def given(self) -> int:
        """Number that encodes which channels have new commands, by `bits`."""
        return guidance_state.bits(self.inputs.commands)


def _tuple(*values: float) -> tuple[float, ...]:
    return values


class LogChannels(NamedTuple):
    """Channels of the log, with the attribute of a `GuidanceSample` whose numbers they hold."""

    names: Sequence[str]
    attribute: str
    kind: Callable[..., Any] = float  # builds the attribute from the numbers in the log

    def logged(self, sample: GuidanceSample) -> Sequence[float]:
        """Return the numbers of the channels for a sample."""
        value = attrgetter(self.attribute)(sample)
        return value if isinstance(value, tuple) else (value,)

    def restored(self, numbers: Mapping[str, float]) -> Any:
        """Rebuild the attribute from the numbers by channel."""
        return self.kind(*(numbers[name] for name in self.names))


def channels(outputs: Sequence[str]) -> tuple[LogChannels, ...]:
    """Return the groups of channels of the log, in the order of the log."""
    return (
        LogChannels(["mode"], "state.mode", GuidanceMode),
        LogChannels(["mode.lateral"], "state.lateral", Lateral),
        LogChannels(["mode.vertical"], "state.vertical", Vertical),
        LogChannels(["leg"], "state.leg", int),
        LogChannels(["route"], "route"),
        LogChannels(["xtrack"], "commands.xtrack"),
        LogChannels(["to_go"], "commands.to_go"),
        LogChannels(["joining"], "state.joining", Side),
        LogChannels(["track"], "commands.track"),
        LogChannels(["missed"], "commands.missed"),
        LogChannels(["fence.action"], "state.fence", FenceAction),
        LogChannels(["fence.clearance"], "commands.clearance"),
        LogChannels(["fence.predicted"], "commands.predicted"),
        LogChannels(["phi_c"], "commands.phi_c"),
        LogChannels(["theta_c"], "commands.theta_c"),
        LogChannels(["climb_c"], "state.climb_c"),
        LogChannels(["V_c"], "state.V_c"),
        *(LogChannels([f"limited.{name}"], f"commands.is_{name}_limited") for name in LIMITED),
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
    """Return the names of the channels of the log."""
    return tuple(chain.from_iterable(each.names for each in channels(outputs)))


def require_channels(logged: Collection[str]) -> None:
    """Check that a log of guidance has all channels in `names`. Raises ParameterError if not."""
    missing = [name for name in names(()) if name not in logged]
    require(not missing, "guidance", f"a log without {', '.join(missing)}", "all of its channels")


def row(sample: GuidanceSample, outputs: Sequence[str]) -> FloatArray:
    """Return a sample as a row of the log, in the order of `names`."""
    values = chain.from_iterable(each.logged(sample) for each in channels(outputs))
    return np.array([*values], dtype=np.float64)


def restored(
    t_ns: int, logged: Mapping[str, float], outputs: Sequence[str]
) -> tuple[Inputs, GuidanceState]:
    """Rebuild the inputs of a step and the state after it from a row of the log."""
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

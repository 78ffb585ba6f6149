# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check whether D of the controller agrees with the signs by which the inputs move the aircraft.

D is compared with the signs of a channel map, of an airframe and of a recorded flight.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from autopilot_bridge.map_rows import MOTIONS, UNITS, InputRow, OutputRow
from autopilot_bridge.params import ChannelMap
from flight_analysis.closed_loop.replay import recorded_parameters
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.parameters import ParameterError, require, require_channels
from flight_core.tape import Signal
from flight_core.vectors import FloatArray
from flight_design.identification.log_import import require_map_of_import
from flight_design.identification.response_identification import (
    MIN_RATIO,
    Response,
    identify_response,
)
from flight_log.tape_reader import read_run
from rise_di_controller.law.decomposition import signs

OPEN_LOOP = "excitation"  # the law that makes no use of y


class ChannelSign(NamedTuple):
    """The signs of a channel of the law in the channel map, the airframe and a recorded flight."""

    output: str
    input: str
    effect: float  # entry of Omega for this output and input through the map, SI
    D: int  # sign that follows from the airframe and the map
    D_controller: int
    measured: float | None  # Omega_ii from a recorded flight; NaN if the input never moves
    # response in the recorded flight in standard errors; the sign is certain from MIN_RATIO on
    ratio: float | None


class SignCheck(NamedTuple):
    """The result of a check of the signs."""

    channels: tuple[ChannelSign, ...]
    # sentences on channels whose D contradicts the map or the flight
    contradictions: tuple[str, ...]
    # sentences on the channels whose sign the recorded flight does not show
    uncertain: tuple[str, ...]
    seconds: float  # how many seconds of the recorded flight were used


def require_signs(channel_map: ChannelMap, scenario: Scenario) -> None:
    """Check that a channel map agrees with the D of a scenario's controller.

    The effects of the inputs on the outputs come from the scenario's airframe. Raises
    ParameterError if the map contradicts D.
    """
    contradictions = check_scenario(
        channel_map, scenario, load_airframe(scenario.aircraft.airframe), None
    ).contradictions
    if contradictions:
        raise ParameterError("; ".join(contradictions))


def check_scenario(
    channel_map: ChannelMap,
    scenario: Scenario,
    frame: Airframe,
    bag: Path | None,
    namespace: str | None = None,
) -> SignCheck:
    """Check a channel map against the controller of a scenario, for an airframe.

    If there is a recorded flight, the check includes it. `namespace` selects the aircraft if the
    log has several.
    """
    controller = scenario.controller
    outputs = controller.outputs
    inputs = controller.effectors
    for key, names, expected in (
        (f"map {channel_map.name}: outputs", tuple(channel_map.outputs), outputs),
        (f"map {channel_map.name}: inputs", tuple(channel_map.inputs), inputs),
        (f"airframe {frame.name}: outputs", frame.outputs, outputs),
        (f"airframe {frame.name}: inputs", tuple(frame.inputs), inputs),
    ):
        require_channels(key, names, expected, "the channels of the controller")
    Omega = frame.matrix_c() @ frame.matrix_b()
    in_map = Omega[
        np.ix_(
            _places(channel_map.outputs, frame.outputs), _places(channel_map.inputs, frame.inputs)
        )
    ]
    if controller.allocation is not None:
        require(
            bag is None,
            "bag",
            f"{bag} beside an allocation",
            "none: a flight does not show the effectors one by one",
        )
        effect = np.reshape(controller.allocation.effect, (len(outputs), -1))
        return check_effectors(channel_map, in_map, outputs, inputs, effect)
    response = (
        None if bag is None else recorded_response(bag, outputs, inputs, namespace, channel_map)
    )
    return check_signs(channel_map, in_map, outputs, inputs, controller.D, response)


def recorded_response(
    bag: Path,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
    namespace: str | None = None,
    channel_map: ChannelMap | None = None,
) -> Response:
    """Identify the response of the aircraft in a log, from the time in which u acted.

    This time is the whole flight, or with a bridge the time of its engagements. In a flight under a
    law, y_m excites the loop. Without y_m, and under the law `excitation`, u itself is the
    excitation. Raises ParameterError if the log has no y and u, or if its bridge was never engaged.
    It is also raised for a flight under guidance, because its y_m follows y, and for a log that was
    imported with other rows than `channel_map` has.
    """
    recorded = read_run(bag, namespace)
    tape = recorded.tape
    recorded.require("y", "u")
    if channel_map is not None:
        require_map_of_import(channel_map, recorded)
    engagements = recorded.engagements
    if engagements is None:
        require(
            "bridge/would_send" not in tape,
            str(bag),
            "no engagement of its bridge",
            "a flight with an engaged bridge",
        )
        spans = None
    else:
        require(
            bool(engagements),
            str(bag),
            "a bridge that was never engaged",
            "a flight with an engaged bridge",
        )
        spans = [
            (engagement.start_ns, engagement.stop_ns or int(tape["u"].stamp_ns[-1]))
            for engagement in engagements
        ]
    open_loop = (
        recorded.scenario is not None and recorded_parameters(recorded.scenario).law == OPEN_LOOP
    )
    if not open_loop:
        require(
            "guidance" not in tape,
            str(bag),
            "a flight under guidance, whose y_m follows y",
            "an experiment, or a flight without guidance",
        )
    excitation: Signal | None = tape["y_m"] if "y_m" in tape and not open_loop else None
    return identify_response(
        tape["y"], tape["u"], outputs, inputs, excitation=excitation, engaged=spans
    )


def check_signs(
    channel_map: ChannelMap,
    Omega: FloatArray,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
    D: tuple[int, ...],
    measured: Response | None = None,
) -> SignCheck:
    """Compare D of diag(output signs) Omega diag(input signs) with the controller's D.

    If there is a recorded flight, its signs are also compared. Omega = C B of the airframe, (m, m),
    has its channels in the map's order. `outputs`, `inputs` and `D` are in the controller's order.
    Raises ParameterError if the map does not fit the airframe, or if Omega has no D.
    """
    mapped = _omega_of_law(channel_map, Omega, outputs, inputs)
    D_mapped = [int(sign) for sign in signs(mapped)]
    sentences = [
        f"outputs.{name} of the map {channel_map.name} has the wrong sign:"
        f" {motion_as_channel_grows(channel_map.outputs[name])} as it grows"
        for name, sign in zip(channel_map.outputs, output_signs(channel_map), strict=True)
        if sign < 0
    ]
    channels = []
    uncertain = []
    for i, (output, name) in enumerate(zip(outputs, inputs, strict=True)):
        effect = None if measured is None else float(measured.Omega[i, i])
        ratio = None if measured is None else float(measured.sign_ratio[i])
        channels.append(
            ChannelSign(
                output=output,
                input=name,
                effect=float(mapped[i, i]),
                D=D_mapped[i],
                D_controller=D[i],
                measured=effect,
                ratio=ratio,
            )
        )
        if D_mapped[i] != D[i]:
            sentences.append(
                f"with the map {channel_map.name} D of {output} and {name} is {D_mapped[i]:+d}, "
                f"the controller has {D[i]:+d}:"
                f" a positive {name} means {motion_as_channel_grows(channel_map.inputs[name])}"
            )
        if measured is None or effect is None or ratio is None:
            continue
        if ratio < MIN_RATIO:
            reason = measured.reason_against_sign(i)
            uncertain.append(f"the recorded flight does not show the sign of {name}: {reason}")
        elif effect * mapped[i, i] < 0.0:
            sentences.append(
                f"the recorded flight has {output}_dot {'rise' if effect > 0.0 else 'fall'} "
                f"with {name}"
                f" ({effect:.3g}, {ratio:.0f} standard errors), the map {channel_map.name} has "
                "the opposite sign"
            )
    return SignCheck(
        tuple(channels),
        tuple(sentences),
        tuple(uncertain),
        0.0 if measured is None else measured.seconds,
    )


def check_effectors(
    channel_map: ChannelMap,
    Omega: FloatArray,
    outputs: tuple[str, ...],
    effectors: tuple[str, ...],
    effect: FloatArray,
) -> SignCheck:
    """Check the signs of the effectors against the `effect` of an allocation, (m, p).

    An effector is checked at the output that it moves most, relative to the largest effect on this
    output. `Omega`, (m, p), has a column for each effector, and is in the map's order as in
    `check_signs`. In the result, the D of an effector's channel is the sign of its effect.
    """
    mapped = _omega_of_law(channel_map, Omega, outputs, effectors)
    largest = np.argmax(np.abs(effect) / np.abs(effect).max(axis=1, keepdims=True), axis=0).tolist()
    channels = []
    sentences = []
    for j, (name, i) in enumerate(zip(effectors, largest, strict=True)):
        actual = int(np.sign(mapped[i, j]))
        expected = int(np.sign(effect[i, j]))
        channels.append(
            ChannelSign(
                output=outputs[i],
                input=name,
                effect=float(mapped[i, j]),
                D=actual,
                D_controller=expected,
                measured=None,
                ratio=None,
            )
        )
        if actual != expected:
            sentences.append(
                f"with the map {channel_map.name} {name} has {mapped[i, j]:+.3g} on "
                f"{outputs[i]}_dot, allocation.effect has"
                f" {effect[i, j]:+.3g}: a positive {name} means "
                f"{motion_as_channel_grows(channel_map.inputs[name])}"
            )
    return SignCheck(tuple(channels), tuple(sentences), (), 0.0)


def _omega_of_law(
    channel_map: ChannelMap, Omega: FloatArray, outputs: Sequence[str], inputs: Sequence[str]
) -> FloatArray:
    """Return Omega `through` the map, with the rows `outputs` and the columns `inputs`."""
    rows = _places(outputs, channel_map.outputs)
    columns = _places(inputs, channel_map.inputs)
    return through(channel_map, Omega)[np.ix_(rows, columns)]


def _places(names: Iterable[str], among: Iterable[str]) -> list[int]:
    return [list(among).index(name) for name in names]


def output_signs(channel_map: ChannelMap) -> FloatArray:
    """Return +1 for each output that has the sign convention of this project, else -1, (m,).

    By this convention q is positive nose up, p roll right, r nose right, V faster, and climb up.
    The result is in the map's order. For a channel with another name, the motion of its row says
    which quantity it is. Raises ParameterError if q, p, r or V has the motion of another channel,
    or if two channels have the same motion.
    """
    sign_by_motion: dict[str, int] = {}
    for name, row in channel_map.outputs.items():
        moved, sign = row.motion
        key = f"map {channel_map.name}: outputs.{name}.positive"
        require(
            name not in UNITS or moved == name,
            key,
            f"{row.positive!r}",
            f"a motion to which {name} responds",
        )
        require(
            moved not in sign_by_motion,
            key,
            f"{row.positive!r}, the motion of another output too",
            "a motion of its own",
        )
        sign_by_motion[moved] = sign
    return np.array(list(sign_by_motion.values()), dtype=np.float64)


def input_signs(channel_map: ChannelMap, Omega: FloatArray) -> FloatArray:
    """Return +1 for each input whose effect has the sign of Omega = C B, and -1 for others, (m,).

    Omega, (m, m), has rows and columns in the map's order. Raises ParameterError if an input has no
    effect on its output.
    """
    flips = []
    for j, (name, row) in enumerate(channel_map.inputs.items()):
        moved, sign = row.motion
        key = f"map {channel_map.name}: inputs.{name}.positive"
        outputs = {measured.motion[0]: output for output, measured in channel_map.outputs.items()}
        expected = f"a motion to which one of {', '.join(outputs.values())} responds"
        require(moved in outputs, key, f"{row.positive!r}", expected)
        effect = Omega[list(outputs).index(moved), j]
        expected = f"a motion by {name}: in the airframe {outputs[moved]} does not respond"
        require(effect != 0.0, key, f"{row.positive!r}", expected)
        flips.append(sign * np.sign(effect))
    return np.array(flips)


def through(channel_map: ChannelMap, Omega: FloatArray) -> FloatArray:
    """Return Omega between the channels of the map, (m, m).

    The result is diag(output signs) Omega diag(input signs).
    """
    return output_signs(channel_map)[:, None] * Omega * input_signs(channel_map, Omega)


def motion_as_channel_grows(row: OutputRow | InputRow) -> str:
    """Return how the aircraft moves as the channel grows.

    The channel grows with the raw value or against it, as its row in the channel map says.
    """
    motions = list(MOTIONS)  # each motion stands next to its opposite
    return row.positive if row.sign > 0 else motions[motions.index(row.positive) ^ 1]

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find gains for an aircraft behind a bridge from a channel map and an experiment in flight.

A channel map says which field of an autopilot's topics is which channel. There is no model of the
aircraft. The first result is the scenario of the experiment. The second result is a scenario that
flies the aircraft with the gains that were found.

The experiment excites the inputs in turn, open loop. `identify_response` estimates Omega, lags and
delays from its log. The airframe in both scenarios is y_dot = Omega u, because nothing else is
known about the aircraft.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import yaml

from aircraft_sim.airframes.airframe import Airframe
from autopilot_bridge.channel_map import to_channel
from autopilot_bridge.map_rows import UNITS
from autopilot_bridge.params import ChannelMap
from control_laws.excitation import ExcitationConfig
from flight_core.files import dump_yaml
from flight_core.outcome import Refusal, joined
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.units import GRAVITY
from flight_core.vectors import FloatArray
from flight_design.gains.first_scenario import RISE, FirstCommands, scenario_text
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.open_loop_fit import ChannelModel, fit_channel
from flight_design.identification.response_identification import MIN_RATIO, Response, Spans
from flight_design.identification.sign_check import motion_as_channel_grows, output_signs
from flight_log.engagements import Engagement
from rise_di_controller.params import ControllerConfig

RATE = 100.0  # Hz, default rate of the law and the reference model

AMPLITUDE = 0.2  # default amplitude, as a share of the smaller limit of an input


class Excitation(NamedTuple):
    """The excitation of an input by doublets and a multisine, as in `ExcitationConfig`."""

    width: float = 0.25  # s
    period: float = 6.0  # s
    lowest: float = 0.3  # Hz
    highest: float = 8.0  # Hz


EXCITATIONS: Mapping[str, Excitation] = {
    # Engines respond slowly.
    "V": Excitation(width=1.0, period=12.0, lowest=0.1, highest=0.8),
    # The climb is an integral: slow commands move it more than its noise.
    "climb": Excitation(width=0.8, period=10.0, lowest=0.1, highest=1.5),
}
"""Excitations by the motion that the input causes. All other inputs cause a rotation, and have the
excitation `Excitation()`."""
PAUSE = 1.5  # s, pause between the excitations of two inputs

# Ratio of the controller's age limit to the largest age limit of the bridge. It is above 1, so that
# the failsafe of the bridge acts first.
AGE = 1.5
HOLD = 0.5  # s, `hold` of the controller
RAMP = 2.0  # s, `ramp` of the controller
WAIT = 30.0  # s before the first command of the flight; in this time the user engages


def channel_pairs(channel_map: ChannelMap) -> tuple[ChannelPairing, FloatArray]:
    """Pair each output with the input that drives it, and return the signs of the effects, (m,).

    An output and an input belong together if the map gives them the same motion. Raises
    ParameterError if two inputs drive the same output, if an output has no input, or if an output
    of the map lacks the sign convention of this project, as `output_signs` says.
    """
    drivers: dict[str, tuple[str, int]] = {}
    for name, row in channel_map.inputs.items():
        output, sign = row.motion
        driver = drivers.setdefault(output, (name, sign))
        both = f"{driver[0]} and {name} both for {output}"
        require(driver[0] == name, f"map {channel_map.name}: inputs", both, "one of them")
    motion_by_output = motions(channel_map)
    for (name, motion), sign in zip(
        motion_by_output.items(), output_signs(channel_map), strict=True
    ):
        require(
            motion in drivers,
            f"map {channel_map.name}: inputs",
            f"none that moves {name}",
            "one input for each output",
        )
        require(
            sign > 0.0,
            f"map {channel_map.name}: outputs.{name}",
            "the opposite sign",
            "the stack's signs",
        )
    inputs, signs = zip(*(drivers[motion] for motion in motion_by_output.values()), strict=True)
    return ChannelPairing(tuple(motion_by_output), inputs), np.array(signs, dtype=np.float64)


def motions(channel_map: ChannelMap) -> dict[str, str]:
    """Return the motion of each output of a channel map: a key of UNITS, such as q, p, r or V."""
    return {name: row.motion[0] for name, row in channel_map.outputs.items()}


def has_airspeed(channel_map: ChannelMap) -> bool:
    """Return whether a channel map has an airspeed. An aircraft without one hovers."""
    return "V" in motions(channel_map).values()


def require_envelope(channel_map: ChannelMap) -> None:
    """Check that a channel map limits the speeds and the attitude that it measures.

    These limits are the only guard of an experiment. Raises ParameterError if a limit is missing.
    """
    needed: list[str] = [name for name in ("phi", "theta") if name in channel_map.pose]
    needed += [name for name, motion in motions(channel_map).items() if UNITS[motion] == "m/s"]
    missing = [name for name in needed if name not in channel_map.envelope]
    limits = ", ".join(needed)
    unlimited = f"none of {', '.join(missing)}"
    require(
        not missing,
        f"map {channel_map.name}: envelope",
        unlimited,
        f"limits of {limits}: an experiment is open loop",
    )


class Experiment(NamedTuple):
    """The files of an experiment that excites the inputs of an aircraft."""

    airframe: str  # text of the airframe file, in which only the signs of the effects are known
    scenario: str  # text of the scenario file
    controller: ExcitationConfig


def experiment(
    channel_map: ChannelMap,
    speed: float | None,
    amplitude: float,
    airframe_file: str,
    wait: float = WAIT,
) -> Experiment:
    """Plan an experiment that excites the inputs of a channel map.

    Each input is excited by `amplitude`, a fraction of the smaller of its two limits. `speed` is
    the airspeed in trim, m/s, or None in hover. The scenario refers to its airframe by the path
    `airframe_file`. The experiment lasts for `wait`, s, and for the time of the excitation.
    """
    pairing, sign = channel_pairs(channel_map)
    rows = [channel_map.inputs[name] for name in pairing.inputs]
    m = len(rows)
    excitations = [
        EXCITATIONS.get(motion, Excitation()) for motion in motions(channel_map).values()
    ]
    values_by_key = zip(Excitation._fields, zip(*excitations, strict=True), strict=True)
    controller = ExcitationConfig.validate_mapping(
        controller_values(channel_map, pairing)
        | {
            "law": "excitation",
            "D": [int(value) for value in sign],
            "input_scale": [1.0] * m,
            "lag": [0.0] * m,
            "delay": 0.0,
            "amplitude": [amplitude * min(-row.lower, row.upper) for row in rows],
            "pause": PAUSE,
        }
        | {key: list(values) for key, values in values_by_key},
        "controller",
    )
    second_order = {"natural_frequency": [1.0] * m, "damping": [1.0] * m}
    reference = {"rate": RATE, "outputs": list(pairing.outputs), "second_order": second_order}
    still = FirstCommands(reference | {"rise": RISE}, wait + controller.duration)
    heading = (
        f"Experiment on the aircraft behind the map {channel_map.name}: each input is "
        "excited by itself, open loop."
    )
    return Experiment(
        airframe_yaml(
            channel_map,
            pairing,
            signs_alone(sign),
            speed,
            "signs of the channel map; sizes not known",
        ),
        scenario_text([heading], bridge_sections(airframe_file, still, controller)),
        controller,
    )


# Share of the planned duration from which an engagement counts as complete. The reports of its
# beginning and end are late by less than the rest.
WHOLE = 0.95


def reason_against_experiment(engagements: Sequence[Engagement], duration: float) -> Refusal | None:
    """Say when and why the bridge released the aircraft before an experiment ended.

    Returns None if the bridge released the aircraft at the end. `engagements` are the engagements
    in the log, and `duration` is the planned duration of the experiment, s.
    """
    lengths = [
        math.inf if part.stop_ns is None else (part.stop_ns - part.start_ns) / NANOSECONDS
        for part in engagements
    ]
    length = max(lengths)
    if length > WHOLE * duration:
        return None
    return Refusal(
        f"the bridge released after {length:.0f} of {duration:.0f} s: "
        f"{engagements[lengths.index(length)].reason}"
    )


def channel_models(
    channel_map: ChannelMap, tape: Tape, spans: Spans, speed: float | None
) -> list[ChannelModel | None]:
    """Identify the channels of a map from an experiment's log, within the `spans` of engagement.

    A channel without a model is None. `speed` is the airspeed in trim, m/s, or None in hover. V
    gets a model only if a climb is measured. Thrust also excites the phugoid, and without the climb
    the phugoid would be taken for the response to thrust. The model of a climb in hover is of first
    order. Source: G. D. Padfield, "Helicopter Flight Dynamics", 2007, 4.3 (heave).
    """
    pairing, sign = channel_pairs(channel_map)
    y = tape["y"].within(spans)
    u = tape["u"].within(spans)
    gravity = None
    if "pose" in tape and speed is not None:
        gravity = gravity_along_path(tape["pose"], speed)
    motion_by_output = motions(channel_map)
    models: list[ChannelModel | None] = []
    for output, name, direction in zip(pairing.outputs, pairing.inputs, sign.tolist(), strict=True):
        motion = motion_by_output[output]
        # If gravity along the path is not known, V shows the phugoid instead of the thrust.
        if motion == "V" and gravity is None:
            models.append(None)
            continue
        along_path = gravity if motion == "V" else None
        is_first_order = motion == "climb"
        models.append(
            fit_channel(y, u, output, name, direction, along_path, first_order=is_first_order)
        )
    return models


def gravity_along_path(pose: Signal, speed: float) -> Signal | None:
    """Return the part of V_dot that gravity causes, -g climb / speed, m/s^2, at the pose's stamps.

    Returns None if the pose has no climb.
    """
    if "climb" not in pose.names:
        return None
    is_finite = np.isfinite(pose["climb"])
    if not is_finite.any():
        return None
    gravity = -GRAVITY / speed * pose["climb"][is_finite, None]
    return Signal(pose.stamp_ns[is_finite], ("V",), gravity)


class IdentifiedChannels(NamedTuple):
    """Identified properties of m channels in which input i drives output i, in SI."""

    Omega: FloatArray  # (m, m)
    Omega_deviation: FloatArray  # (m,) standard deviations of the diagonal of Omega
    lag: FloatArray  # (m,) s
    delay: FloatArray  # (m,) s
    damping: FloatArray  # (m,) 1/s; 0 if none is known
    stiffness: FloatArray  # (m,) 1/s^2
    zero: FloatArray  # (m,) zero of the response from u to y, 1/s
    # (m,) rms of the output error divided by the rms of y; NaN if only the step response is known
    misfit: FloatArray


def join(
    channel_map: ChannelMap, response: Response, models: Sequence[ChannelModel | None]
) -> IdentifiedChannels:
    """Join the models of all channels; for a channel without a model, use its step response.

    Raises ParameterError if a channel has neither a usable model nor a certain step response. It is
    also raised if the sign of an effect contradicts the channel map.
    """
    pairing, sign = channel_pairs(channel_map)
    Omega = np.where(np.isfinite(response.Omega), response.Omega, 0.0)
    m = len(sign)
    Omega = np.where(
        np.abs(Omega) > MIN_RATIO * np.nan_to_num(response.Omega_deviation, nan=np.inf), Omega, 0.0
    )
    deviation = np.diag(response.Omega_deviation).copy()
    lag = response.lag.copy()
    delay = response.delay.copy()
    damping = np.zeros(m)
    stiffness = np.zeros(m)
    zero = np.zeros(m)
    misfit = np.full(m, np.nan)
    refusals = []
    for i, (name, output, model) in enumerate(
        zip(pairing.inputs, pairing.outputs, models, strict=True)
    ):
        if model is not None and model.is_usable:
            Omega[i, i] = model.Omega
            deviation[i] = np.sqrt(model.covariance[2, 2])
            lag[i] = model.lag
            delay[i] = model.delay
            damping[i] = model.damping
            stiffness[i] = model.stiffness
            zero[i] = model.slow / model.Omega
            misfit[i] = model.misfit
        elif refusal := response.refusal[i] or response.reason_against_sign(i):
            refusals.append(refusal)
            continue
        else:
            Omega[i, i] = response.Omega[i, i]
        opposite = f"{output}_dot that {'falls' if Omega[i, i] < 0.0 else 'rises'} with {name}"
        require(
            Omega[i, i] * sign[i] > 0.0,
            f"map {channel_map.name}: inputs.{name}",
            opposite,
            "the opposite: change `sign`",
        )
    if refusals:
        raise ParameterError(str(joined(refusals)))
    return IdentifiedChannels(
        Omega=Omega,
        Omega_deviation=deviation,
        lag=lag,
        delay=delay,
        damping=damping,
        stiffness=stiffness,
        zero=zero,
        misfit=misfit,
    )


def over_link(channels: IdentifiedChannels, link_delay: float) -> IdentifiedChannels:
    """Add the delay of the link, s, to channels that were identified from a log of the autopilot.

    The autopilot wrote the log on board, but the law flies over the link. So the delay of the law's
    loop is longer than the delay in the log.
    """
    return channels._replace(delay=channels.delay + link_delay)


def measured_trims(
    channel_map: ChannelMap, would_send: Signal, engaged_ns: int
) -> dict[str, float]:
    """Return the command in trim of each input, SI, by the input's name.

    These are the commands that the bridge sent in the pause after an engagement, while u was 0. The
    pause begins at `engaged_ns`.
    """
    stamps = (would_send.stamp_ns - engaged_ns) / NANOSECONDS
    still = (stamps > 0.2 * PAUSE) & (stamps < 0.8 * PAUSE)
    require(
        bool(still.any()),
        "bridge/would_send",
        "no sample after the engagement",
        "a log of the experiment",
    )
    rows = channel_map.inputs.items()
    return {
        name: to_channel(
            float(np.median(would_send[f"{row.message}.{row.field}"][still])), row.conversion
        )
        for name, row in rows
    }


def within_range(
    channel_map: ChannelMap, trims: Mapping[str, float]
) -> tuple[ChannelMap, list[str]]:
    """Narrow the limits of u in a channel map so that each field stays within its range.

    The value of a field is trim plus u. Returns the map, and a sentence for each limit that was
    narrowed. Raises ParameterError if a trim is at a stop.
    """
    values = channel_map.model_dump(exclude_unset=True)
    sentences = []
    for name, trim in trims.items():
        row = channel_map.inputs[name]
        low, high = sorted(to_channel(raw, row.conversion) for raw in row.range)
        key = f"map {channel_map.name}: inputs.{name}"
        way_on = "fly slower, or trim the aircraft otherwise"
        require(
            low < trim < high,
            key,
            f"a trim of {trim:.4g} at its stop",
            f"room on both sides: {way_on}",
        )
        for side, limit, room in (
            ("lower", row.lower, low - trim),
            ("upper", row.upper, high - trim),
        ):
            if abs(limit) > abs(room):
                # stay within the range although the trim is rounded
                values["inputs"][name][side] = float(f"{room * (1.0 - 1e-4):.5g}")
                narrower = (
                    f"{name}: its trim is {trim:.3g}, so that the {side} limit is "
                    f"{room:.3g} in place of {limit:.3g}"
                )
                sentences.append(f"{narrower}: {way_on}")
    return ChannelMap.validate_mapping(values, f"map {channel_map.name}"), sentences


def map_text(channel_map: ChannelMap, trims: Mapping[str, float], source: str) -> str:
    """Write a channel map with the measured trims as text.

    If the map captures a trim at the engagement, the bridge will measure this trim again at every
    engagement.
    """
    values = channel_map.model_dump(exclude_unset=True)
    values["source"] = f"{values['source']}; trims measured in {source}"
    for name, trim in trims.items():
        values["inputs"][name]["trim"] = float(f"{trim:.5g}")
    ChannelMap.validate_mapping(values, f"map {channel_map.name}")
    return yaml.dump(_plain(values), Dumper=_WholeRows, sort_keys=False, width=128)


class _WholeRows(yaml.SafeDumper):
    """A YAML dumper that writes rows in full, without anchors and aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def controller_values(channel_map: ChannelMap, pairing: ChannelPairing) -> dict[str, Any]:
    """Return the parameters of the controller that the channel map determines."""
    rows = [channel_map.inputs[name] for name in pairing.inputs]
    limits = {"lower": [row.lower for row in rows], "upper": [row.upper for row in rows]}
    common = {"rate": RATE, "outputs": list(pairing.outputs), "inputs": list(pairing.inputs)}
    max_age = AGE * max(row.max_age for row in channel_map.outputs.values())
    return common | limits | {"max_age": max_age, "hold": HOLD, "ramp": RAMP}


def _rounded(row: FloatArray) -> list[float]:
    """Round the numbers in a row to four digits."""
    return [float(f"{value:.4g}") for value in row]


def airframe_yaml(
    channel_map: ChannelMap,
    pairing: ChannelPairing,
    channels: IdentifiedChannels,
    speed: float | None,
    source: str,
) -> str:
    """Write the airframe of identified channels as text, in the units of the map's channels.

        y_i_dot = -(damping_i - zero_i) y_i + (damping_i zero_i - stiffness_i - zero_i^2) z_i
                  + sum_j Omega_ij u_j
        z_i_dot = y_i - zero_i z_i

    The hidden state z_i has the dimension of y_i dt. It exists only if stiffness_i or zero_i is not
    0.
    """
    m = len(pairing.outputs)
    second = [i for i in range(m) if channels.stiffness[i] or channels.zero[i]]
    A = np.zeros((m + len(second), m + len(second)))
    for i in range(m):
        A[i, i] = channels.zero[i] - channels.damping[i]
    for place, i in enumerate(second, m):
        A[i, place] = (
            channels.damping[i] * channels.zero[i] - channels.stiffness[i] - channels.zero[i] ** 2
        )
        A[place, i] = 1.0
        A[place, place] = -channels.zero[i]
    B = np.vstack([channels.Omega, np.zeros((len(second), m))])
    states = {name: UNITS[motion] for name, motion in motions(channel_map).items()}
    states |= {f"{pairing.outputs[i]}_integral": "1" for i in second}
    values = {
        "name": f"{channel_map.name}_aircraft",
        "source": source,
        **({} if speed is None else {"speed": float(speed)}),
        "states": states,
        "inputs": {
            name: {"unit": "1", "positive": motion_as_channel_grows(channel_map.inputs[name])}
            for name in pairing.inputs
        },
        "outputs": list(pairing.outputs),
        "A": [_rounded(row) for row in A],
        "B": [_rounded(row) for row in B],
    }
    Airframe.validate_mapping(values, "airframe")
    return dump_yaml(values)


def signs_alone(sign: FloatArray) -> IdentifiedChannels:
    """Return channels that are known only by the signs of their effects."""
    none = 0.0 * sign
    return IdentifiedChannels(
        Omega=np.diag(sign),
        Omega_deviation=none + np.nan,
        lag=none,
        delay=none,
        damping=none,
        stiffness=none,
        zero=none,
        misfit=none + np.nan,
    )


def bridge_sections(
    airframe_file: str, commands: FirstCommands, controller: ControllerConfig
) -> dict[str, Mapping[str, Any]]:
    """Return the sections of a scenario for the aircraft behind a bridge."""
    return {
        "flight": {"duration": float(commands.duration)},
        "aircraft": {"airframe": airframe_file, "rate": RATE, "step": 1.0 / RATE},
        "reference_model": commands.reference,
        "controller": _plain(controller.model_dump(exclude_defaults=True)),
        "recorder": {"rate": 100.0},
    }


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replace tuples by lists and round numbers to six digits, as a YAML file shows them."""

    def plain(value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return [plain(entry) for entry in value]
        if isinstance(value, Mapping):
            return {key: plain(entry) for key, entry in value.items()}
        return float(f"{value:.6g}") if isinstance(value, float) else value

    return {key: plain(value) for key, value in values.items() if value is not None}

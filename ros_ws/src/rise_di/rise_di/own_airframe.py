# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write an airframe of the user, with a scenario that flies it.

`rise-di airframes --write` writes the same two files.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.airframes.airframe_import import Named, import_airframe
from aircraft_sim.atmosphere.disturbance import AIR_STATE
from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.scenario import Scenario, parse_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.arguments import FilePath, as_path
from flight_core.files import write_file, writing
from flight_core.outcome import End, Refusal
from flight_core.parameters import require
from flight_core.tape import Tape
from flight_core.text import sentences
from flight_design.gains import first_flight, gain_yaml
from flight_design.gains.effectors import lags_by_input
from flight_design.gains.first_scenario import LICENCE
from flight_design.gains.gain_design import select_gains

# factors on the commands, which are tried in this order until u stays clear of the end stops
SIZES = (1.0, 0.5, 0.25, 0.125)
CLEAR = 0.9  # largest fraction of an end stop that u may reach
# the angle that a gust on an axis causes, which is the speed of the gust divided by V0
ANGLE_OF_GUST = {"lateral": "sideslip", "vertical": "angle of attack"}
SAMPLES = 20  # number of uncertain airframes for the bounds of the theorem


@dataclass(frozen=True, kw_only=True)
class NewAirframe:
    """An airframe and its scenario, as written to files.

    Attributes:
        airframe_file: Path of the airframe file.
        scenario_file: Path of the scenario file.
        airframe: The airframe.
        note: Sentences on the source of the airframe, and on the pairs of inputs and outputs if
            these are not in order.
        shortfall: What is wrong with the first flight, as in the first line of the scenario file.
            It is None if the flight ends as planned, clear of the end stops.
    """

    airframe_file: Path
    scenario_file: Path
    airframe: Airframe
    note: str
    shortfall: Refusal | None


def new_airframe(
    source: Any,
    *,
    folder: FilePath = ".",
    name: str = "",
    speed: str | float | None = None,
    states: Named = (),
    inputs: Named = (),
    outputs: str | Sequence[str] = (),
    thrust: bool = False,
    text: str = "",
    lag: ArrayLike | None = None,
    replace: bool = False,
    **body: str | float,
) -> NewAirframe:
    """Write the airframe NAME.yaml, and a scenario for it, NAME_flight.yaml.

    The gains of the scenario are selected for the airframe, and the scenario is flown once.

    Args:
        source: A state space of python-control or SciPy, or the path of a MATLAB file (.mat), of an
            airframe file (.yaml), or of a text file that AVL has written (system matrix, or
            stability derivatives) or XFLR5 (state matrices).
        folder: Folder of both files.
        name: Name of the airframe. If empty, it is the name of the file.
        speed: Trim speed, as a number in m/s or with a unit, such as "176 ft/s".
        states: Names of the states in the order of A, with units, as in "u: ft/s, w: ft/s, q:
            rad/s, theta: rad".
        inputs: Names of the inputs in the order of B, with units and effects, as in "elevator: rad
            nose down, thrust: 1 more thrust".
        outputs: Outputs, at most as many as inputs. Each is the name of a state, or of a row of C
            with its unit ("V: ft/s"), or a sum of states ("V = 0.987 u + 0.163 w"). If empty, they
            are q, V, p and r, paired with elevator, thrust, aileron and rudder.
        thrust: Whether to add an input, a thrust along the flight path, in units of the weight.
            This is for a model without a thrust.
        text: Text on the source of the numbers.
        lag: Lags of the actuators in s, one for all inputs or one for each. If None, it is 0.05 s
            for a control surface and 0.3 s for an engine.
        replace: Whether existing files with these names may be replaced.
        body: mass, Ixx, Iyy, Izz, Ixz and density, which the derivatives of AVL need, and AVL's
            unit of length, `length`.

    Returns:
        The paths of the files, the airframe, a note on the source, and the shortfall of the flight.

    Raises:
        ParameterError: The model contradicts physics, or a file cannot be written.

    Examples:
        >>> A = [[-0.045, 0.036, 0.0, -9.81], [-0.369, -2.02, 53.64, 0.0]]
        >>> A += [[0.0062, -0.130, -2.948, 0.0], [0.0, 0.0, 1.0, 0.0]]
        >>> B = [[0.0], [-8.586], [-11.044], [0.0]]
        >>> from scipy.signal import StateSpace
        >>> new = rise_di.new_airframe(
        ...     StateSpace(A, B, np.eye(4), np.zeros((4, 1))),
        ...     name="navion",
        ...     speed=53.64,
        ...     states="V: m/s, w: m/s, q: rad/s, theta: rad",
        ...     inputs="elevator: rad nose down",
        ...     outputs="q, V",
        ...     thrust=True,
        ... )
        >>> new.scenario_file.name
        'navion_flight.yaml'
    """
    airframe, note = import_airframe(
        source,
        name=name,
        speed=speed,
        states=states,
        inputs=inputs,
        outputs=outputs,
        thrust=thrust,
        text=text,
        **body,
    )
    is_file_name = Path(airframe.name).name == airframe.name
    require(
        is_file_name, "name", repr(airframe.name), "the name of a file in the folder, without a /"
    )
    place = as_path(folder, "folder", "the path of a folder")
    files = place / f"{airframe.name}.yaml", place / f"{airframe.name}_flight.yaml"
    source_is_target = (
        isinstance(source, str | Path) and Path(source).absolute() == files[0].absolute()
    )
    _require_free(files[source_is_target:], replace=replace)
    if lag is None:
        lags = first_flight.default_lags(airframe)
    else:
        lags = tuple(lags_by_input(lag, airframe).values())
    text_of_airframe = LICENCE + as_yaml(airframe)
    with tempfile.TemporaryDirectory() as trial:
        (Path(trial) / files[0].name).write_text(text_of_airframe, encoding="utf-8")
        scenario, shortfall = _flying(airframe, Path(trial) / files[0].name, files, lags)
    with writing("folder", place):
        place.mkdir(parents=True, exist_ok=True)
        if not source_is_target:
            write_file(files[0], text_of_airframe)
        write_file(files[1], scenario)
    note = sentences(note, _pairing_sentence(airframe))
    return NewAirframe(
        airframe_file=files[0],
        scenario_file=files[1],
        airframe=airframe,
        note=note,
        shortfall=shortfall,
    )


def _require_free(files: Sequence[Path], *, replace: bool) -> None:
    """Raise ParameterError if a file exists already, unless it may be replaced."""
    for path in files:
        require(
            replace or not path.exists(),
            "folder",
            f"{path}, which exists",
            "a new file, or replace",
        )


def _pairing_sentence(airframe: Airframe) -> str | None:
    """Write a sentence on how inputs and outputs are paired.

    Returns None if they are in the same order.
    """
    places = first_flight.pairing(airframe)
    if len(airframe.inputs) != len(airframe.outputs) or places == tuple(range(len(places))):
        return None
    inputs = list(airframe.inputs)
    pairs = (f"{name} by {inputs[j]}" for name, j in zip(airframe.outputs, places, strict=True))
    return f"paired by C B: {', '.join(pairs)}"


def _flying(
    airframe: Airframe, trial: Path, files: tuple[Path, Path], lag: Sequence[float]
) -> tuple[str, Refusal | None]:
    """Return the text of a scenario with commands so small that its flight ends as planned.

    The gains of the scenario are selected for these commands. The flight must stay clear of the end
    stops. If there is no such flight, the scenario has the smallest commands, and the second result
    says what is wrong with the flight. `trial` is the file of the airframe for the trial flights.
    `files` are the paths of airframe and scenario that the text names.
    """
    shortfall = None
    scenario = ""
    controller = first_flight.placeholder(airframe, lag)
    for size in SIZES:

        def text(
            path: Path, section: str, size: float = size, shortfall: Refusal | None = None
        ) -> str:
            return first_flight.first_flight(
                airframe, str(path), str(files[1]), section, lag, size, shortfall
            )

        selection = select_gains(trial, _parsed(text(trial, controller), files[1]), samples=SAMPLES)
        section = gain_yaml.selection_yaml(selection)
        flight = _parsed(text(trial, section), files[1])
        tape = simulate(flight)
        shares = _stop_shares(flight, tape)
        scenario = text(files[0], section)
        if tape.outcome.end is End.COMPLETED and max(shares.values()) <= CLEAR:
            return scenario, None
        hardest = max(shares, key=lambda key: shares[key])
        if size == SIZES[-1]:
            shortfall = _shortfall(flight, tape, hardest)
            scenario = text(files[0], section, shortfall=shortfall)
    return scenario, shortfall


def _stop_shares(flight: Scenario, tape: Tape) -> dict[str, float]:
    """Return the largest command of each input as a fraction of its end stop."""
    stops = zip(flight.aircraft.channels().inputs, flight.aircraft.actuators.upper, strict=True)
    return {key: float(abs(tape["u"][key]).max()) / stop for key, stop in stops}


def _shortfall(flight: Scenario, tape: Tape, hardest: str) -> Refusal:
    """Return what is wrong with the flight of a scenario, as a sentence.

    The sentence names the input `hardest`, which comes closest to its end stop, and says whether
    the commands or the gusts drive it there. It also names the state or gust that requires the most
    of this input, and says how large this state or gust gets. The input that keeps y constant is u
    = -Omega^+ C (A x + f), where f includes the gusts. Each state and each gust has a term in this
    sum, and the one with the largest term is named.
    """
    airframe = flight.aircraft.load()[0]
    calm = simulate(flight.vary(aircraft={"gusts": {}}))
    cause = "the commands" if _stop_shares(flight, calm)[hardest] > CLEAR else "the gusts"
    C = airframe.matrix_c()
    inverse = np.linalg.pinv(C @ airframe.matrix_b())[list(airframe.inputs).index(hardest)] @ C
    truth = tape["truth"]
    gains = dict(zip(airframe.states, np.abs(inverse @ airframe.matrix_a()).tolist(), strict=True))
    largest = {name: float(np.abs(truth[f"x.{name}"]).max()) for name in gains}
    units = dict(airframe.states)
    for axis, state in AIR_STATE.items():
        if axis in flight.aircraft.gusts:
            name = ANGLE_OF_GUST.get(axis, state)
            speed = airframe.speed if axis in ANGLE_OF_GUST else 1.0
            gains[name] = float(abs(inverse @ airframe.gust_direction(axis))) * speed
            largest[name] = float(np.abs(truth[f"gust.{axis}"]).max()) / speed
            units[name] = "rad" if axis in ANGLE_OF_GUST else "m/s"
    most = max(gains, key=lambda name: gains[name] * largest[name])
    input_unit = airframe.inputs[hardest].unit
    each = f"1 {units[most]} of {most} asks {gains[most]:.3g} {input_unit} of {hardest}"
    size = f"{largest[most]:.2g} {units[most]}"
    if {units[most], input_unit} == {"rad"}:
        each = f"a degree of {most} asks {gains[most]:.3g} degrees of {hardest}"
        size = f"{np.degrees(largest[most]):.2g} degrees"
    end = "" if tape.outcome.end is End.COMPLETED else f", and ends: {tape.outcome}"
    percent = 100.0 * _stop_shares(flight, tape)[hardest]
    return Refusal(
        f"The first flight has {hardest} at {percent:.0f} % of its end "
        f"stop{end}: {cause} ask for it; {each}, and {most} reaches {size}."
    )


def _parsed(text: str, path: Path) -> Scenario:
    return parse_scenario(text.encode(), path)

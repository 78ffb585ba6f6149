# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Load airframe files, which hold published matrices with their units and signs.

The matrices are converted to SI here and nowhere else.
"""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframes import identities
from aircraft_sim.atmosphere.disturbance import AIR_STATE, AXES, ROTARY
from aircraft_sim.plant.dynamics import EulerKinematics
from flight_core.arguments import FilePath
from flight_core.fields import Field
from flight_core.files import find_file, names_in, parse_yaml, read_file
from flight_core.parameters import (
    Config,
    Name,
    Names,
    NonNegative,
    Number,
    Numbers,
    Positive,
    require,
)
from flight_core.units import ANGLE, GRAVITY, in_si, quantity, si_per_unit
from flight_core.vectors import FloatArray, selection_matrix

EXPECTED = "an airframe file"

LIBRARY = Path(str(files("aircraft_sim.airframes")))

Unit = str  # a unit of `flight_core.units.quantity`
Matrix = Annotated[tuple[Numbers, ...], Field(min_length=1)]


AIRPLANE_STATES = {
    "V": "m/s",
    "alpha": "rad",
    "q": "rad/s",
    "theta": "rad",
    "beta": "rad",
    "p": "rad/s",
    "r": "rad/s",
    "phi": "rad",
}
"""States, with units, of an airplane whose model is a sketch or a linearisation."""


class Input(Config):
    """An input of an airframe: the unit of its column of B, and the effect of a positive value.

    For an engine or a rotor, `no_thrust` can state the value at which it gives no thrust.
    """

    unit: Unit = Field(description="unit of this column of B")
    positive: str = Field(description="effect of a positive value")
    no_thrust: Number | None = Field(
        default=None,
        description="value at which the input gives no thrust, as a deviation from trim; if "
        "absent, it is 0 for an angle and unknown for any other input",
    )


class Gravity(Config):
    """A term of gravity in the equations of motion: f_into += gain sin(angle)."""

    into: str = Field(description="state to whose derivative it adds")
    angle: str = Field(description="angle, a state")
    gain: Number = Field(description="gain, SI")


class Product(Config):
    """A term of inertial coupling in the equations of motion: f_into += gain * product.

    The product is the product of two states.
    """

    into: str = Field(description="state to whose derivative it adds")
    product: Names = Field(description="two states")
    gain: Number = Field(description="gain, SI")


class Airframe(Config):
    """An airframe in the units of its file; `matrix_a` to `products` convert it to SI arrays.

    Args:
        values: Values by key, as in an airframe file.

    Raises:
        ParameterError: A value is invalid, or the airframe contradicts physics.

    Examples:
        >>> airframe = rise_di.load_airframe("osprey")
        >>> airframe.matrix_b().shape, airframe.index("q")
        ((8, 4), 2)
    """

    name: str
    source: str = Field(description="source of the figures")
    speed: NonNegative = Field(
        default=0.0, description="trim speed V0, m/s, or with a unit; 0 in hover"
    )
    span: Positive | None = Field(
        default=None, description="wing span b, m, for rotary gusts; none if unknown"
    )
    states: dict[Name, Unit] = Field(description="units by state")
    inputs: dict[Name, Input] = Field(description="unit and sign by input")
    outputs: Names = Field(description="outputs of y = C x: states, or the rows of C")
    A: Matrix = Field(description="A, one row per state")
    B: Matrix = Field(description="B, one row per state, one column per input")
    C: tuple[Numbers, ...] = Field(
        default=(),
        description="C, one row per output, one column per state; absent if the outputs are states",
    )
    D: tuple[Numbers, ...] = Field(
        default=(), description="feedthrough, which models of other tools have; it must be 0"
    )
    output_units: dict[Name, Unit] = Field(
        default={}, description="units of the outputs of C that are not states"
    )
    identities: bool = Field(
        default=True,
        description="whether to check what physics fixes, such as theta_dot = q; false for a model "
        "that differs on purpose",
    )
    gravity: tuple[Gravity, ...] = Field(default=(), description="sine terms of f")
    inertial_coupling: tuple[Product, ...] = Field(
        default=(), description="terms of f from products of states"
    )
    gusts: dict[str, dict[str, Number]] = Field(
        default={},
        description="what wind w along each axis adds to each x_dot, per w / V0; axes: "
        "longitudinal, "
        "lateral, vertical, and roll, pitch, yaw for air that turns",
    )

    def _check(self) -> None:
        n = len(self.states)
        m = len(self.inputs)
        for key, columns in (("A", n), ("B", m)):
            shape = [len(row) for row in getattr(self, key)]
            require(
                shape == [columns] * n, key, f"rows of {shape} values", f"{n} rows of {columns}"
            )
        # There must be an output, at most as many as inputs, and all units must be known.
        fewer = f"{m} or fewer, as many as inputs or fewer"
        require(0 < len(self.outputs) <= m, "outputs", f"{len(self.outputs)} of them", fewer)
        for key, unit in (
            *self._units(),
            *((f"output_units.{name}", unit) for name, unit in self.output_units.items()),
        ):
            quantity(unit, key)
        self._check_outputs(n, len(self.outputs))
        # Where the file must name a state, the name must be one of `states`.
        states_by_key = (
            {} if self.C else {f"outputs[{i}]": name for i, name in enumerate(self.outputs)}
        )
        states_by_key |= {f"gravity[{i}].into": term.into for i, term in enumerate(self.gravity)}
        states_by_key |= {f"gravity[{i}].angle": term.angle for i, term in enumerate(self.gravity)}
        states_by_key |= {
            f"inertial_coupling[{i}].into": term.into
            for i, term in enumerate(self.inertial_coupling)
        }
        for i, term in enumerate(self.inertial_coupling):
            require(
                len(term.product) == 2,
                f"inertial_coupling[{i}].product",
                f"{len(term.product)} states",
                "two of them",
            )
            states_by_key |= {
                f"inertial_coupling[{i}].product[{k}]": state
                for k, state in enumerate(term.product)
            }
        require(
            not self.gusts or self.speed > 0.0,
            "speed",
            self.speed,
            "above 0 m/s beside gusts, which are per w / V0",
        )
        for gust in self.gusts:
            require(
                gust in AXES or gust in ROTARY,
                f"gusts.{gust}",
                f"{gust!r}",
                f"an axis of the wind: {', '.join((*AXES, *ROTARY))}",
            )
        for gust, direction in self.gusts.items():
            states_by_key |= {f"gusts.{gust}.{state}": state for state in direction}
        for key, name in states_by_key.items():
            require(name in self.states, key, f"{name!r}", f"a state: {', '.join(self.states)}")

    def _units(self) -> list[tuple[str, Unit]]:
        """Return the keys and units of all states and inputs."""
        states = [(f"states.{name}", unit) for name, unit in self.states.items()]
        return states + [
            (f"inputs.{name}.unit", channel.unit) for name, channel in self.inputs.items()
        ]

    def _check_outputs(self, n: int, m: int) -> None:
        """Check C, D and output_units: their shapes, a unit for each output, and no feedthrough."""
        shape = [len(row) for row in self.C]
        require(
            shape in ([], [n] * m),
            "C",
            f"rows of {shape} values",
            f"{m} rows of {n}: a row an output, a column a state",
        )
        largest = max(map(abs, chain.from_iterable(self.D)), default=0.0)
        way_out = (
            "none: take an output that no input moves at once, such as a speed in place "
            "of an acceleration"
        )
        require(largest == 0.0, "D", f"a feedthrough of {largest:g}", way_out)
        for name in self.output_units:
            expected = (
                "an output of C that is no state: "
                f"{', '.join(set(self.outputs) - set(self.states)) or 'none'}"
            )
            require(
                bool(self.C) and name in self.outputs and name not in self.states,
                "output_units",
                f"{name!r}",
                expected,
            )
        # A row of C either selects a state, or has a separate name and unit.
        for name, row in zip(self.outputs, self.C, strict=bool(self.C)):
            require(
                name in self.states or name in self.output_units,
                f"output_units.{name}",
                "none",
                "the unit of this output",
            )
            picked = [state for state, value in zip(self.states, row, strict=True) if value != 0.0]
            is_state = name not in self.states or (
                picked == [name] and row[list(self.states).index(name)] == 1.0
            )
            row_of_it = f"the state {name} alone: give another combination another name"
            require(
                is_state,
                "C",
                f"a row of {name} with {' and '.join(picked) or 'no state'}",
                row_of_it,
            )

    def units_of_outputs(self) -> dict[str, Unit]:
        """Return the units of the outputs, in their order."""
        return {name: self.states.get(name) or self.output_units[name] for name in self.outputs}

    def index(self, state: str) -> int:
        """Return the index of a state in x.

        Args:
            state: Name of the state.

        Returns:
            The index, 0 to n - 1.
        """
        return list(self.states).index(state)

    def matrix_a(self) -> FloatArray:
        """Return A, shape (n, n), SI: A_ij unit_i / unit_j."""
        unit = _si(self.states.values())
        matrix: FloatArray = np.array(self.A)
        return matrix * unit[:, None] / unit[None, :]

    def matrix_b(self) -> FloatArray:
        """Return B, shape (n, p), SI: B_ij unit_i / unit_j."""
        row = _si(self.states.values())
        column = _si(i.unit for i in self.inputs.values())
        matrix: FloatArray = np.array(self.B)
        return matrix * row[:, None] / column[None, :]

    def no_thrust(self) -> FloatArray:
        """Return the value of each input at which it gives no thrust, shape (p,), SI.

        The value is a deviation from trim: 0 for a surface, and nan if the file does not state it.
        """
        units = [quantity(channel.unit) for channel in self.inputs.values()]
        unsaid = [0.0 if unit.dimension == ANGLE else math.nan for unit in units]
        values = [channel.no_thrust for channel in self.inputs.values()]
        pairs = zip(values, units, unsaid, strict=True)
        return np.array(
            [default if value is None else value * unit.si for value, unit, default in pairs]
        )

    def matrix_c(self) -> FloatArray:
        """Return C, shape (m, n), SI: C_ij unit_i / unit_j.

        If the file has no `C`, the matrix selects the outputs from the states.
        """
        if self.C:
            return (
                np.array(self.C)
                * _si(self.units_of_outputs().values())[:, None]
                / _si(self.states.values())
            )
        return selection_matrix(self.outputs, [*self.states])

    def matrix_gravity(self) -> FloatArray:
        """Return the matrix of the sine terms, shape (n, n): f = matrix_gravity @ sin(x)."""
        matrix = np.zeros((len(self.states), len(self.states)))
        for term in self.gravity:
            matrix[self.index(term.into), self.index(term.angle)] += term.gain
        return matrix

    def products(self) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
        """Return the P terms of the inertial coupling: f = gain @ (x[first] * x[second]).

        The shapes of gain, first and second are (n, P), (P,) and (P,).
        """
        terms = self.inertial_coupling
        gain = np.zeros((len(self.states), len(terms)))
        for k, term in enumerate(terms):
            gain[self.index(term.into), k] = term.gain
        first = np.array([self.index(term.product[0]) for term in terms], dtype=np.int64)
        second = np.array([self.index(term.product[1]) for term in terms], dtype=np.int64)
        return gain, first, second

    def with_matrices(self, A: FloatArray, B: FloatArray, wind_factor: FloatArray) -> Self:
        """Copy the airframe with new A, shape (n, n), and B, shape (n, m).

        The new matrices are in SI, and are stored in the units of the file. `wind_factor`
        multiplies the effect of wind along the axes of `gusts`. The copy is not checked against the
        identities of physics, because sampled and identified entries need not meet them.

        Args:
            A: Shape (n, n), SI.
            B: Shape (n, m), SI.
            wind_factor: Factors of the effect of wind, shape (n, G).

        Returns:
            The copy, not checked against physics.
        """
        state = _si(self.states.values())
        inputs = _si(i.unit for i in self.inputs.values())
        values = {
            "A": (A / state[:, None] * state).tolist(),
            "B": (B / state[:, None] * inputs).tolist(),
        }
        gusts = {}
        for (axis, direction), factor in zip(self.gusts.items(), wind_factor.T, strict=True):
            gusts[axis] = {
                name: value * float(factor[self.index(name)]) for name, value in direction.items()
            }
        return self.validate_mapping(
            self.model_dump() | values | {"gusts": gusts, "identities": False},
            f"airframe {self.name}",
        )

    def with_states(self, units: Mapping[str, str], A: FloatArray, B: FloatArray) -> Self:
        """Copy the airframe with k further states, on which no wind acts.

        The copy is not checked against the identities of physics.

        Args:
            units: Units of the further states by name, which come after the n states.
            A: Shape (n + k, n + k), SI.
            B: Shape (n + k, m), SI.

        Returns:
            The copy, not checked against physics.
        """
        values = {
            "states": self.states | dict(units),
            "A": np.zeros_like(A).tolist(),
            "B": np.zeros_like(B).tolist(),
            "identities": False,
        }
        empty = self.validate_mapping(self.model_dump() | values, f"airframe {self.name}")
        return empty.with_matrices(A, B, np.ones((len(A), len(self.gusts))))

    def through(self, T: FloatArray, inputs: Sequence[str]) -> Self:
        """Copy the airframe with new inputs v in place of its p inputs u, by u = T v, SI.

        u is in the order of the airframe. The copy is not checked against physics.

        Args:
            T: Matrix of u = T v, shape (p, m).
            inputs: Names of the m inputs v.

        Returns:
            The copy with m inputs.
        """
        B = self.matrix_b() @ T / _si(self.states.values())[:, None]
        channels = {name: {"unit": "1", "positive": f"more {name}"} for name in inputs}
        values = {"inputs": channels, "B": B.tolist(), "identities": False}
        return self.validate_mapping(self.model_dump() | values, f"airframe {self.name}")

    def with_rotary_gusts(self, axes: Sequence[str] = ROTARY) -> Self:
        """Copy the airframe, and add the axes of rotary gusts, in which the air itself turns.

            x_dot_i -= A_ij w_j,  i and j in p, q, r,  w = (p_g, q_g, r_g), rad/s

        Forces caused by these rates are left out, because A[alpha, q] and A[beta, r] also contain
        kinematics. Effects of rotary gusts that the file already states stay as they are.

        Args:
            axes: Axes of ROTARY. Axes whose state the airframe lacks are left out.

        Returns:
            The copy with more axes in `gusts`.
        """
        A = self.matrix_a()
        rates = [AIR_STATE[axis] for axis in ROTARY if AIR_STATE[axis] in self.states]
        gusts = {}
        for axis in axes:
            if (rate := AIR_STATE[axis]) in rates and axis not in self.gusts:
                column = {name: -float(A[self.index(name), self.index(rate)]) for name in rates}
                gusts[axis] = {name: self.speed * effect for name, effect in column.items()}
        return self.model_copy(update={"gusts": self.gusts | gusts})

    def matrix_gusts(self) -> FloatArray:
        """Compute the change of x_dot by 1 m/s of wind along each axis of `gusts`, shape (n, G)."""
        return (
            np.array([self.gust_direction(axis) for axis in self.gusts])
            .reshape(-1, len(self.states))
            .T
        )

    def gust_direction(self, gust: str) -> FloatArray:
        """Compute the change of x_dot by 1 m/s of wind along an axis, shape (n,).

        Args:
            gust: Name of the axis.

        Returns:
            Shape (n,), units of x_dot per m/s.

        Raises:
            ParameterError: The axis is not in the file.
        """
        axes = ", ".join(self.gusts) or "none, write its key gusts, as rise_di.new_airframe does"
        expected = f"a gust of the airframe {self.name}: {axes}"
        require(gust in self.gusts, "gusts", f"{gust!r}", expected)
        direction = np.zeros(len(self.states))
        for state, value in self.gusts[gust].items():
            direction[self.index(state)] = value / self.speed
        return direction


def _si(units: Iterable[Unit]) -> FloatArray:
    """Return the factor that converts each unit to SI."""
    return np.array([si_per_unit(unit) for unit in units])


def check_identities(airframe: Airframe) -> None:
    """Check that an airframe obeys the identities of physics. Raises ParameterError if not.

    An airframe whose file says `identities: false` passes unchecked.
    """
    if airframe.identities:
        effects = {name: channel.positive for name, channel in airframe.inputs.items()}
        units = tuple(channel.unit for channel in airframe.inputs.values())
        A = np.array(airframe.A)
        B = np.array(airframe.B)
        gravity = airframe.matrix_gravity()
        identities.check(
            identities.LinearModel(
                name=airframe.name,
                states=airframe.states,
                effects=effects,
                inputs=units,
                speed=airframe.speed,
                file_A=A,
                file_B=B,
                gravity=gravity,
            )
        )


def airframes() -> list[str]:
    """Name the airframes in the library.

    Returns:
        The names, sorted.

    Examples:
        >>> "osprey" in rise_di.airframes()
        True
    """
    return names_in(LIBRARY)


def load_airframe(name: FilePath | Airframe) -> Airframe:
    """Load an airframe by its name in the library, or from the path of a file.

    Args:
        name: Name in the library, path of an airframe file (.yaml), or an Airframe.

    Returns:
        The validated airframe. An Airframe is returned as it is.

    Raises:
        ParameterError: No airframe has the name, or the file is invalid.

    Examples:
        >>> rise_di.load_airframe("osprey").matrix_a().shape
        (8, 8)
    """
    if isinstance(name, Airframe):
        return name
    path = find_file(name, LIBRARY, "airframe", EXPECTED)
    return _parsed(os.fspath(name), path, read_file(path, f"airframe {path}", EXPECTED))


@lru_cache(maxsize=8)
def _parsed(name: str, path: Path, content: bytes) -> Airframe:
    """Read an airframe from the content of a file, and keep it in a cache.

    The cache saves 15 ms in a node that checks a change of its parameters in flight.
    """
    parsed = parse_yaml(content, f"airframe {path}", EXPECTED)
    require(isinstance(parsed, dict), f"airframe {path}", type(parsed).__name__, "a mapping")
    if isinstance(speed := parsed.get("speed"), str):
        parsed["speed"] = in_si(speed, f"airframe {name}: speed", "m/s")
    airframe = Airframe.validate_mapping(parsed, f"airframe {name}")
    check_identities(airframe)
    return airframe


EULER_STATES = ("phi", "theta", "p", "q", "r")
"""States of Euler's equations, in the order of `dynamics.EulerKinematics.select`."""


def euler_kinematics(airframe: Airframe) -> EulerKinematics:
    """Return the arrays for Euler's equations. Raises ParameterError if there is no trim speed."""
    require(
        airframe.speed > 0.0,
        "kinematics",
        "euler without a trim speed",
        "linear, or an airframe with `speed`",
    )
    unit = np.eye(len(airframe.states))
    rows = airframe.matrix_a()
    alpha, phi, theta = (airframe.index(name) for name in ("alpha", "phi", "theta"))
    return EulerKinematics(
        select=unit[[airframe.index(name) for name in EULER_STATES]],
        into=unit[:, [alpha, phi, theta]],
        linear=np.stack([0.0 * rows[alpha], rows[phi], rows[theta]]),
        turn_rate=np.array(GRAVITY / airframe.speed),
    )

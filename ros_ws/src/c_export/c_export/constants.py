# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the parameters of the controller and the reference model for the C code.

The parameters are written as the text of rise_di_parameters.h, or as the bytes of struct
rise_di_parameters.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from flight_core.arithmetic import INVERSE_PI, MAX_ANGLE, PI_HIGH, PI_LOW, SINE_COEFFICIENTS
from flight_core.known_keys import require_known
from flight_core.parameters import require
from flight_core.rates import period_ns, seconds
from flight_core.vectors import FloatArray
from reference_model.model import stepper
from reference_model.params import ReferenceModelConfig
from rise_di_controller.extensions.allocation import HALVINGS, RELAXATION, SMALL, SWEEPS
from rise_di_controller.extensions.feedforward import LONGEST_PART
from rise_di_controller.extensions.observer import ObserverParams
from rise_di_controller.extensions.schedule import ScheduleParams, airspeed_range
from rise_di_controller.guard.guard import LEAST_DT, MIN_SLOPE_SPAN, SAMPLE_BUFFER_SIZE
from rise_di_controller.guard.samples import AGREEING, FIRST_NS, MEMORY, MOVING, STILL, TIMES
from rise_di_controller.law.saturation import Limits
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

SCALARS = frozenset(
    {"period", "dt_least", "dt_largest", "speed", "time", "V_least", "V_largest", "fade_rate"}
)
"""Reals that are not lists."""

LEAST, LARGEST = -math.inf, math.inf
POSITIVE = float(np.finfo(np.float32).tiny)  # positive in float32, and therefore also in float64
TABLE: Mapping[str, tuple[str, float, float]] = MappingProxyType(
    dict.fromkeys(("period", "dt_least", "dt_largest", "time"), ("s", POSITIVE, LARGEST))
    | dict.fromkeys(("K", "Lambda"), ("1/s", POSITIVE, LARGEST))
    | dict.fromkeys(("eps", "y_max"), ("y", POSITIVE, LARGEST))
    | dict.fromkeys(("speed", "V_least", "V_largest"), ("m/s", POSITIVE, LARGEST))
    | dict.fromkeys(("limits.lower", "observer_limits.lower"), ("u", LEAST, 0.0))
    | dict.fromkeys(("limits.upper", "observer_limits.upper"), ("u", 0.0, LARGEST))
    | dict.fromkeys(("limits.rate", "observer_limits.rate"), ("u/s", 0.0, LARGEST))
    | {
        "stops.lower": ("effector", LEAST, 0.0),
        "stops.upper": ("effector", 0.0, LARGEST),
        "stops.rate": ("effector/s", 0.0, LARGEST),
    }
    | dict.fromkeys(("airspeed", "has_sine"), ("1", 0.0, 1.0))
    | {
        "beta": ("y/s^2", POSITIVE, LARGEST),
        "D": ("1", -1.0, 1.0),
        "input_scale": ("u s/y", POSITIVE, LARGEST),
        "omega": ("1", POSITIVE, LARGEST),
        "y_reach": ("y", 0.0, LARGEST),
        "lead": ("s", 0.0, LARGEST),
        "fade_rate": ("1/s", 0.0, LARGEST),
        "T": ("effector/v", LEAST, LARGEST),
        "effect": ("v/effector", LEAST, LARGEST),
    }
)
"""Unit and bounds of the reals. In a unit, y, u and effector stand for the unit of the output,
input or effector of each channel, and v stands for that of an input of the law. A matrix of the
model has no row here, because it can have any finite values in SI."""

REALS: Mapping[str, float] = MappingProxyType(
    {
        "MAX_ANGLE": MAX_ANGLE,
        "INVERSE_PI": INVERSE_PI,
        "PI_HIGH": PI_HIGH,
        "PI_LOW": PI_LOW,
        "RELAXATION": RELAXATION,
        "EXCHANGE_LEAST": SMALL,
        "TIMES": TIMES,
        "MEMORY": MEMORY,
    }
)
"""Reals of the algorithms, which are the same for every scenario."""


@dataclass(frozen=True, kw_only=True)
class Constant:
    """A member of struct rise_di_parameters, or of the struct for the reference model.

    The value of the member is one or several integers (int, tuple), or reals (array). A matrix is
    stored row by row.
    """

    name: str
    value: int | tuple[int, ...] | FloatArray


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """The dimensions of an exported controller.

    p is 0 without an allocation, n is 0 without a feedforward, and s is 0 without an observer.
    """

    m: int  # channels
    p: int  # effectors of the allocation
    n: int  # states of the nominal model
    s: int  # estimates
    has_schedule: bool


IN_C = frozenset(
    {
        *("rate", "law", "outputs", "inputs", "D", "input_scale", "lag", "delay", "y_max"),
        *("max_age", "hold", "ramp", "on_deactivate", "lower", "upper", "slew"),
        *("k_g", "k_d", "Lambda", "beta", "omega", "sign", "softening"),
        *(f"allocation.{key}" for key in ("effectors", "T", "effect", "lower", "upper", "slew")),
        "allocation.priority",
        *(f"feedforward.{key}" for key in ("states", "A", "B", "gravity", "lead")),
        *(f"observer.{key}" for key in ("rate", "states", "Phi", "Gamma", "L", "F", "part")),
        *(f"observer.{key}" for key in ("within", "fade", "margin")),
        *("schedule.speed", "schedule.time"),
    }
)
"""Keys of a controller that the constants of the C code hold."""

IDLE_IN_C = frozenset(
    {
        # These keys say how the node runs. In C, the caller of the code configures and activates
        # it.
        *("lockstep", "y_rate", "autostart", "start_active"),
        # Only a learner reads these keys, which say how well the model is known.
        "feedforward.deviation",
    }
)
"""Keys of a controller that have no effect on the C code."""


def exportable(controller: ControllerConfig) -> RiseDiConfig:
    """Return the controller if it can be exported. Raises ParameterError if it cannot.

    A controller cannot be exported if its law is not RISE-DI, or if its model can be replaced in
    flight (the section `learn`). Any other key that the C code lacks must be at its default, and an
    observer must not be switched off by a `part` of 0.
    """
    require(
        isinstance(controller, RiseDiConfig),
        "controller.law",
        controller.law,
        "rise_di: C code exists for this law alone",
    )
    assert isinstance(controller, RiseDiConfig)  # noqa: S101 - for the type checker
    require(
        controller.learn is None,
        "controller.learn",
        "a section",
        "none: C code replaces no model in flight; --run RUN exports the last model of a flight",
    )
    require_known(controller, IN_C | IDLE_IN_C, "controller", "the C code does not have it")
    flies = controller.observer is None or controller.observer.part > 0.0
    require(
        flies, "controller.observer.part", 0.0, "more than 0, or no feedforward and no observer"
    )
    return controller


def sizes(controller: RiseDiConfig) -> Sizes:
    """Return the dimensions of a controller."""
    n = 0 if controller.feedforward is None else len(controller.feedforward.states)
    s = 0 if controller.observer is None else len(controller.observer.states)
    p = 0 if controller.allocation is None else len(controller.allocation.effectors)
    return Sizes(
        m=len(controller.outputs), p=p, n=n, s=s, has_schedule=controller.schedule is not None
    )


def constants(controller: RiseDiConfig) -> list[Constant]:
    """Return the members of struct rise_di_parameters, in the order of rise_di.h.

    A limit that the controller does not have is infinite.
    """
    guard = controller.guard()
    law = controller.law_params()
    law_params = controller.tuned_law().params
    period = seconds(guard.period_ns)
    integers: dict[str, int | tuple[int, ...]] = {
        "digest": controller.digest(),
        "period_ns": guard.period_ns,
        "max_age_ns": guard.max_age_ns,
        "hold_ns": guard.hold_ns,
        "ramp_ns": guard.ramp_ns,
        "slope_ns": math.ceil(MIN_SLOPE_SPAN * guard.period_ns),
        "deactivation_holds": int(guard.deactivation_holds),
        "sign": int(controller.sampled_sign()),
    }
    reals: dict[str, ArrayLike] = {
        "period": period,
        "dt_least": LEAST_DT * period,
        "dt_largest": seconds(guard.longest_ns),
    }
    reals |= {
        name: getattr(law, name)
        for name in ("K", "Lambda", "beta", "D", "input_scale", "omega", "eps")
    }
    reals |= {"y_max": guard.samples.largest, "y_reach": guard.samples.reach}
    reals |= _limits("limits", guard.limits)
    # Add the extensions, if there are any.
    if (allocation := guard.allocation) is not None:
        integers["order"] = allocation.order
        reals |= {name: getattr(allocation, name) for name in ("T", "effect", "exchange")}
        reals |= _limits("stops", allocation.limits)
    if isinstance(law_params, ScheduleParams):
        least, largest = airspeed_range(law_params)
        reals |= {
            "speed": law_params.speed,
            "airspeed": law_params.is_airspeed,
            "time": law_params.time,
        }
        reals |= {"V_least": least, "V_largest": largest}
    if guard.nominal is not None:
        names = ("A", "B", "C", "gravity", "inverse", "path_A", "path_gravity", "lead")
        reals |= {name: getattr(guard.nominal, name) for name in names}
        reals["has_sine"] = guard.nominal.gravity.any(axis=0)
    if isinstance(law_params, ObserverParams):
        reals |= {name: getattr(law_params, name) for name in ("Phi", "Gamma", "H", "L", "F")}
        reals |= _limits("observer_limits", law_params.limits) | {"fade_rate": law_params.fade_rate}
    # Integers come first.
    return [
        *(Constant(name=name, value=value) for name, value in integers.items()),
        *(
            Constant(name=name, value=np.array(value, dtype=np.float64).ravel())
            for name, value in reals.items()
        ),
    ]


def _limits(name: str, limits: Limits) -> dict[str, FloatArray]:
    return {f"{name}.{key}": getattr(limits, key) for key in ("lower", "upper", "rate")}


def packed(controller: RiseDiConfig, *, float32: bool) -> bytes:
    """Return the bytes of struct rise_di_parameters.

    The struct has integers of 64 bits, then the reals without a gap, and is padded to 8 bytes.
    """
    real = np.float32 if float32 else np.float64
    content = b"".join(
        _finite(member.value, real).astype(real).tobytes()
        if isinstance(member.value, np.ndarray)
        else np.array(member.value, np.int64).tobytes()
        for member in constants(controller)
    )
    return content + bytes(-len(content) % 8)


def _finite(values: FloatArray, real: type[np.floating]) -> FloatArray:
    """Replace infinity by the largest finite number of a floating-point type."""
    largest = float(np.finfo(real).max)
    return np.clip(values, -largest, largest)


def reference_constants(reference: ReferenceModelConfig) -> list[Constant]:
    """Return the members of struct rise_di_reference_parameters, in the order of rise_di.h."""
    live = reference.live_params()
    model = reference.model()
    period = period_ns(reference.rate, "rate")
    reals = (*stepper(seconds(period), model), model.C, live.bounds, live.reach)
    names = ("Phi", "Gamma", "C", "bounds", "reach")
    return [
        Constant(name="period_ns", value=period),
        Constant(name="max_age_ns", value=live.max_age_ns),
        *(
            Constant(name=name, value=values.ravel())
            for name, values in zip(names, reals, strict=True)
        ),
    ]


def header(
    controller: RiseDiConfig,
    scenario: str,
    reference: ReferenceModelConfig | None = None,
    *,
    float32: bool,
    samples: int = SAMPLE_BUFFER_SIZE,
) -> str:
    """Return the text of rise_di_parameters.h.

    If `reference` is None, the header has no reference model. The C code stores the last `samples`
    samples of y, and as many of y_m.
    """
    r = 0 if reference is None else len(reference.model().A_m)
    suffix = "F" if float32 else ""
    real = np.float32 if float32 else np.float64

    def numbers(value: FloatArray) -> str:
        return ", ".join(f"{float(real(x))!r}{suffix}" for x in _finite(value, real))

    def struct(members: list[Constant]) -> list[str]:
        return [f"    /* {member.name} */ {_initialiser(member, numbers)}" for member in members]

    members = constants(controller)
    rows = _rows(members, numbers)
    reference_lines = []
    if reference is not None:
        reference_lines = _macro("RISE_DI_REFERENCE", struct(reference_constants(reference)))
    lines = [
        "/* SPDX-FileCopyrightText: RISE-DI contributors",
        " * SPDX-License-Identifier: Apache-2.0",
        " *",
        (
            f" * Parameters of the controller of {scenario}, written by `rise-di export`. "
            "rise_di.h has units and meaning."
        ),
        (
            f" * y and y_m: {_comment(controller.outputs)}; u: {_comment(controller.effectors)}; "
            f"{controller.rate:g} Hz."
        ),
        " */",
        "#ifndef RISE_DI_PARAMETERS_H",
        "#define RISE_DI_PARAMETERS_H",
        "",
        *_names_and_sizes(controller, r, samples, float32=float32),
        f"#define RISE_DI_AGREEING {AGREEING} /* samples in a row after a jump of y */",
        f"#define RISE_DI_FIRST_NS {FIRST_NS} /* after the first y, in which it may jump */",
        f"#define RISE_DI_STILL {STILL} /* samples and periods without a change: y is frozen */",
        f"#define RISE_DI_MOVING {MOVING} /* samples in a row with a change before */",
        f"#define RISE_DI_LONGEST_PART {LONGEST_PART} /* periods, of a Runge-Kutta step */",
        *(f"#define RISE_DI_{name} {numbers(np.array([value]))}" for name, value in REALS.items()),
        f"#define RISE_DI_SWEEPS {SWEEPS}",
        f"#define RISE_DI_HALVINGS {HALVINGS}",
        f"#define RISE_DI_SINE_COEFFICIENTS {{{numbers(np.array(SINE_COEFFICIENTS))}}}",
        "",
        *_macro("RISE_DI_PARAMETERS", struct(members)),
        *reference_lines,
        f"#define RISE_DI_ROWS {len(rows)} /* of the table of parameters */",
        *_macro("RISE_DI_TABLE", rows, braces=False),
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _names_and_sizes(controller: RiseDiConfig, r: int, samples: int, *, float32: bool) -> list[str]:
    """Return the lines of the header with channel names, dimensions and compile-time switches."""
    dimensions = sizes(controller)
    m, p, n, s = dimensions.m, dimensions.p, dimensions.n, dimensions.s
    effectors = [f"#define RISE_DI_EFFECTORS {_strings(controller.effectors)}"] if p else []
    return [
        f"#define RISE_DI_OUTPUTS {_strings(controller.outputs)}",
        f"#define RISE_DI_INPUTS {_strings(controller.inputs)}",
        *effectors,
        f"#define RISE_DI_M {m} /* channels */",
        f"#define RISE_DI_P {p} /* effectors of the allocation, 0: no allocation */",
        f"#define RISE_DI_N {n} /* states of the feedforward's model, 0: no feedforward */",
        f"#define RISE_DI_S {s} /* estimates of the observer, 0: no observer */",
        f"#define RISE_DI_R {r} /* states of the reference model, 0: no reference model */",
        (
            f"#define RISE_DI_SCHEDULE {int(dimensions.has_schedule)} /* 1: input_scale follows "
            "the dynamic pressure */"
        ),
        f"#define RISE_DI_FLOAT32 {int(float32)} /* 0: rise_di_real is double, 1: float */",
        f"#define RISE_DI_SAMPLES {samples} /* samples kept of y and of y_m */",
    ]


def _macro(name: str, parts: list[str], *, braces: bool = True) -> list[str]:
    return [
        "",
        f"#define {name} {'{ ' * braces}\\",
        ", \\\n".join(parts) + (" \\\n}" if braces else ""),
        "",
    ]


def _rows(members: list[Constant], numbers: Callable[[FloatArray], str]) -> list[str]:
    """Return the rows of the C table that gives unit, place, size and bounds of each parameter.

    The rows are in the order of the reals of the struct.
    """
    rows = []
    place = 0
    for member in members:
        if isinstance(member.value, np.ndarray):
            unit, least, largest = TABLE.get(member.name, ("SI", LEAST, LARGEST))
            bounds = numbers(np.array([least, largest]))
            size = member.value.size
            rows.append(f'    {{"{member.name}", "{unit}", {place}, {size}, {bounds}}}')
            place += size
    return rows


def _initialiser(member: Constant, numbers: Callable[[FloatArray], str]) -> str:
    """Return the C initialiser of a member: a number, or a list in braces.

    The limits are a nested struct. The braces of this struct open before the list of `lower`, the
    first member, and close after the list of `rate`, the last member.
    """
    value = member.value
    if isinstance(value, int):
        return str(value)
    if isinstance(value, tuple):
        return f"{{{', '.join(map(str, value))}}}"
    if member.name in SCALARS:
        return numbers(value)
    begin = member.name.endswith(".lower")
    end = member.name.endswith(".rate")
    return f"{'{' * begin}{{{numbers(value)}}}{'}' * end}"


def _strings(names: tuple[str, ...]) -> str:
    """Return names as C string literals, separated by commas.

    If a character is not a letter, a digit or one of "_. ", each of its bytes becomes an octal
    escape. The names of a parameter set have no such characters.
    """
    return ", ".join(f'"{"".join(map(_octal, name))}"' for name in names)


def _octal(character: str) -> str:
    plain = character.isascii() and (character.isalnum() or character in "_. ")
    if plain:
        return character
    return "".join(f"\\{byte:03o}" for byte in character.encode("utf-8", "surrogatepass"))


def _comment(names: tuple[str, ...]) -> str:
    """Return names for a C comment, separated by commas.

    The names have the escapes of `_strings`, so that no name can end the comment early.
    """
    return ", ".join("".join(map(_octal, name)) for name in names)

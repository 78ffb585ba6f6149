# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write gains as the section of a controller in a scenario file."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined, Template

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.linear_loop.loop_margins import LoopMargins, law_order
from flight_core.arguments import as_instance
from flight_core.files import parse_yaml
from flight_core.text import printable
from flight_core.vectors import FloatArray
from flight_design.gains.gain_conditions import GainCondition
from flight_design.gains.gain_selection import Selection, response
from rise_di_controller.extensions.model_sections import (
    AllocationConfig,
    FeedforwardConfig,
    ObserverConfig,
    VanesConfig,
)
from rise_di_controller.law.law import Sign
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

# a string that YAML needs no quotes for, unless it is a word with a meaning such as true
PLAIN = re.compile(r"[A-Za-z/][A-Za-z0-9_./:-]*")


def yaml_flow(value: Any, precision: int = 6) -> str:
    """Write a value in YAML's flow style.

    Floats have six significant digits and always a decimal point, which YAML 1.1 requires of a
    float.
    """
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(yaml_flow(entry, precision) for entry in value)}]"
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(f"{key}: {yaml_flow(entry, precision)}" for key, entry in value.items())
            + "}"
        )
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        digits, mark, exponent = f"{value:.{precision}g}".partition("e")
        return (digits if "." in digits else digits + ".0") + mark + exponent
    if isinstance(value, str) and not (
        PLAIN.fullmatch(value) and parse_yaml(value, "", "") == value
    ):
        return json.dumps(value, ensure_ascii=False)  # JSON is YAML too
    return str(value)


def yaml_template(text: str) -> Template:
    """Return a Jinja template of a YAML file.

    In the template, "{{ value | flow }}" writes a value by `yaml_flow`. "| digits(3)" writes a
    number with three digits, and "| line" writes a text without a line end.
    """
    environment = Environment(
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        autoescape=False,  # noqa: S701 - no HTML
    )
    environment.filters["flow"] = yaml_flow
    environment.filters["line"] = printable
    environment.filters["digits"] = lambda value, count: f"{value:.{count}g}"
    return environment.from_string(text)


CONTROLLER_YAML = yaml_template("""\
{% macro listed(keys, indent) %}
{% for key, rows in keys.items() %}
{{ " " * indent }}{{ key }}:
{%- if rows is mapping %}

{{ listed(rows, indent + 2) }}
{%- else %} {{ rows if rows is string else "[" ~ rows | join(",\n" ~ " " * (indent + 3 + key | length)) ~ "]" }}
{% endif %}
{% endfor %}
{% endmacro %}
{% if below %}
# {{ below }}
{% endif %}
# Gains for the airframe {{ airframe }} {{ origin }}.
{%- if delay_margin is not none %} Predicted delay margin {{ "%.0f" | format(1e3 * delay_margin) }} ms.{% endif %}
{%- if margins %}

# {{ margins }}
{%- endif %}

/**/controller:
  ros__parameters:
{% for key, value, comment in parameters %}
    {{ key }}: {{ value | flow }}{{ "  # " ~ comment if comment }}
{% endfor %}
{% for name, (comment, keys) in sections.items() %}
    {{ name }}:  # an extension of the paper: {{ comment }}
{{ listed(keys, 6) }}
{%- endfor %}
""")  # noqa: E501 - a text as it is written


def _listed(values: FloatArray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def selection_yaml(selection: Selection, *, theorem: bool = False) -> str:
    """Write the engineering gain set as the section `/**/controller` of a scenario file.

    Comments give units and reasons.

    Args:
        selection: The result of `select_gains`.
        theorem: Whether to write the gain set of Theorem 1 in place of the engineering gains.

    Returns:
        The text of the section, YAML.

    Raises:
        ParameterError: `selection` is no Selection.

    Examples:
        >>> text = rise_di.gains_yaml(rise_di.select_gains("osprey", samples=1))
        >>> "beta:" in text
        True
    """
    as_instance(selection, Selection, "selection", "a Selection, as select_gains returns one")
    assessed = selection.theorem if theorem else selection.engineering
    controller = assessed.controller
    # an observer with a `part` of 0 does not act yet; a learner designs it later
    has_observer = controller.observer is not None and controller.observer.part > 0.0
    engineering = "beside an observer" if has_observer else "by the engineering procedure"
    comments = _comments(selection, controller)
    if theorem:
        comments |= {"Lambda": "1/s", "beta": "units of y / s^2; the least of (29) and (30)"}
    if has_observer:
        unscaled = "units of u s / units of y; for a K of (22) that is above 1"
        comments |= {
            "Lambda": "1/s",
            "beta": "units of y / s^2",
            "omega": "abs(Omega_ii) in scaled inputs",
            "input_scale": unscaled,
        }
    return section_yaml(
        controller,
        selection.study.airframe,
        assessed.margins,
        "by Theorem 1" if theorem else engineering,
        comments,
        assessed.unmet,
    )


def _comments(selection: Selection, controller: RiseDiConfig) -> dict[str, str]:
    """Return a comment with unit and reason for each parameter of the engineering gains."""
    study = selection.study
    params = controller.law_params()
    _, columns = law_order(study.airframe, controller)
    responses = response(study, controller)
    K = _listed(params.K)
    bandwidth = _listed(params.K * responses)
    slew = _listed(study.slew[columns] / params.input_scale)
    return {
        "rate": "Hz",
        "outputs": "the fastest first: the last one has the smallest gain, as (22) has it",
        "inputs": "",
        "k_g": f"1/s; K = ({K}) by (22), bandwidths ({bandwidth}) rad/s",
        "k_d": "1/s",
        "Lambda": "1/s, a quarter of the bandwidths, or less for the phase margin",
        "beta": f"units of y / s^2; {selection.setting.factor:g} x the ideal control's slew "
        f"({slew}), within 0.7 x rate limit",
        "D": "signs of the leading minors of C B",
        "input_scale": f"units of u s / units of y: {_shown_response(responses)} / "
        "abs(Omega_ii), Omega = C B",
        "omega": f"abs(Omega_ii) in scaled inputs{_within(study.uncertainty)}",
        "sign": controller.sampled_sign().name.lower() + " with this lag and delay",
        "lag": "s, actuators",
        "delay": "s, beyond sampling",
        "softening": "1, width of the softened sign in total lags: wider for the phase margin",
    }


def _within(uncertainty: float) -> str:
    """Write the words that a value holds for deviations up to `uncertainty`.

    Returns "" if it is 0.
    """
    return f", the largest within +-{100 * uncertainty:g} %" if uncertainty else ""


def section_yaml(
    controller: ControllerConfig,
    airframe: Airframe,
    margins: LoopMargins | None,
    origin: str,
    comments: Mapping[str, str],
    unmet: Sequence[GainCondition] = (),
) -> str:
    """Write a controller as the section `/**/controller` of a scenario file.

    A parameter without an entry in `comments` gets its description as comment. The text begins with
    the margins that are `unmet`.
    """
    parameters = [
        (key, value, comments.get(key, type(controller).model_fields[key].description))
        for key, value in controller.model_dump(
            exclude_defaults=True,
            exclude={"allocation", "feedforward", "observer", "schedule", "learn"},
        ).items()
    ]
    return CONTROLLER_YAML.render(
        airframe=airframe.name,
        origin=origin,
        delay_margin=None if margins is None else margins.delay,
        below=below_requirement(unmet, controller.outputs),
        margins=margins_sentence(controller, margins),
        parameters=parameters,
        sections=_sections(controller, airframe),
    )


def below_requirement(unmet: Sequence[GainCondition], outputs: Sequence[str]) -> str:
    """Write the first line of a file, which says which margins are too small.

    Returns "" without any.
    """
    lacking = "; ".join(condition.sentence(outputs) for condition in unmet)
    return f"Margins below the requirement: {lacking}." if lacking else ""


def margins_sentence(controller: ControllerConfig, margins: LoopMargins | None) -> str:
    """Write the nominal and the worst phase margins of a loop in a sentence.

    With the implicit sign, `chatter_sentence` gives the sentence. Returns "" if the loop has the
    literal sign or is unstable.
    """
    if margins is None or not margins.nominal.stable:
        return ""
    if chatter := chatter_sentence(controller, margins):
        return chatter
    each = zip(margins.inputs, np.degrees(margins.nominal.phase).tolist(), strict=True)
    phases = ", ".join(f"{name} {phase:.0f}" for name, phase in each)
    largest = float(margins.nominal.sensitivity.max())
    damping = float(margins.nominal.damping)
    worst = ""
    if margins.worst is not None:
        origin = "found" if margins.is_searched else f"of {margins.aircraft}"
        worst = f"; worst {origin} {np.degrees(margins.worst.phase.min()):.0f} deg"
    return (
        f"Phase margins {phases} deg{worst}; largest sensitivity {largest:.2f}, damping "
        f"{damping:.2f}."
    )


def chatter_sentence(controller: ControllerConfig, margins: LoopMargins | None) -> str:
    """Write a sentence on how late u may act before the implicit sign may chatter.

    Returns "" for any other sign, or without margins.
    """
    if margins is None or not isinstance(controller, RiseDiConfig):
        return ""
    if controller.sampled_sign() is not Sign.IMPLICIT:
        return ""
    latest, delay = (1e3 * value for value in (controller.delay + margins.delay, controller.delay))
    return (
        f"The implicit sign may chatter if u acts more than {latest:.1f} ms late, and the gains "
        f"are made for {delay:.1f} ms: if an actuator lags, or u comes later, select them with "
        "this lag and delay."
    )


def _shown_response(responses: FloatArray) -> str:
    """Write the numerators r_i of the input scales r_i / abs(Omega_ii).

    r_i is less than 1 in a channel that is too slow for a K of (22), and 1 in all others. If all of
    them are 1, the result is "1".
    """
    factors = [f"{value:.3g}" for value in responses]
    return "1" if set(factors) == {"1"} else f"({', '.join(factors)})"


def _sections(
    controller: ControllerConfig, airframe: Airframe
) -> dict[str, tuple[str, dict[str, Any]]]:
    """Write the sections allocation, feedforward and observer, if there are any.

    Each section has a comment, and its parameters in flow style.
    """
    along = f"the input of {airframe.name} along y_m is added; SI, a line a state, lead in s"
    corrects = (
        "estimates correct the trim; SI, a line an estimate, of F a line an input; "
        "within, fade, margin in s"
    )
    distributes = (
        "u = T v, v = effect u; SI, of T a line an effector, of effect a line an input of the law"
    )
    comments = {"allocation": distributes, "feedforward": along, "observer": corrects}
    sections = {
        name: (comment, _matrix_rows(section, len(controller.inputs)))
        for name, comment in comments.items()
        if (section := getattr(controller, name)) is not None
    }
    if isinstance(controller, RiseDiConfig) and (schedule := controller.schedule) is not None:
        rows: dict[str, str | list[str]] = {
            "speed": yaml_flow(schedule.speed),
            "time": yaml_flow(schedule.time),
        }
        for name, model in (("slow", schedule.slow), ("fast", schedule.fast)):
            if model is not None:
                values = (
                    f"{key}: {yaml_flow(value, 10)}"
                    for key, value in model.model_dump(exclude_none=True).items()
                )
                rows[name] = "{" + ",\n             ".join(values) + "}"
        sections["schedule"] = (
            "input_scale, and the models of the sections above, follow the airspeed; m/s, s",
            rows,
        )
    if isinstance(controller, RiseDiConfig) and controller.learn is not None:
        settings = controller.learn.model_dump(exclude_none=True)
        rows = {key: yaml_flow(value) for key, value in settings.items()}
        sections["learn"] = (
            "A and B are identified in flight, and feedforward and observer designed again; s",
            rows,
        )
    return sections


def _columns_of(
    section: AllocationConfig | FeedforwardConfig | ObserverConfig | VanesConfig, m: int
) -> dict[str, int]:
    """Return the number of columns of each matrix in a section, by the matrix's name."""
    if isinstance(section, VanesConfig):
        return {"H": len(section.H) // len(section.channels), "L": m + 1}
    if isinstance(section, AllocationConfig):
        return {"T": m, "effect": len(section.effectors)}
    n = len(section.states)
    if isinstance(section, FeedforwardConfig):
        return {"A": n, "B": m, "gravity": n}
    return {"Phi": n, "Gamma": m, "L": m, "F": n}


def _matrix_rows(
    section: AllocationConfig | FeedforwardConfig | ObserverConfig | VanesConfig, m: int
) -> dict[str, Any]:
    """Write each parameter of a section in flow style, a matrix row by row.

    Numbers of an allocation and of an observer have ten digits.
    """
    rows: dict[str, Any] = {}
    columns_of = _columns_of(section, m)
    for key, value in section.model_dump(exclude_none=True).items():
        if isinstance(value, dict):
            rows[key] = _matrix_rows(getattr(section, key), m)
            continue
        if not isinstance(value, tuple):
            rows[key] = yaml_flow(value)
            continue
        columns = columns_of.get(key, len(value))
        digits = 6 if isinstance(section, FeedforwardConfig) else 10
        rows[key] = [
            yaml_flow(value[i : i + columns], digits)[1:-1] for i in range(0, len(value), columns)
        ]
    return rows

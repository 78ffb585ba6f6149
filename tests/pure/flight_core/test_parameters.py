# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test invalid parameters: one sentence has the key, what was found and what is expected."""

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from tests.builders import aircraft_parameters
from tests.conftest import REPOSITORY, refusing
from tools.parameters import PAGE, SECTIONS

from aircraft_sim.airframes.airframe import LIBRARY, Airframe, load_airframe
from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_campaign.definition import Definition
from flight_core.files import read_yaml, writing
from flight_core.outcome import COMPLETED
from flight_core.parameters import Config, ParameterError, flatten, nest
from flight_core.rates import divide, period_ns
from rise_di_controller import laws

# Replacement in the text of the default scenario -> the sentence of the error.
BAD = {
    ("k_g: 1.0", "k_g: -1.0"): "controller.k_g: found -1.0, expected greater than 0",
    (
        "    beta:",
        "    betta:",
    ): "controller.betta: unknown key, expected beta perhaps, or another of D, Lambda,",
    (
        "    Lambda: [5.0, 5.0, 3.0, 0.5]",
        "    #",
    ): "controller.Lambda: missing, expected the diagonal of Lambda (4), 1/s",
    (
        "D: [1, 1, 1, 1]",
        "D: [1, 1, 1]",
    ): "controller.D: found 3 values, expected 4, one for each of q, p, r, V",
    (
        "damping: [0.9, 1.0,",
        "damping: [0.9, -1.0,",
    ): "second_order.damping: found an eigenvalue of A_m with real part",
    ("rate: 100.0                # Hz\n    outputs", "rate: 300.0\n    outputs"): (
        "controller.rate: found 300 Hz, expected a rate whose period is a whole number of "
        "nanoseconds"
    ),
    ("rate: 500.0                # Hz, y and truth", "rate: 250.0"): (
        "aircraft.rate: found 250 Hz, expected a whole multiple of controller.rate (100 Hz)"
    ),
    (
        "step: 0.002",
        "step: 0.003",
    ): "aircraft.step: found 0.003 s, expected a whole fraction of 1 / rate (0.002 s)",
    (
        "airframe: osprey",
        "airframe: ospray",
    ): "aircraft.airframe: found 'ospray', expected osprey perhaps, or another of",
    (
        "rudder, thrust]",
        "rudder, flaps]",
    ): "controller.inputs: found elevator, aileron, rudder, flaps, expected the channels",
    (
        "sign: auto",
        "sign: smooth",
    ): "controller.sign: found 'smooth', expected 'auto', 'literal', 'implicit' or 'soft'",
    (
        "vertical: {start",
        "upward: {start",
    ): "gusts: found 'upward', expected a gust of the airframe osprey: vertical, lateral",
    (
        "stop: [4.0, 8.0",
        "stop: [1.0, 8.0",
    ): "reference_model.pulses.q.stop[0]: found 1.0, expected later than start[0] = 2 s",
    (
        "bank_rate: p",
        "bank_rate: roll",
    ): "coordinated_turn.bank_rate: found channel 'roll', expected one of q, V, p, r",
    (
        "/**/recorder",
        "/**/recoder",
    ): "bad.yaml: recoder: found a section, expected recorder perhaps, or another of",
    (
        "/**/recorder:\n  ros__parameters:",
        "/**/recorder:\n  parameters:",
    ): "recorder: found no parameters under",
    (
        "duration: 60.0",
        "duration: 60.0\n    duration: 50.0",
    ): "bad.yaml: not valid YAML (found the key duration twice",
}


@pytest.mark.parametrize(
    "change, sentence", BAD.items(), ids=[change[1].strip()[:40] for change in BAD]
)
def test_a_bad_scenario_is_one_sentence(
    change: tuple[str, str], sentence: str, osprey_gust: Scenario, tmp_path: Path
) -> None:
    text = osprey_gust.path.read_text()
    assert text.count(change[0]) >= 1, f"the scenario no longer holds {change[0]!r}"
    bad = tmp_path / "bad.yaml"
    bad.write_text(text.replace(*change, 1))
    with pytest.raises(ParameterError) as rejected:
        load_scenario(bad)
    message = str(rejected.value)
    assert sentence in message
    assert "\n" not in message


# Section of the aircraft -> its values and the sentence of the error, a pattern.
GUST = {"start": 0.0, "speed": 1.0, "length": 9.0}
STEP = {"start": 0.0, "value": 1.0, "rise": 0.0}
SINE = {"amplitude": 1.0}
AIR = {"wind": 7.7, "sigma": 1.0}
PRODUCT = {"into": "p", "product": ["q", "p"], "gain": 1.0}
FOUR = "found 1 values, expected 4, one for each of"
BAD_AIRCRAFT: dict[str, list[tuple[Any, str]]] = {
    "actuators": [
        ({"lag": [0.02]}, rf"\.lag: {FOUR} elevator, thrust, aileron, rudder"),
        (
            {"upper": [-0.1, 1.0, 1.0, 1.0]},
            r"\.upper\[0\]: found -0.1, expected greater than or equal to 0",
        ),
        (
            {"faults": ["elevator weak 60 3"]},
            r"\.faults\[0\]: found 3, expected weak_effect from -2 to 2",
        ),
    ],
    "sensors": [
        (
            {"delay": 0.003},
            r"\.delay: found 0\.003 s, expected a whole multiple of 1 / rate \(0\.002 s\)",
        ),
        ({"seed": 1.5}, r"\.seed: found 1.5, expected an? .*integer"),
        (
            {"quantisation": [-0.1] * 4},
            r"\.quantisation\[0\]: found -0.1, expected greater than or equal to 0",
        ),
    ],
    "uncertainty": [
        ({"wind": "none"}, r"\.wind: found 'none', expected"),
        (
            {"entries": ["A[q,q]"] * 2, "parts": [0.1, 0.6]},
            r"\.entries: found A\[q,q\], A\[q,q\], expected different ones",
        ),
    ],
    "turbulence": [
        (
            {"altitude": 3.0, "wind": 7.7},
            r"\.altitude: found 3\.0, expected greater than or equal to 3\.048",
        ),
        (
            {"altitude": 100.0},
            r"\.wind: found none, expected a value at 100 m: it acts below 609\.6 m",
        ),
        (
            AIR | {"altitude": 100.0},
            r"\.sigma: found 1 m/s, expected none at 100 m: it acts above 304\.8 m",
        ),
    ],
    "gusts": [
        # 2 H / V0 at 25 m/s
        (
            {"vertical": GUST | {"length": 30.0, "every": 2.3}},
            (
                r"\.vertical\.every: found 2\.3 s, expected at least 2\.4 s, which the gust takes "
                r"at 25 m/s"
            ),
        )
    ],
    "bias": [({"h": STEP}, r"\.h: found 'h', expected a state of osprey: V, alpha")],
    "sines": [
        ({"q": SINE | {"frequency": 0.0}}, r"\.q\.frequency: found 0\.0, expected greater than 0")
    ],
    "inertial_coupling": [(1.5, r": found 1\.5, expected less than or equal to 1")],
}


@pytest.mark.parametrize(
    "section, values, sentence", [(key, *row) for key, rows in BAD_AIRCRAFT.items() for row in rows]
)
def test_invalid_section_of_aircraft_refused_by_name(
    section: str, values: Any, sentence: str
) -> None:
    with refusing(rf"^aircraft\.{section}{sentence}"):
        aircraft_parameters(rate=500.0, **{section: values})


@pytest.mark.parametrize(
    "section, values, sentence",
    [
        (
            "inertial_coupling",
            0.5,
            r"found 0\.5, expected 0: the airframe f16_lateral has no inertial_coupling",
        )
    ],
)
def test_section_without_data_in_airframe_refused(section: str, values: Any, sentence: str) -> None:
    with refusing(rf"^aircraft\.{section}: {sentence}"):
        aircraft_parameters(airframe="f16_lateral", **{section: values})


@pytest.mark.parametrize(
    "section, values, sentence",
    [
        (
            "gusts",
            {"up": {"q": 1.0}},
            r"\.up: found 'up', expected an axis of the wind: longitudinal, lateral, vert",
        ),
        (
            "inertial_coupling",
            [PRODUCT | {"product": ["q"]}],
            r"\[0\]\.product: found 1 states, expected two of them",
        ),
    ],
)
def test_invalid_section_of_airframe_refused_by_name(
    section: str, values: Any, sentence: str
) -> None:
    with refusing(rf"^airframe\.{section}{sentence}"):
        Airframe.validate_mapping(
            load_airframe("osprey").model_dump() | {section: values}, "airframe"
        )


def test_an_integer_is_accepted_as_a_number(osprey_gust: Scenario) -> None:
    assert osprey_gust.vary(controller={"k_g": 1, "Lambda": [5, 5, 3, 1]}).rise_di().Lambda == (
        5.0,
        5.0,
        3.0,
        1.0,
    )


def test_error_for_unknown_scenario_lists_scenarios() -> None:
    with refusing(r"scenario: found 'osprey', expected .*osprey_gust.*, or the path"):
        find_scenario("osprey")


@pytest.mark.parametrize("name", [5000 * "a", 5000 * "a" + ".yaml"])
def test_name_too_long_for_file_is_unknown_name(name: str) -> None:
    for find in (find_scenario, load_airframe):
        with refusing(r": found 'aaaa.*, expected one of .*osprey"):
            find(name)


def test_bad_airframe_file_is_one_sentence(tmp_path: Path) -> None:
    """Invalid YAML and a duplicate key are refused in one sentence."""
    bad = tmp_path / "bad.yaml"
    whole = (LIBRARY / "osprey.yaml").read_text()
    for text, what in (
        ("speed: 2001-99-99", "month must be in"),
        (5000 * "[", "recursion"),
        (whole + "\nname: other\n", "found the key name twice"),
    ):
        bad.write_text(text)
        with refusing(rf"^airframe .*bad\.yaml: not valid YAML \(.*{what}.*\), expected an"):
            load_airframe(str(bad))


def test_key_may_override_same_key_of_merged_mapping(tmp_path: Path) -> None:
    file = tmp_path / "merged.yaml"
    file.write_text("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\n")
    assert read_yaml(file, "file", "anything")["b"] == {"x": 1, "y": 3}


def test_every_installed_scenario_is_valid() -> None:
    directory = find_scenario("osprey_gust").path.parent
    assert [load_scenario(path).name for path in sorted(directory.glob("*.yaml"))]


EXAMPLES = sorted((REPOSITORY / "examples" / "scenarios").glob("*.yaml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_example_scenario_flies(path: Path) -> None:
    """In two seconds, each section of the scenario reaches the node that uses it."""
    scenario = load_scenario(path).vary(flight={"duration": 2.0})
    assert simulate(scenario).outcome == COMPLETED


SET_BY_THE_FLIGHT = {
    *("aircraft.control_rate", "aircraft.duration", "aircraft.recorded"),
    *("reference_model.u_m_rate", "guidance.y_rate", "guidance.authority_rate"),
    *("controller.y_rate", "bridge.map", "bridge.dry_run", "bridge.first_y"),
    *(f"reference_model.recorded.NAME.{key}" for key in ("source", "time", "value")),
    *("recorder.directory", "recorder.attach", "recorder.metadata_file", "recorder.scenario_file"),
    "flight.use_sim_time",
}
"""Keys that `rise-di fly`, a run and the launch files set, by the scenario and the options."""
IN_NO_FILE = {
    "aircraft.commands",  # by the airframe of JSBSim: docs/topics.md has a line
    *("controller.feedforward.inputs", "controller.feedforward.deviation"),  # of learned models
    *(f"controller.learn.{key}" for key in ("prior", "prior.file", "prior.off", "without")),
    "controller.learn.margin",  # another than that of the file's loop is a choice of the user
}
"""Keys that no shipped and no example file sets. The list only shrinks."""


def test_every_key_is_in_a_file() -> None:
    rows = re.findall(r"^## (.*)$|^\| `([^`]+)`", PAGE.read_text(), re.MULTILINE)
    section = ""
    keys = set()
    for heading, key in rows:
        if heading:
            section = heading.split("`")[1] if heading.startswith("`") else ""
        elif section:
            keys.add(f"{section}.{key}")
    files = [
        *find_scenario("osprey_gust").path.parent.glob("*.yaml"),
        *(REPOSITORY / "examples").rglob("*.yaml"),
    ]
    used = {key for path in files for key in scenario_keys(yaml.safe_load(path.read_text()))}
    # a channel or a name in place of NAME
    unused = {
        key
        for key in keys - used
        if not any(re.fullmatch(re.escape(key).replace("NAME", r"\w+"), known) for known in used)
    }
    assert unused - SET_BY_THE_FLIGHT - IN_NO_FILE == set()


def scenario_keys(tree: Any) -> Iterator[str]:
    """Yield the dotted keys of a scenario file and of their groups. Another file has none."""
    for name, value in tree.items() if isinstance(tree, dict) else ():
        if isinstance(value, dict) and "ros__parameters" in value:
            yield from _keys(value["ros__parameters"], f"{name.removeprefix('/**/')}.")


def _keys(values: Mapping[str, Any], prefix: str) -> Iterator[str]:
    for name, value in values.items():
        yield f"{prefix}{name}"
        if isinstance(value, dict):
            yield from _keys(value, f"{prefix}{name}.")


NAMES = st.text(st.characters(categories=["Ll"]), min_size=1, max_size=4)
TREES = st.recursive(
    st.integers(),
    lambda children: st.dictionaries(NAMES, children, min_size=1, max_size=3),
    max_leaves=10,
)


@given(tree=st.dictionaries(NAMES, TREES, min_size=1, max_size=3))
def test_nest_is_the_inverse_of_flatten(tree: dict[str, object]) -> None:
    assert nest(dict(flatten(tree))) == tree


def test_name_cannot_be_value_and_group() -> None:
    for flat in ({"a": 1, "a.b": 2}, {"a.b": 2, "a": 1}):
        with refusing("both a value and a group"):
            nest(flat)


def test_period_is_whole_number_of_nanoseconds() -> None:
    periods = [period_ns(rate, "rate") for rate in (1.0, 100.0, 500.0, 1000.0, 62.5)]
    assert periods == [10**9, 10**7, 2 * 10**6, 10**6, 16 * 10**6]
    for rate in (3.0, 300.0, 999.0):
        with refusing(f"rate: found {rate:g} Hz"):
            period_ns(rate, "rate")


def test_divide_returns_the_number_of_parts() -> None:
    assert divide(10, 2, "step", "it") == 5
    with refusing("step"):
        divide(10, 0, "step", "it")


def test_output_that_cannot_be_written_is_one_sentence() -> None:
    path = "/proc/none/file"
    for key, place in (("--csv", f"--csv: {path}"), ("", path)):
        with pytest.raises(ParameterError) as rejected, writing(key, path, "the path of a file"):
            Path(path).write_text("")
        assert (
            str(rejected.value)
            == f"{place} cannot be written (No such file or directory), expected the path of a file"
        )


RESULTS = {"flight_campaign.statistics"}  # modules with sets that only the stack writes


def schemas(base: type[Config] = Config) -> Iterator[type[Config]]:
    """Yield the parameter sets of files, nodes and laws."""
    yield from (*SECTIONS.values(), Airframe, Definition)
    for name in laws.names():
        with suppress(ParameterError):  # loaded, but of the full state
            laws.schema(name)
    for schema in base.__subclasses__():
        if schema.__module__ not in RESULTS and not schema.__module__.partition(".")[0].startswith(
            "test"
        ):
            yield schema
        yield from schemas(schema)


def rules_of_numbers(annotation: Any, rules: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the rules of each number in a type, also within lists and tables."""
    origin = get_origin(annotation)
    parts = get_args(annotation)
    if origin is Annotated:
        own = {rule: limit for field in parts[1:] for rule, limit in field.rules.items()}
        yield from rules_of_numbers(parts[0], own | dict(rules))
    elif origin in {Union, UnionType, tuple, dict}:
        for part in parts:
            yield from rules_of_numbers(part, rules if origin in {Union, UnionType} else {})
    elif annotation in {int, float}:
        yield rules


@pytest.mark.parametrize(
    "schema", sorted(set(schemas()), key=repr), ids=lambda schema: schema.__name__
)
def test_each_number_has_lower_and_upper_bound(schema: type[Config]) -> None:
    """Only a type that allows .inf and NaN may lack bounds.

    There they mean no end stop, never, or no value.
    """
    for name, field in schema.model_fields.items():
        for rules in rules_of_numbers(field.annotation, field.rules):
            if not rules.get("allow_inf_nan"):
                assert rules.keys() & {"ge", "gt"}, name
                assert rules.keys() & {"le", "lt"}, name

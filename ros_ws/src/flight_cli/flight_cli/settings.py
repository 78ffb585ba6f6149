# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement the option --set, which changes parameters of a scenario by their keys."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from flight_analysis.closed_loop.scenario import SCHEMAS, Scenario
from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_cli.words import option
from flight_core.files import parse_yaml
from flight_core.parameters import Config, flatten, nest, one_of, require


def settings_option() -> Any:
    """Declare the option --set of a command."""
    text = "Parameter to change, as in controller.k_g=2.0; may be repeated."
    return option(text, "--set", metavar="KEY=VALUE", autocompletion=setting_names)


def setting_names(incomplete: str) -> list[str]:
    """Return the keys of shipped scenarios that begin with `incomplete`, each followed by "="."""
    keys: set[str] = set()
    for path in LIBRARY.glob("*.yaml"):
        scenario = find_scenario(path.stem)
        for name in SCHEMAS:
            section = getattr(scenario, name)
            if section is not None:
                keys.update(key for key, _ in flatten(section.model_dump(), f"{name}."))
    return sorted(f"{key}=" for key in keys if key.startswith(incomplete))


def parse_settings(
    settings: Sequence[str] | None,
    owner: str = "scenario",
    sections_with: Callable[[str], Sequence[str]] = lambda key: (),
) -> dict[str, Any]:
    """Parse the words of --set into values by key, for example controller.k_g.

    `owner` is the only section to which a key can belong. "scenario" allows every section. Raises
    ParameterError for an invalid setting. If the user left out the section, the error names the
    sections that `sections_with` returns for the key.
    """
    changes: dict[str, Any] = {}
    for text in settings or ():
        name, equals, value = text.partition("=")
        key = name.strip()
        section = key.partition(".")[0]
        sections = tuple(SCHEMAS) if owner == "scenario" else (owner,)
        fits = bool(equals) and section != key and section in sections
        near = [f"{each}.{text.strip()}" for each in sections_with(key)]
        expected = (
            f"the section too: {' or '.join(near)}"
            if near
            else f"a parameter of the {owner} and its value, as in controller.k_g=2.0"
        )
        known = f"; the section is {one_of(sections, section)}"
        is_unknown = not near and section not in sections
        require(fits, "--set", repr(text), expected + known * is_unknown)
        require(key not in changes, "--set", "a parameter twice", "each once")
        changes[key] = parse_yaml(value, f"--set {text!r}", "a value")
    return changes


def with_settings(scenario: Scenario, settings: Sequence[str] | None) -> Scenario:
    """Return the scenario with the changes of --set. Raises ParameterError if they are invalid."""
    sections: dict[str, dict[str, Any]] = defaultdict(dict)
    for name, value in parse_settings(settings, "scenario", scenario.sections_with).items():
        section, _, key = name.partition(".")
        sections[section][key] = value
    return scenario.vary(
        **{
            name: _changed(getattr(scenario, name, None), changes)
            for name, changes in sections.items()
        }
    )


def _changed(section: object, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a section that change. A group of keys changes as a whole."""
    if not isinstance(section, Config):
        return nest(changes)
    values = section.changed(changes)
    return {name: values[name] for name in {key.partition(".")[0] for key in changes}}

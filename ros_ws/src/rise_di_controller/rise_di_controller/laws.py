# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the control laws of the controller by name.

They are RISE-DI, and the laws that installed packages register. A package registers a law by an
entry point in setup.py (see docs/laws.md):

    entry_points={"rise_di_controller.laws": ["pi = control_laws.pi:PiConfig"]}
"""

from collections.abc import Mapping, Set
from contextlib import suppress
from functools import cache
from importlib.metadata import EntryPoints, entry_points
from typing import Any

from flight_core.parameters import ParameterError, require
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

GROUP = "rise_di_controller.laws"
DEFAULT = "rise_di"


@cache
def _registered() -> EntryPoints:
    return entry_points(group=GROUP)


def names() -> tuple[str, ...]:
    """Return the names of the laws, sorted.

    Returns:
        The names that `controller.law` of a scenario takes.

    Examples:
        >>> "rise_di" in rise_di.laws()
        True
    """
    return tuple(sorted({DEFAULT, *_registered().names}))


def schema(name: object) -> type[ControllerConfig]:
    """Return the class of the parameters of a law.

    Args:
        name: Name of a law, as in `laws`.

    Returns:
        The parameter set of the law. `model_fields` has the fields with descriptions.

    Raises:
        ParameterError: The law is not registered, registered twice, or not loadable.

    Examples:
        >>> rise_di.law_schema("rise_di").__name__
        'RiseDiConfig'
    """
    if name == DEFAULT:
        return RiseDiConfig
    if name not in names():
        raise ParameterError(
            f"law: found {name!r}, expected a registered law: {', '.join(names())}"
        )
    entries = {entry.value: entry for entry in _registered().select(name=str(name))}
    if len(entries) > 1:
        raise ParameterError(
            f"law: found {name!r}, registered as {' and as '.join(sorted(entries))}, expected "
            "one of them"
        )
    try:
        schema = next(iter(entries.values())).load()
    except (ImportError, AttributeError) as error:
        raise ParameterError(
            f"law: found {name!r}, which cannot be loaded ({error}), expected an installed package"
        ) from None
    if not (isinstance(schema, type) and issubclass(schema, ControllerConfig)):
        raise ParameterError(
            f"law: found {name!r}, registered as {schema!r}, expected a subclass of "
            "ControllerConfig"
        )
    if schema.needs:
        raise ParameterError(
            f"law: found {name!r}, which needs {schema.needs}, expected a law of y and y_m: the "
            "topics have no more"
        )
    return schema


class AnyLaw(ControllerConfig):
    """The section `controller` of a scenario, under any law.

    Its key `law` names the law, RISE-DI by default.
    """

    @classmethod
    def keys_beside(cls, values: Mapping[str, Any]) -> Set[str]:
        """Return the keys of the law that `values` names.

        If there is no such law, return the keys that every law has.
        """
        with suppress(ParameterError):
            return schema(values.get("law", DEFAULT)).model_fields.keys()
        return ControllerConfig.model_fields.keys()

    @classmethod
    def validate_mapping(cls, values: Mapping[str, Any], where: str) -> ControllerConfig:  # type: ignore[override]
        """Build the parameters of the law that `values` names. Raises ParameterError if invalid."""
        name = values.get("law", DEFAULT)
        try:
            config = schema(name)
        except ParameterError as error:
            raise ParameterError(f"{where}.{error}") from None
        default_fields = {} if name == DEFAULT else schema(DEFAULT).model_fields
        names = [key for key in config.model_fields if key not in ControllerConfig.model_fields]
        expected = f"keys of the law {name}: {', '.join(names) or 'none'}"
        for key in values:
            foreign = key in default_fields and key not in config.model_fields
            require(not foreign, f"{where}.{key}", f"a parameter of {DEFAULT}", expected)
        return config.validate_mapping(values, where)

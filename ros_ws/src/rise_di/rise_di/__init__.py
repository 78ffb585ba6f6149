# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The Python interface of the RISE-DI flight stack, in one import.

Each name loads its module when it is first used, and no module needs ROS.

    import rise_di

    scenario = rise_di.find_scenario("osprey_servo").vary(controller={"beta": [2.0, 2.0, 1.0, 1.0]})
    tape = rise_di.simulate(scenario)
    q, t = tape["y"]["q"], tape.time("y")

The names keep their meaning within a minor version (see CHANGELOG.md).
"""

import ast
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path


def _homes() -> Iterator[tuple[str, tuple[str | None, str]]]:
    """Yield each name that __init__.pyi imports, with the module that has it and its name there."""
    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    for statement in ast.parse(stub).body:
        if isinstance(statement, ast.ImportFrom):
            for alias in statement.names:
                yield alias.asname or alias.name, (statement.module, alias.name)


_HOME = dict(_homes())
__all__ = sorted(_HOME)  # noqa: PLE0605 - the names of the stub


def __getattr__(name: str) -> object:
    """Load the module of a name at the first use of the name."""
    if name == "__version__":
        from importlib.metadata import version  # noqa: PLC0415 - takes as long as all else here

        value: object = version("rise-di")
    elif name in _HOME:
        module, attribute = _HOME[name]
        value = getattr(import_module(str(module)), attribute)
    else:
        raise AttributeError(f"module 'rise_di' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


# gymnasium takes longer to load than everything else here. A program that makes environments by
# name has loaded it already.
if "gymnasium" in sys.modules:
    from rise_di.environment_ids import register

    register()

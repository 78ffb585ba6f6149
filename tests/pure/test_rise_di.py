# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The Python interface `rise_di`: its names, its laziness, its types, its sentences about wrong input."""

import ast
from pathlib import Path

import pytest
from tests.pure.test_import_rule import modules_loaded_by

import rise_di

pytestmark = pytest.mark.package("rise_di")


def test_every_name_loads() -> None:
    assert all(getattr(rise_di, name) is not None for name in rise_di.__all__)


def type_checker_imports() -> set[tuple[str | None, str, str]]:
    """Module, name and name in `rise_di` of each import for type checkers."""
    tree = ast.parse(Path(str(rise_di.__file__)).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {(node.module, alias.name, alias.asname or alias.name) for node in imports for alias in node.names}


def test_type_checkers_see_the_table() -> None:
    homes = vars(rise_di)["HOMES"]
    table = {(module, name.split(" as ")[0], name.split(" as ")[-1]) for module, names in homes.items() for name in names}
    assert type_checker_imports() == table


def test_the_import_loads_no_library() -> None:
    assert modules_loaded_by("import rise_di") - modules_loaded_by("import typing, importlib") == {"rise_di"}


def test_completion_knows_every_name() -> None:
    names = {name for _, _, name in type_checker_imports()}
    assert {*names, "__version__"} == {*rise_di.__all__, "__version__"} == set(dir(rise_di))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'rise_di' has no attribute 'simulat'"):
        rise_di.simulat  # type: ignore[attr-defined]  # noqa: B018

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that functions fit on a page of an editor, and that a file is not too long to remember."""

import ast

from tests.conftest import REPOSITORY

SOURCES = REPOSITORY / "ros_ws" / "src"

MAX_FUNCTION = 60  # lines beside the docstring
MAX_FILE = 600  # lines


def test_functions_and_files_are_short() -> None:
    long = []
    for path in sorted(SOURCES.rglob("*.py")):
        name = path.relative_to(SOURCES)
        text = path.read_text()
        if text.count("\n") > MAX_FILE:
            long.append(f"{name}")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = code_lines(node)
                if lines > MAX_FUNCTION:
                    long.append(f"{name}:{node.lineno}: {node.name} has {lines} lines")
    assert not long, "\n".join(long)


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines of a function without its docstring."""
    has_docstring = ast.get_docstring(function) is not None
    return length(function) - (length(function.body[0]) if has_docstring else 0)


def length(node: ast.stmt) -> int:
    """Count the lines of a statement."""
    return (node.end_lineno or node.lineno) - node.lineno + 1

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test how the tests over DDS wait.

They use only tests/ros/waiting.py, never wait for a time, and wait for each message that they read.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROS = Path(__file__).resolve().parents[1] / "ros"
PROGRAMS = {
    "autopilot.py",
    "mavlink_autopilot.py",
    "relay.py",
    "attacker.py",
    "stopwatch.py",
    "foreign.py",
}
HELPERS = PROGRAMS | {"waiting.py", "test_lockstep_faults.py"}
"""The helper; programs that the tests start, whose time is that of what they simulate; faults at
random instants."""


def appended(tree: ast.AST) -> set[str]:
    """Return the names of the lists to which a subscription appends.

    The call is `create_subscription(..., NAME.append, ...)`.
    """
    calls = (
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and name_of(node.func) == "create_subscription"
    )
    methods = (
        word
        for call in calls
        for word in call.args
        if isinstance(word, ast.Attribute) and word.attr == "append"
    )
    return {name_of(method.value) for method in methods}


def name_of(node: ast.AST) -> str:
    """Return the last name of an expression. For `a.b["c"]` it is b."""
    if isinstance(node, ast.Subscript):
        return name_of(node.value)
    return (
        node.attr
        if isinstance(node, ast.Attribute)
        else node.id
        if isinstance(node, ast.Name)
        else ""
    )


def aliases(tree: ast.AST) -> set[str]:
    """Return the names of a peer's lists, as in `NAME = peer.received["y"]`."""
    assigned = (node for node in ast.walk(tree) if isinstance(node, ast.Assign))
    pairs = (
        pair
        for node in assigned
        for pair in zip(targets(node.targets[0]), targets(node.value), strict=False)
    )
    return {
        name_of(target)
        for target, value in pairs
        if isinstance(value, ast.Subscript) and name_of(value) == "received"
    }


def targets(node: ast.expr) -> list[ast.expr]:
    return node.elts if isinstance(node, ast.Tuple) else [node]


def is_end(node: ast.expr) -> bool:
    """Return whether an index is the one of the first or of the last element."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        node = node.operand
    return isinstance(node, ast.Constant) and isinstance(node.value, int)


def faults(source: str) -> Iterator[str]:
    """Yield each wait for a time, and each index into a list that a message must have filled.

    Each has its line.
    """
    tree = ast.parse(source)
    lists = appended(tree) | aliases(tree) | {"received"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and name_of(node.func) in {"sleep", "spin"}:
            yield f"{node.lineno}: waits for a time, expected until(condition, because)"
        if isinstance(node, ast.Subscript) and is_end(node.slice) and name_of(node.value) in lists:
            yield (
                f"{node.lineno}: index into {ast.unparse(node.value)}, expected what until() "
                "returned, or last()"
            )


@pytest.mark.parametrize(
    "source, found",
    [
        ("time.sleep(0.1)", 1),
        ("peer.spin(0.3, each=send)", 1),
        ("peer.until(lambda: condition, 'a u')", 0),
        ("x = peer.received['u'][0]", 1),
        ("u = peer.received['u']\nx = u[-1]", 1),
        ("u, y = peer.received['u'], peer.received['y']\nx = y[-1]", 1),
        ("node.create_subscription(Joy, 'joy', self.joys.append, 1)\nx = setup.joys[0]", 1),
        ("node.create_subscription(Joy, 'joy', joys.append, 1)\nx = joys[2:]", 0),
        ("x = process.lines[-1]", 0),
        ("x = peer.last('u')", 0),
    ],
)
def test_patterns_are_found(source: str, found: int) -> None:
    assert len(list(faults(source))) == found


def test_tests_over_topics_wait_for_conditions() -> None:
    files = [path for path in sorted(ROS.rglob("*.py")) if path.name not in HELPERS]
    lines = [
        f"{path.relative_to(ROS)}:{fault}" for path in files for fault in faults(path.read_text())
    ]
    assert not lines, "\n".join(lines)

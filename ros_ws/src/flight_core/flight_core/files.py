# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that people write: found without an exception, read as YAML, refused with one sentence."""

import math
import os
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from flight_core.parameters import ParameterError, require

# What PyYAML raises: its own errors where the text is no YAML, the others where a value is not what it looks like ("0b_",
# "2001-99-99", "!!bool 2") or nests too deeply.
NOT_YAML = (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)

MAX_FILE_BYTES = 1 << 19
"""Bytes: a scenario has 4 kB, metadata.yaml of 500 topics less than this. PyYAML takes up to 0.7 kB and 30 us a byte."""

MAX_YAML_NODES = 100_000
"""Values of a file with its aliases written out: a few lines of them may stand for billions."""


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice, of which YAML otherwise keeps the last, and aliases that stand for too much."""

    def get_single_node(self) -> Any:
        node = super().get_single_node()
        if node is not None and _size(node, {}) > MAX_YAML_NODES:
            raise yaml.composer.ComposerError(None, None, f"found more than {MAX_YAML_NODES} values", node.start_mark)
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in seen:
                    raise yaml.composer.ComposerError(None, None, f"found the key {key.value} twice", key.start_mark)
                seen.add((key.tag, key.value))
        return node


def _size(node: yaml.Node, known: dict[int, float]) -> float:
    """How many nodes there are with all aliases written out; infinite for a node inside itself."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = math.inf
        children = chain.from_iterable(node.value) if isinstance(node, yaml.MappingNode) else node.value
        known[id(node)] = 1 + sum(_size(child, known) for child in children)
    return known[id(node)]


def is_file(path: Path) -> bool:
    """Whether there is a file; a path that no file can have, such as one too long, is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether there is a folder, likewise."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def open_nonblocking(path: str | Path) -> BinaryIO:
    """A file for reading; a pipe to which nobody writes is an empty one, and not waited for. Raises OSError, ValueError."""
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))


def read_yaml(path: Path, key: str, expected: str) -> Any:
    """Content of a YAML file. Raises ParameterError for a file that cannot be read, is no YAML or has a key twice.

    `key` names the file in the sentence, `expected` what it should be.
    """
    try:
        with open_nonblocking(path) as stream:
            content = stream.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise ParameterError(f"{key}: cannot be read ({error}), expected {expected}") from None
    require(len(content) <= MAX_FILE_BYTES, key, f"more than {MAX_FILE_BYTES} bytes", expected)
    return parse_yaml(content, key, expected)


def parse_yaml(content: bytes | str, key: str, expected: str) -> Any:
    """YAML that came from elsewhere than a file; `read_yaml` otherwise."""
    try:
        text = content if isinstance(content, str) else content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ParameterError(f"{key}: cannot be read ({error}), expected {expected}") from None
    try:
        return yaml.load(text, _Loader)  # noqa: S506 - a SafeLoader
    except NOT_YAML as error:
        what = " ".join(str(error).split()) or type(error).__name__
        raise ParameterError(f"{key}: not valid YAML ({what}), expected {expected}") from None

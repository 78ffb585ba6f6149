# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that people write: found without an exception, read as YAML, refused with one sentence."""

from pathlib import Path
from typing import Any

import yaml

from flight_core.parameters import ParameterError

# What PyYAML raises: its own errors where the text is no YAML, the others where a value is not what it looks like ("0b_",
# "2001-99-99", "!!bool 2") or nests too deeply.
NOT_YAML = (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, RecursionError, ValueError)


class _Loader(yaml.SafeLoader):
    """Refuses a key that is given twice, of which YAML otherwise keeps the last."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in seen:
                    raise yaml.composer.ComposerError(None, None, f"found the key {key.value} twice", key.start_mark)
                seen.add((key.tag, key.value))
        return node


def is_file(path: Path) -> bool:
    """Whether there is a file; a path that no file can have, such as one too long, is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def read_yaml(path: Path, key: str, expected: str) -> Any:
    """Content of a YAML file. Raises ParameterError for a file that cannot be read, is no YAML or has a key twice.

    `key` names the file in the sentence, `expected` what it should be.
    """
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _Loader)  # noqa: S506 - a SafeLoader
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f"{key}: cannot be read ({error}), expected {expected}") from None
    except NOT_YAML as error:
        what = " ".join(str(error).split()) or type(error).__name__
        raise ParameterError(f"{key}: not valid YAML ({what}), expected {expected}") from None

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the template of a node's parameter file, with default and meaning of every key."""

import textwrap
from collections.abc import Iterator

from flight_core.fields import REQUIRED
from flight_core.files import dump_yaml
from flight_core.parameters import Config

WIDTH = 96
LEAD = """# Parameters of {name}. Give each needed key a value.
/**/{name}:
  ros__parameters:
"""


def parameter_template(name: str, schema: type[Config]) -> str:
    """Return the text of a parameter file for the node `name`, whose parameters are `schema`.

    A key without a default is written as a comment. If the key is required, the comment says so.
    """
    return LEAD.format(name=name) + "".join(f"{line}\n" for line in _lines(schema))


def _lines(schema: type[Config]) -> Iterator[str]:
    for name, field in schema.model_fields.items():
        meaning = field.description
        if field.default is REQUIRED:
            yield from (f"    # {line}" for line in textwrap.wrap(f"needed: {meaning}", WIDTH))
            yield f"    # {name}:"
        else:
            yield from (f"    # {line}" for line in textwrap.wrap(meaning, WIDTH))
            is_empty = field.default in (None, (), {}, "")
            value = "" if is_empty else f" {dump_yaml(_plain(field.default)).splitlines()[0]}"
            yield f"    {'# ' if is_empty else ''}{name}:{value}"


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value

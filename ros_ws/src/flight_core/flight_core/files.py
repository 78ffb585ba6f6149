# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read and write files, with YAML, checks of existence and atomic replacement.

If a file cannot be read or written, the functions raise ParameterError with a sentence.
"""

import errno
import math
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import yaml
from yaml.composer import Composer

from flight_core.arguments import FilePath, as_path
from flight_core.parameters import ParameterError, one_of, require
from flight_core.text import printable

# Exceptions of PyYAML. It raises YAMLError for invalid syntax, and the others for an invalid scalar
# ("0b_", "2001-99-99", "!!bool 2") or for nesting that is too deep.
NOT_YAML = (
    yaml.YAMLError,
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)

INT_TAG = "tag:yaml.org,2002:int"
FLOAT_TAG = "tag:yaml.org,2002:float"

MAX_FILE_BYTES = 1 << 19
"""Largest size of a file, bytes. A scenario has 4 kB, and even the metadata.yaml of 500 topics is
smaller than this limit. PyYAML needs up to 0.2 kB of memory and 5 us for each byte."""

MAX_YAML_NODES = 100_000
"""Largest number of values in a file, counted after its aliases are expanded. A few lines of nested
aliases can expand to billions of values."""


INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)|0o[0-7]+|0x[0-9a-fA-F]+")
FLOAT = re.compile(
    r"[-+]?(\.[0-9]+|(0|[1-9][0-9]*)(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
)
"""INTEGER and FLOAT match the numbers of the core schema of YAML 1.2.2, section 10.3.2, except
those with a leading zero. YAML 1.1 reads 060 as 48, and YAML 1.2 as 60. YAML 1.1 also reads 1_000
as 1000 and 1:00 as 60, and the core schema has neither. Here all of these are strings, so that no
number is guessed."""


LEADING_ZERO = re.compile(r"[-+]?0[0-9]+")


class _Loader(Composer, yaml.CSafeLoader):
    """Reads numbers as YAML 1.2 does, and rejects duplicate keys and very large texts.

    PyYAML would keep the last of several equal keys. A text is too large if its aliases expand it
    to more than MAX_YAML_NODES values. libyaml parses the text, nine times as fast as Python. The
    nodes of the text are composed in Python, because libyaml's binding exhausts the stack if they
    are nested deeply.
    """

    def __init__(self, stream: str) -> None:
        yaml.CSafeLoader.__init__(self, stream)
        Composer.__init__(self)

    def get_single_node(self) -> Any:
        node = super().get_single_node()
        if node is not None and _expanded_size(node, {}) > MAX_YAML_NODES:
            raise yaml.composer.ComposerError(
                None, None, f"found more than {MAX_YAML_NODES} values", node.start_mark
            )
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        keys = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in keys:
                    raise yaml.composer.ComposerError(
                        None, None, f"found the key {key.value} twice", key.start_mark
                    )
                keys.add((key.tag, key.value))
        return node


class _Dumper(yaml.SafeDumper):
    """Quotes any string that `_Loader` would read as a number."""


def _integer(loader: _Loader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node), 0)


def _sequence(loader: _Loader, node: yaml.SequenceNode) -> list[Any]:
    return loader.construct_sequence(node, deep=True)


for _class in (_Loader, _Dumper):
    _class.yaml_implicit_resolvers = {
        first: [*rows] for first, rows in _class.yaml_implicit_resolvers.items()
    }
    if _class is _Loader:
        for _rows in _class.yaml_implicit_resolvers.values():
            _rows[:] = [row for row in _rows if row[0] not in {INT_TAG, FLOAT_TAG}]
    for _tag, _pattern in ((INT_TAG, INTEGER), (FLOAT_TAG, FLOAT)):
        _class.add_implicit_resolver(
            _tag, re.compile(rf"(?:{_pattern.pattern})\Z"), list("-+.0123456789")
        )
_Loader.add_constructor(INT_TAG, _integer)
# launch_ros writes a list of parameters as a tuple of Python, which rcl reads as a list
_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _sequence)


def dump_yaml(value: object, *, flow: bool | None = None) -> str:
    """Write a value as YAML text that `parse_yaml` can read.

    A list of scalars is written in one line. If `flow` is False, everything is written in blocks.
    """
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, default_flow_style=flow, width=128)


def _expanded_size(node: yaml.Node, sizes: dict[int, float]) -> float:
    """Count the nodes below a node, and the node itself, after its aliases are expanded.

    The count is infinite for a recursive node. `sizes` caches the counts by identity.
    """
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in sizes:
        sizes[id(node)] = math.inf
        children = (
            chain.from_iterable(node.value) if isinstance(node, yaml.MappingNode) else node.value
        )
        sizes[id(node)] = 1 + sum(_expanded_size(child, sizes) for child in children)
    return sizes[id(node)]


def comment(lines: Iterable[str]) -> str:
    """Write lines as comments of a YAML file.

    Unprintable characters, such as line ends in the name of a file, become escapes.
    """
    return "".join(f"# {printable(line)}".rstrip() + "\n" for line in lines)


def is_file(path: Path) -> bool:
    """Return whether the path is a file.

    Returns False for an invalid path, such as one that is too long.
    """
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises OSError and ValueError


def is_folder(path: Path) -> bool:
    """Return whether the path is a folder. Returns False for an invalid path."""
    return os.path.isdir(path)  # noqa: PTH112 - as above


def names_in(library: Path) -> list[str]:
    """List the names of the YAML files in a folder, sorted."""
    return sorted(path.stem for path in library.glob("*.yaml"))


CHECKOUT = Path(__file__).resolve().parents[4]
"""Root of the sources, which contains `examples`. In an installation from a wheel, this is some
other folder."""

EXAMPLES = "examples/"  # a path that begins like this may also start at the root of the sources


def find_file(name: FilePath, library: Path, key: str, kind: str) -> Path:
    """Find a file by its name in a library, or by the path of a .yaml file.

    A path that begins with `examples/` is found from any working folder. Raises ParameterError,
    with the known names, if there is no such file. `key` and `kind`, such as "scenario" and "a
    scenario file", are words for its message.
    """
    known = names_in(library)
    path_text = f"the path of {kind} (.yaml)"
    text = os.fspath(as_path(name, key, f"{one_of(known, '')}, or {path_text}"))
    expected = f"{one_of(known, text)}, or {path_text}"
    path = Path(text) if text.endswith(".yaml") else library / f"{text}.yaml"
    if text.endswith(".yaml") and not path.is_absolute():
        expected = f"{expected}, from the folder {Path.cwd()}"
        if text.startswith(EXAMPLES) and not is_file(path):
            path = CHECKOUT / text
    near = Path(f"{text.removesuffix('.yml')}.yaml")
    require(is_file(path), key, repr(text), f"{near}, which exists" if is_file(near) else expected)
    return path


def display_path(path: Path) -> str:
    """Show a path, relative to the working folder if it lies below it.

    Unprintable characters become escapes.
    """
    return printable(str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path))


def open_nonblocking(path: str | Path) -> BinaryIO:
    """Open a file for reading without waiting for a writer.

    A pipe without a writer reads as empty. Raises OSError or ValueError.
    """
    return open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))


@contextmanager
def writing(key: str, path: str | Path, expected: str = "a writable folder") -> Iterator[None]:
    """Turn an OSError inside the block into a ParameterError.

    Its message has `key`, which can be empty, the `path` that cannot be written, and `expected`.
    """
    try:
        yield
    except OSError as error:
        place = f"{key}: {path}" if key else f"{path}"
        raise ParameterError(
            f"{place} cannot be written ({error.strerror or error}), expected {expected}"
        ) from None


def read_file(path: Path, key: str, expected: str) -> bytes:
    """Read an input file of at most MAX_FILE_BYTES.

    In an error, `key` names the file, and `expected` says what it should contain. Raises
    ParameterError if the file cannot be read or is longer.
    """
    try:
        with open_nonblocking(path) as stream:
            content = stream.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or error  # the key names the file
        raise ParameterError(f"{key}: cannot be read ({reason}), expected {expected}") from None
    return limited(content, key, expected)


def limited(content: bytes, key: str, expected: str) -> bytes:
    """Return the content if it has at most MAX_FILE_BYTES, or raise ParameterError."""
    require(len(content) <= MAX_FILE_BYTES, key, f"more than {MAX_FILE_BYTES} bytes", expected)
    return content


def read_yaml(path: Path, key: str, expected: str) -> Any:
    """Read a YAML file.

    Raises ParameterError as `read_file` does, and if the content is not YAML or has a duplicate
    key.
    """
    return parse_yaml(read_file(path, key, expected), key, expected)


def parse_yaml(content: bytes | str, key: str, expected: str) -> Any:
    """Parse YAML text. Raises ParameterError as `read_yaml` does."""
    try:
        text = content if isinstance(content, str) else content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ParameterError(f"{key}: cannot be read ({error}), expected {expected}") from None
    try:
        return yaml.load(text, _Loader)  # noqa: S506 - a SafeLoader
    except NOT_YAML as error:
        what = " ".join(str(error).split()) or type(error).__name__
        raise ParameterError(f"{key}: not valid YAML ({what}), expected {expected}") from None


def require_no_octal(content: bytes | str, key: str) -> None:
    """Raise ParameterError if YAML has an integer that begins with 0.

    rcl reads 0100 as 64, because it calls strtoll with base 0.
    """
    numbers = []
    with suppress(*NOT_YAML):  # rcl itself reports invalid YAML
        scalars = (
            token
            for token in yaml.scan(content, yaml.CSafeLoader)
            if isinstance(token, yaml.ScalarToken)
        )
        numbers = [
            scalar for scalar in scalars if scalar.plain and LEADING_ZERO.fullmatch(scalar.value)
        ]
    if numbers:
        octal = f"{numbers[0].value!r} in line {numbers[0].start_mark.line + 1}"
        raise ParameterError(f"{key}: found {octal}, expected a number without a 0 before it")


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Write a file atomically, so that it appears at `path` when the block ends.

    The block writes to the stream of a fresh file in the same folder, which replaces the file at
    `path` at the end. If the block fails, the fresh file is removed. After a crash, a kill or a
    full disk, `path` has either the new or the old content. If `path` is a link, the file replaces
    the link, and the target of the link stays as it is. Raises OSError if the file cannot be
    written, or if `path` is a folder or a device.
    """
    with suppress(FileNotFoundError):  # also raised for a link to nothing
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise (
                OSError(errno.EISDIR, os.strerror(errno.EISDIR))
                if stat.S_ISDIR(mode)
                else OSError(errno.EINVAL, "No regular file")
            )
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".new-")
    fresh = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            yield stream
            stream.flush()
            os.fchmod(descriptor, 0o666 & ~_umask())
            os.fsync(descriptor)
        fresh.replace(path)
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise


def _umask() -> int:
    """Return the permissions that this process withholds from new files.

    umask(2) returns the mask only when it sets a new one, so the mask is set and restored.
    """
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file atomically, as `replacing` does, with text as UTF-8. May raise OSError."""
    with replacing(path) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)


def link_latest(run: Path) -> None:
    """Point runs/latest at a run, atomically. Raises ParameterError if no link can be made."""
    latest = run.parent / "latest"
    temporary = run.parent / f".latest-{os.getpid()}"
    with writing("", latest, "a link to the last run"):
        temporary.symlink_to(run.name)
        try:
            temporary.replace(latest)
        except OSError:
            temporary.unlink()
            raise

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the readers of files with random content.

Any content is read or rejected with one sentence, in bounded time and memory.
"""

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.conftest import REPOSITORY, few
from tests.fuzz.targets import SEEDS, TARGETS, log, rejected, write_run
from tests.joint_states import JOINT_STATE, vector

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.recorded_flight import read_flight
from flight_analysis.report.run_report import rewrite_report
from flight_log.tape_reader import read_run

CORPUS = REPOSITORY / "tests" / "corpus"


def test_corpus_read_or_rejected_in_bounded_time_and_memory() -> None:
    command = [sys.executable, "-m", "benchmarks.fuzz", "all", "--replay"]
    process = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=300, check=False
    )
    assert process.returncode == 0, process.stderr
    for target in TARGETS:
        files = list((CORPUS / target).iterdir())
        assert files
        assert f"{target}: {len(files)} inputs read or refused" in process.stdout


def test_the_corpus_is_small() -> None:
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < 300_000


# Bytes: truncated, changed, moved

BINARY = {
    name: SEEDS[name]() for name in ("mcap", "message", "route", "vehicle_log", "targets", "page")
}


@st.composite
def damaged(draw: st.DrawFn, name: str) -> bytes:
    """Draw a valid input that is truncated, or has changed, removed or duplicated bytes."""
    data = bytearray(draw(st.sampled_from(BINARY[name])))
    for _ in range(draw(st.integers(1, 4))):
        place, end = sorted((draw(st.integers(0, len(data))), draw(st.integers(0, len(data)))))
        match draw(st.sampled_from(("cut", "change", "number", "take", "twice"))):
            case "cut":
                del data[place:]
            case "change":
                data[place : place + 1] = draw(st.binary(min_size=1, max_size=2))
            case "number":
                data[place : place + 8] = draw(st.sampled_from(NUMBERS)).to_bytes(8, "little")
            case "take":
                del data[place:end]
            case "twice":
                data[end:end] = data[place : place + 200]
    return bytes(data)


NUMBERS = [0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1]


# Text: unexpected values at any place

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from(
        [
            2**63,
            -(2**80),
            10**4000,
            1e308,
            -1e-320,
            float("nan"),
            float("inf"),
            -0.0,
            1e-9,
            3.0,
            1000.0,
        ]
    )
    | st.text(max_size=8)
    | st.sampled_from(
        [
            "osprey",
            "jsbsim:c172p",
            "/dev/zero",
            "../x.yaml",
            "a\x1b[2Jb",
            "\x85",
            "x" * 5000,
            "2001-01-01",
            "q",
        ]
    )
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)


def to_yaml(tree: Any) -> str:
    return str(yaml.safe_dump(tree, allow_unicode=True))


@st.composite
def edited(draw: st.DrawFn, seeds: list[Any], write: Callable[[Any], str] = to_yaml) -> bytes:
    """Draw a valid file with some other values or keys."""
    tree = yaml.safe_load(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 3))):
        node = tree
        for _ in range(draw(st.integers(0, 6))):
            if not isinstance(node, dict | list) or not node:
                break
            key = draw(
                st.sampled_from(
                    sorted(node, key=str) if isinstance(node, dict) else range(len(node))
                )
            )
            deeper = node[key]
            if not isinstance(deeper, dict | list) or not deeper or draw(st.integers(0, 3)) == 0:
                match draw(st.sampled_from(("value", "key", "none"))):
                    case "value":
                        node[key] = draw(VALUES)
                    case "key" if isinstance(node, dict):
                        node[draw(SCALARS)] = node.pop(key)
                    case _:
                        node.pop(key)
                break
            node = deeper
    return write(tree).encode("utf-8", "surrogatepass")


INPUTS = {
    "mcap": damaged("mcap"),
    "message": damaged("message") | st.binary(max_size=200),
    "route": damaged("route") | edited(SEEDS["route"]()[:3]),
    **{name: edited(SEEDS[name]()) for name in ("scenario", "airframe", "map")},
    "export": st.lists(
        st.text(max_size=20) | st.sampled_from(["*/", "/*", '"', "\\", "??/", "q", "a.b"]),
        max_size=8,
    ).map(lambda names: "\n".join(names).encode("utf-8", "surrogatepass")),
    "metadata": edited(SEEDS["metadata"]()) | st.binary(max_size=100),
    "vehicle_log": damaged("vehicle_log"),
    "targets": damaged("targets")
    | st.lists(st.floats(), max_size=200).map(
        lambda values: struct.pack(f"<{len(values)}d", *values)
    ),
    "control": edited(SEEDS["control"](), write=json.dumps),
    "page": damaged("page") | st.binary(max_size=200),
}


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # pymavlink leaves a damaged file open
@few
@given(st.data())
def test_damaged_log_or_file_of_other_values_read_or_rejected(
    target: str, tmp_path: Path, data: st.DataObject
) -> None:
    TARGETS[target](data.draw(INPUTS[target]), tmp_path)


@pytest.mark.parametrize("target", ["scenario", "airframe", "map", "metadata"])
@pytest.mark.parametrize(
    "text",
    [
        "&a [*a]",
        "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
        + "".join(
            f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n"
            for a, b in zip("abcdefgh", "bcdefghi", strict=True)
        ),
        "x: " + "[" * 1000,
        "x: " + "9" * 6000,
        "x: 0x" + "f" * 6000,
        "? [1, 2]\n: 3",
        "? {a: 1}\n: 3",
        "!!python/object/apply:os.system [id]",
        "!!timestamp 5",
        "<<: 5",
        "a: *b",
        "\ufeff---\n...\n---\n",
        "a: !!binary '%'",
        "\x00",
        "- " * 2000,
    ],
    ids=range(15),
)
def test_malicious_yaml_is_rejected(target: str, text: str, tmp_path: Path) -> None:
    TARGETS[target](text.encode(), tmp_path)


def test_file_that_is_too_large_and_pipe_rejected(tmp_path: Path) -> None:
    TARGETS["scenario"](b"# " + b"x" * (2 << 20), tmp_path)
    (tmp_path / "run").mkdir()
    for name in ("run_0.mcap", "metadata.yaml"):
        os.mkfifo(tmp_path / "run" / name)
    assert rejected(lambda: read_run(tmp_path / "run"))  # without blocking on the pipe


# Flights of any content: a readable log has a report

Report = Callable[[Callable[[Path], object], list[tuple[str, str, bytes]]], None]
TOPICS = st.sampled_from(
    ["/y", "/y_m", "/u", "/u_m", "/internals", "/truth", "/two/y", "y", "/", ""]
)
CHANNELS = st.lists(
    st.sampled_from(
        [
            "q",
            "V",
            "p",
            "r",
            "elevator",
            "thrust",
            "t",
            "x.q",
            "mode",
            "dt",
            "age",
            "late",
            "number",
            "e.q",
            "u.elevator",
        ]
    )
    | st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=6),
    max_size=5,
)
NUMBER = st.floats() | st.sampled_from([0.0, 1.0, 1e300, -1e300, 5e-324])


@st.composite
def flights(draw: st.DrawFn, complete: dict[str, tuple[str, ...]]) -> list[tuple[str, str, bytes]]:
    """Draw messages of a flight with some correct topics, channels, stamps and values."""
    messages = []
    for topic, names in [
        *complete.items(),
        *draw(st.dictionaries(TOPICS, CHANNELS.map(tuple), max_size=2)).items(),
    ]:
        for k in range(draw(st.integers(0, 4))):
            given_names = draw(st.just(names) | st.permutations(names) | CHANNELS)
            values = draw(st.lists(NUMBER, min_size=len(given_names), max_size=len(given_names)))
            stamp = draw(st.just(10_000_000 * k) | st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
            messages.append(
                (
                    topic,
                    JOINT_STATE,
                    vector(stamp, given_names, values, draw(st.text("a/#;=", max_size=3))),
                )
            )
    return messages


def channels(scenario: Scenario) -> dict[str, tuple[str, ...]]:
    outputs = scenario.controller.outputs
    inputs = scenario.controller.inputs
    return {
        "/y": outputs,
        "/y_m": outputs,
        "/u": inputs,
        "/truth": ("t", *(f"x.{name}" for name in outputs)),
    }


@pytest.fixture
def reported(tmp_path: Path, osprey_gust: Scenario) -> Report:
    """Return a function that reads messages as a flight of the default scenario."""

    def report(read: Callable[[Path], object], messages: list[tuple[str, str, bytes]]) -> None:
        run = write_run(
            tmp_path, log(messages, attached={"osprey_gust.yaml": osprey_gust.path.read_bytes()})
        )
        with np.errstate(all="ignore"):
            rejected(lambda: read(run))

    return report


FLIGHTS = flights(channels(find_scenario("osprey_gust")))


@few
@given(FLIGHTS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of NumPy, for extreme values
def test_flight_of_any_values_has_summary_or_rejected(
    reported: Report, messages: list[tuple[str, str, bytes]]
) -> None:
    reported(read_flight, messages)


@settings(few, max_examples=5)  # each page takes half a second
@given(FLIGHTS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_flight_of_any_values_has_page_or_rejected(
    reported: Report, messages: list[tuple[str, str, bytes]]
) -> None:
    reported(rewrite_report, messages)

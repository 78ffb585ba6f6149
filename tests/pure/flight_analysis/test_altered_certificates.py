# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test altered certificates, each with the name and the digest of its own content.

The checker refuses in one sentence what is false or has two readings. What it accepts is true and
says what it says. The list below names each alteration with its reason.
"""

import copy
import hashlib
import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.pure.flight_analysis.test_certificate import (
    CHECKER,
    Content,
    _checker,
    guarantee_of,
    loop_of,
)

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.certificate import certificate
from flight_analysis.linear_loop.guarantee import Guarantee, loop_guarantee
from flight_analysis.linear_loop.loop_margins import LinearLoop, scenario_loop
from rise_di.c_code import certificate_sources

pytestmark = pytest.mark.slow

Alter = Callable[[Content], Any]
NAN, INF = math.nan, math.inf
TOP = math.pi / 0.01  # rad/s, the highest frequency of a loop of 100 Hz
LINE = "a line of an export"


def servo_loop() -> LinearLoop:
    scenario = find_scenario("osprey_servo")
    return scenario_loop(scenario, scenario.controller, 1, 0.3)


def certified(guarantee: Guarantee) -> Content:
    sources = certificate_sources(load_airframe("osprey"), find_scenario("osprey_servo"))
    content: Content = json.loads(certificate(servo_loop(), guarantee, sources.texts))
    return content


@pytest.fixture(scope="module")
def servo() -> Content:
    return certified(guarantee_of("osprey_servo"))


@pytest.fixture(scope="module")
def other() -> Content:
    """Return the certificate of another loop."""
    linear = loop_of("jsbsim_c172p")
    content: Content = json.loads(certificate(linear, guarantee_of("jsbsim_c172p"), {}))
    return content


def signed(content: Content) -> str:
    """Return a content as text, with the name and the digest of its numbers if they have one."""
    rest = {key: value for key, value in content.items() if key != "digest"}
    try:
        with np.errstate(all="ignore"):
            rest["loop"] = _checker().digest_of(rest)
    except (ValueError, TypeError, KeyError, AttributeError):
        pass
    text = json.dumps(rest, sort_keys=True)
    return json.dumps(rest | {"digest": hashlib.sha256(text.encode()).hexdigest()})


@pytest.fixture
def verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Return a function that gives the checker's status and words for a text."""
    module = _checker()

    def run(text: str | bytes, *words: str) -> tuple[int, str]:
        path = tmp_path / "certificate.json"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        monkeypatch.setattr(sys, "argv", [str(CHECKER), str(path), *words])
        status = module.main()
        said = capsys.readouterr()
        assert said.err.count("\n") == (status != 0)  # one sentence
        return status, said.out + said.err

    return run


def put(value: Any, *path: str | int) -> Alter:
    """Return an alteration that puts a value at a place."""

    def alter(content: Content) -> None:
        inner: Any = content
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value

    return alter


def drop(*path: str | int) -> Alter:
    """Return an alteration that leaves a place out."""

    def alter(content: Content) -> None:
        inner: Any = content
        for key in path[:-1]:
            inner = inner[key]
        del inner[path[-1]]

    return alter


def times(factor: float, *path: str | int) -> Alter:
    """Return an alteration that multiplies the numbers of a place."""

    def alter(content: Content) -> None:
        inner: Any = content
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = (factor * np.array(inner[path[-1]])).tolist()

    return alter


def both(*alters: Alter) -> Alter:
    """Return an alteration that does several."""
    return lambda content: [alter(content) for alter in alters]


def swap(*path: str | int, places: tuple[int, int]) -> Alter:
    """Return an alteration that exchanges two members of a list."""

    def alter(content: Content) -> None:
        inner: Any = content
        for key in path:
            inner = inner[key]
        a, b = places
        inner[a], inner[b] = inner[b], inner[a]

    return alter


def one_step(t: float = 0.0, g: float = 0.0) -> Alter:
    """Return an alteration with one step in each part, over all frequencies."""

    def alter(content: Content) -> None:
        for part in content["parts"]:
            count = len(part["entries"])
            step = {"low": 0.0, "high": TOP, "t": [t] * count, "g": [g] * count}
            part["steps"] = [step]

    return alter


def without_entry(content: Content) -> None:
    """Leave out one entry of the box.

    The box becomes smaller, and the certificate stays true.
    """
    i = content["names"].index("A[q,alpha]")
    for key in ("F", "G", "part", "names"):
        content[key].pop(i)
    for row in content["E"]:
        row.pop(i)
    for part in content["parts"]:
        if i in part["entries"]:
            place = part["entries"].index(i)
            part["entries"].pop(place)
            for step in part["steps"]:
                for key in {"t", "g"} & step.keys():
                    step[key].pop(place)
        part["entries"] = [entry - (entry > i) for entry in part["entries"]]


def first(**members: Any) -> Alter:
    """Return an alteration that adds a step before the steps of the first part."""
    return lambda content: content["parts"][0]["steps"].insert(0, members)


def last(**members: Any) -> Alter:
    """Return an alteration that adds a step after the steps of the first part."""
    return lambda content: content["parts"][0]["steps"].append(members)


def steered_backwards(content: Content) -> None:
    for key in "CD":
        times(-1.0, "law", key)(content)
    both(drop("constants"), put(1e-7, "size"), one_step())(content)


def constants(old: str, new: str) -> Alter:
    """Return an alteration of the exported constants."""
    return lambda content: content.update(constants=content["constants"].replace(old, new))


def compiled(text: str) -> Alter:
    """Return constants with another text for their rows.

    In the text {0} stands for the rows, and {1} for the rows with other gains.
    """

    def alter(content: Content) -> None:
        header = content["constants"]
        begin = header.index("#define RISE_DI_PARAMETERS {")
        rows = header[begin : header.index("\n}\n", begin) + 3]
        others = rows.replace("/* K */ {", "/* K */ {1")
        content["constants"] = header.replace(rows, text.format(rows, others))

    return alter


def exchanged(pattern: str) -> Alter:
    """Return an alteration that exchanges the two groups of a pattern in the constants."""
    return lambda content: content.update(
        constants=re.sub(pattern, r"\2\1", content["constants"], count=1)
    )


def exchanged_in_names(one: str, other: str) -> Alter:
    """Return an alteration that exchanges two words in the names of the entries."""
    words = {one: other, other: one}

    def alter(content: Content) -> None:
        pattern = f"{one}|{other}"
        content["names"] = [
            re.sub(pattern, lambda match: words[match[0]], name) for name in content["names"]
        ]

    return alter


def only_the_first(name: str) -> Alter:
    """Return an alteration that keeps only the first value of a row of the constants."""
    pattern = rf"(/\* {name} \*/ \{{[\d.]+)[^}}]*"
    return lambda content: content.update(constants=re.sub(pattern, r"\1", content["constants"]))


def of_zeros(content: Content) -> None:
    drop("constants")(content)
    for key in "ABCD":
        times(0.0, "law", key)(content)


STEP = ("parts", 0, "steps", 1)
RANGE, WORDS, ALONE, NOT_FOUND = "a number from", "printable ASCII", "alone", "not proved"
REFUSED: dict[str, tuple[Alter, str]] = {
    # more is claimed than the steps prove
    "a wider box": (times(1.02, "size"), NOT_FOUND),
    "an entry that moves two rows": (put(1.0, "E", 0, 6), ALONE),
    "a step left out": (drop("parts", 1, "steps", 5), "step [56]: not"),
    "the last step left out": (drop("parts", 1, "steps", -1), "boxes are not proved"),
    "no steps": (put([], "parts", 0, "steps"), "boxes are not proved"),
    "a part left out": (drop("parts", 1), "no proof for"),
    "no parts": (put([], "parts"), "no proof for"),
    "entries of another part": (
        both(put(8, "parts", 0, "entries", 0), put(0, "parts", 1, "entries", 0)),
        "rising numbers|expected entries",
    ),
    "an entry in no part": (drop("parts", 1, "entries", -1), "t: found 13|halve: found 12"),
    "the law off": (of_zeros, "d = 0, is not stable"),
    "a law with the wrong sign in a small box": (steered_backwards, "d = 0, is not stable"),
    "other outputs": (times(0.0, "C"), "d = 0, is not stable"),
    "a later u": (put(0.053, "delay"), NOT_FOUND),
    "a faster law": (
        both(drop("constants"), times(1.5, "law", "C"), times(1.5, "law", "D")), NOT_FOUND
    ),
    "slower actuators": (times(3.0, "lag"), NOT_FOUND),
    "a step that goes on": (times(2.0, "parts", 1, "steps", 56, "high"), NOT_FOUND),
    "without balance": (both(put(10.0, "size"), one_step()), NOT_FOUND),
    "300 % by the largest g": (both(put(10.0, "size"), one_step(g=1e9)), NOT_FOUND),
    # the entries and their names
    "parts doubled": (put([0.6] * 26, "part"), "nothing or all exact"),
    "tiny parts": (times(1e-7, "part"), "expected"),
    "names exchanged": (swap("names", places=(0, 25)), ALONE),
    "a letter that looks alike": (put("\u0410[V,q]", "names", 2), WORDS),
    "a name with a line of its own": (put("A[V,V] 99.9 %\n  B\x1b[2K", "names", 0), WORDS),
    "an empty name": (put("", "names", 0), WORDS),
    "a name that is no text": (put(None, "names", 0), WORDS),
    "names equal": (put(["A[V,V]"] * 26, "names"), "names that differ"),
    "a name twice": (put("A[V,V]", "names", 1), "names that differ"),
    "an entry of another aircraft": (put("A[w,w]", "names", 0), "expected A.STATE"),
    "an entry that is 0": (put("A[q,V]", "names", 0), ALONE),
    "half a change of A": (times(0.5, "F", 6), "nothing or all exact"),
    "half a row of A": (put(0.5, "E", 2, 6), ALONE),
    "E with the other sign": (times(-1.0, "E"), ALONE),
    "changes a millionth": (both(times(1e-7, "F"), times(1e-7, "G")), "nothing or all exact"),
    "changes that vanish": (both(times(0.0, "F"), times(0.0, "G")), ALONE),
    "another entry of A": (times(3.0, "A", 2, 1), "nothing or all exact"),
    "a part 0 that moves": (put(0.0, "part", 6), ALONE),
    "all parts 0": (times(0.0, "part"), "may deviate|" + ALONE),
    "a state twice": (put("V", "states", 1), "names that differ"),
    "a state with a space": (put("V x", "states", 0), WORDS),
    "no states": (put([], "states"), "some names"),
    "more states than A": (lambda c: c["states"].append("w"), "9 values"),
    "states of a thousand": (put([f"x{i}" for i in range(1000)], "states"), "some names"),
    "states renamed": (put("u", "states", 0), "expected A.STATE"),
    "outputs renamed": (put("w", "outputs", 0), "law is not that of the constants"),
    "inputs exchanged": (swap("inputs", places=(0, 1)), "law is not that of the constants"),
    "effectors exchanged": (swap("effectors", places=(0, 1)), "expected"),
    "inputs exchanged where C has no constants": (
        both(drop("constants"), swap("inputs", places=(1, 2))),
        "T of aileron: .* the input of this name alone",
    ),
    "effectors and their entries exchanged": (
        both(swap("effectors", places=(1, 2)), exchanged_in_names("aileron", "rudder")),
        "T of rudder: .* the input of this name alone",
    ),
    "an allocation of zeros": (times(0.0, "T"), "expected"),
    "an allocation twice as large": (times(2.0, "T"), "expected"),
    # types and ranges
    "t of NaN": (put(NAN, *STEP, "t", 3), "NaN"),
    "t of -1e308": (put(-1e308, *STEP, "t", 3), RANGE),
    "g of Infinity": (put(INF, *STEP, "g", 3), "Infinity"),
    "g of 1e308": (put(1e308, *STEP, "g", 3), RANGE),
    **{f"size of {v}": (put(v, "size"), RANGE) for v in (0.0, 1e308, True, "2.4", None, [2.4])},
    "size and parts negative": (both(times(-1.0, "size"), times(-1.0, "part")), RANGE),
    "low of NaN": (put(NAN, *STEP, "low"), "NaN"),
    "low below 0": (first(low=-5.0, high=0.0, t=[0.0] * 13, g=[0.0] * 13), RANGE),
    "low above high": (first(low=100.0, high=3.0, t=[0.0] * 13, g=[0.0] * 13), "low < high"),
    "low at high": (first(low=3.0, high=3.0, t=[0.0] * 13, g=[0.0] * 13), "low < high"),
    "high beyond": (first(low=0.0, high=1e9, t=[0.0] * 13, g=[0.0] * 13), RANGE),
    "high above pi / T": (put(TOP * (1.0 + 1e-9), *STEP, "high"), "low < high"),
    **{f"halve {v!r}": (first(halve=v), "a number of an entry") for v in (-1, 99, True, 1.0, "0")},
    "halve beside low": (first(halve=0, low=0.0), "halve alone"),
    "halves without end": (lambda c: c["parts"][0].update(steps=[{"halve": 0}] * 60_000), "50000"),
    "a step behind the end": (last(halve=0), "the box is proved before it"),
    "an empty step": (first(), "expected low"),
    "a step that is nothing": (put(None, *STEP), "an object"),
    "steps that are an object": (put({}, "parts", 0, "steps"), "a list"),
    "t longer": (lambda c: c["parts"][0]["steps"][1]["t"].append(0.0), "values"),
    "g shorter": (drop(*STEP, "g", 0), "values"),
    "t in lists": (put([0.0], *STEP, "t", 0), RANGE),
    "entries of halves": (put([0.5], "parts", 0, "entries"), "rising numbers"),
    "entries below 0": (put([-1], "parts", 0, "entries"), "rising numbers"),
    "an entry twice": (put([0, 0], "parts", 0, "entries"), "rising numbers"),
    "a part twice": (lambda c: c["parts"].append(c["parts"][0]), "entries of no other part"),
    "a lag below 0": (put(-0.02, "lag", 0), RANGE),
    "a lag too fast": (put(1e-50, "lag", 0), "too fast"),
    "a delay below 0": (put(-0.003, "delay"), RANGE),
    "a delay of false": (put(False, "delay"), RANGE),
    "a delay of 90 s": (put(90, "delay"), RANGE),
    "a delay of a thousand ticks": (both(put(1e-3, "period"), put(1.0, "delay")), "100 periods"),
    "a period of a nanosecond": (put(1e-9, "period"), RANGE),
    "a period twice as long": (put(0.02, "period"), "high: found|low < high|constants"),
    "a motion too fast": (put(-1e6, "A", 3, 3), "too fast|expected"),
    "a number as a text": (lambda c: put(str(c["A"][2][1]), "A", 2, 1)(c), RANGE),
    "a row too short": (drop("A", 2, 7), "8 values"),
    "no law": (drop("law"), "expected airframe"),
    "a law of lists": (put([], "law"), "an object"),
    "a law with more": (put(1.0, "law", "E"), ALONE),
    "a law of 600 states": (put([[0.0]] * 600, "law", "A"), "512 values"),
    "a member more": (put("also covers saturation", "note"), ALONE),
    "a digest in capitals": (put("A" * 64, "airframe"), "SHA-256"),
    "a scenario with a line": (put("0" * 63 + "\n", "scenario"), "SHA-256"),
    "an airframe of a number": (put(0, "airframe"), "SHA-256"),
    # the law beside its constants
    "another gain in the constants": (constants("/* K */ {", "/* K */ {1"), "law is not that"),
    "a NaN in the constants": (constants("/* K */ {", "/* K */ {nan, "), LINE),
    "a NaN as a gain": (constants("/* D */ {1.0", "/* D */ {nan"), LINE),
    "constants without a gain": (constants("/* Lambda */", "/* L */"), "the rows of"),
    "the literal sign": (constants("/* sign */ 2", "/* sign */ 0"), "linear near e = 0"),
    "constants of another rate": (constants("/* period_ns */ 1", "/* period_ns */ 2"), "steps of"),
    "a step that is cut": (constants("0.11, ", "0.001, "), "steps of"),
    # constants of which a compiler reads others
    "rows that are left out": (compiled("#if 0\n{0}\n#endif\n{1}"), LINE),
    "rows in a comment": (compiled("/*\n{0}*/\n{1}"), LINE),
    "a definition behind": (compiled("{0}\n#undef RISE_DI_PARAMETERS\n{1}"), LINE),
    "two definitions": (compiled("{0}\n{1}"), "each macro once"),
    "a comment that ends early": (constants(" * SPDX", " */ int x; /* SPDX"), "one comment"),
    "two rows exchanged": (exchanged(r"(    /\* K .*\n)(    /\* Lambda .*\n)"), "the rows of"),
    "a name at another row": (
        both(constants("/* K */", "/* x */"), constants("/* Lambda */", "/* K */")), "the rows of"
    ),
    "a number more before the gains": (constants("0.11, ", "0.11, 18.0, "), LINE),
    "a list in place of a number": (constants("0.11, ", "{0.11}, "), "the rows of"),
    "an octal number": (constants("/* sign */ 2", "/* sign */ 02"), LINE),
    "a list of one value": (only_the_first("eps"), "a value for each channel"),
    "no constants in the text": (put("x", "constants"), "found no"),
    "an empty text": (put("", "constants"), "a text"),
    "constants of a number": (put(1, "constants"), "a text"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_altered_certificate_is_refused_in_a_sentence(
    name: str, servo: Content, verdict: Callable[..., tuple[int, str]]
) -> None:
    alter, reason = REFUSED[name]
    content = copy.deepcopy(servo)
    alter(content)
    status, said = verdict(signed(content))
    assert status == 1, said
    assert re.search(reason, said), said


TEXTS: dict[str, tuple[Callable[[str], str | bytes], str]] = {
    "truncated": (lambda text: text[:-40], "line 1"),
    "an order of bytes before it": (lambda text: "\ufeff" + text, "BOM"),
    "lists in lists": (lambda _: "[" * 200_000, "lists in lists"),
    "a huge whole number": (lambda text: text.replace("0.003", "1" + "0" * 400), "digits"),
    "a huge real number": (lambda text: text.replace("0.003", "1e999"), RANGE),
    "size twice": (lambda text: text.replace('"size": ', '"size": 3.3, "size": ', 1), "twice"),
    "low twice": (lambda text: text.replace('"low": 0.0', '"low": 1.0, "low": 0.0', 1), "twice"),
    "another size": (lambda text: text.replace('"size": 2.4', '"size": 2.5', 1), "digest"),
    "a list": (lambda _: "[1, 2, 3]", "an object"),
    "nothing": (lambda _: "", "Expecting value"),
    "something behind it": (lambda text: text + "{}", "Extra data"),
    "a comment": (lambda text: "// true\n" + text, "Expecting value"),
    "two bytes a letter": (lambda text: text.encode("utf-16"), "decode"),
    "no letters": (lambda text: b"\xff" + text.encode(), "decode"),
    "half a letter": (lambda text: text.replace('"A[V,V]"', r'"\ud800"', 1), WORDS),
    "a null": (lambda text: text.replace("A[V,V]", "A[V,V\x00]", 1), "control character"),
    "too long": (lambda text: text + " " * 32_000_001, "bytes"),
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_text_that_is_no_certificate_is_refused_in_a_sentence(
    name: str, servo: Content, verdict: Callable[..., tuple[int, str]]
) -> None:
    alter, reason = TEXTS[name]
    status, said = verdict(alter(signed(servo)))
    assert status == 1, said
    assert reason in said


ACCEPTED: dict[str, tuple[Alter, str]] = {
    # true, with the sentence that a reader takes from each
    "as it is": (lambda _: None, ") 74.1 %"),
    "a box wider by less than what is proved beyond": (times(1.0005, "size"), ") 74.2 %"),
    "a box smaller, of a whole number": (put(2, "size"), ") 60 %"),
    "a tiny box": (both(put(1e-7, "size"), one_step()), ") 0 %"),
    "an entry that is exact is said": (without_entry, "A[V,theta], A[q,alpha], A[theta,q]"),
    "the hash of another airframe is a label": (put("0" * 64, "airframe"), ") 74.1 %"),
    "without constants that is said": (drop("constants"), "law: of no exported constants"),
    "single precision holds the law less exactly": (
        constants("RISE_DI_FLOAT32 0", "RISE_DI_FLOAT32 1"), "law: of the constants"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ACCEPTED)
def test_true_certificate_is_proved_and_says_what_holds(
    name: str, servo: Content, verdict: Callable[..., tuple[int, str]]
) -> None:
    alter, sentence = ACCEPTED[name]
    content = copy.deepcopy(servo)
    alter(content)
    status, said = verdict(signed(content))
    assert status == 0, said
    assert said.startswith("PROVED")
    assert sentence in said


def test_another_loop_with_these_constants_is_refused(
    servo: Content, other: Content, tmp_path: Path, verdict: Callable[..., tuple[int, str]]
) -> None:
    """The law is computed from the constants, with and without the header file."""
    header = tmp_path / "rise_di_parameters.h"
    header.write_text(servo["constants"])
    assert verdict(signed(servo), str(header))[0] == 0
    assert verdict(signed(other))[0] == 0
    for foreign in (other, servo | {"law": other["law"]}):
        named = foreign | {key: servo[key] for key in ("constants", "scenario")}
        for words in ((), (str(header),)):
            status, said = verdict(signed(named), *words)
            assert status == 1
            assert "constants" in said
    status, said = verdict(signed(other), str(header))
    assert status == 1
    assert "holds other constants" in said
    named = json.loads(signed(other)) | {"loop": servo["loop"]}
    rest = {key: value for key, value in named.items() if key != "digest"}
    digest = hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()
    assert "not the one that its name says" in verdict(json.dumps(rest | {"digest": digest}))[1]


def _leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if not isinstance(value, (dict, list)):
        return [path]
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return [leaf for key, inner in items for leaf in _leaves(inner, (*path, key))]


@pytest.mark.usefixtures("coarse")
def test_no_mutation_of_a_leaf_proves_another_claim(
    verdict: Callable[..., tuple[int, str]],
) -> None:
    """A mutation is refused, or the checker's claim is word for word the original one.

    It is made in 60 leaves. They are drawn by member, so that the few outside the steps are drawn,
    too.
    """
    servo = certified(loop_guarantee(servo_loop()))
    _, claim = verdict(signed(servo))
    claim = claim.split("\n", 1)[1]
    rng = np.random.default_rng(7)
    members = {key: _leaves(value, (key,)) for key, value in servo.items()}
    values: list[Any] = [NAN, INF, -INF, True, None, "1", "", [], {}, 10**30, 1e308, 5e-324, -1e20]
    for _ in range(60):
        leaves = members[list(members)[rng.integers(len(members))]]
        place = leaves[rng.integers(len(leaves))]
        content = copy.deepcopy(servo)
        put(values[rng.integers(len(values))], *place)(content)
        status, said = verdict(signed(content))
        assert status == 1 or said.split("\n", 1)[1] == claim, place

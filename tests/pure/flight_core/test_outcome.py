# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The outcome of a flight: its sentence, its exit status, and the record of a log."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight_core.outcome import (
    COMPLETED,
    INTERRUPTED,
    UNKNOWN,
    Aim,
    End,
    FlightEnded,
    LostContact,
    Outcome,
    Shortfall,
    ended_early,
    never_flew,
    parsed_outcome,
    read_outcome,
)

SHORT = Shortfall(aim=Aim.FENCE, sentence="outside of the fence for 2.0 s, 20 m at most")

STATUSES = {
    End.COMPLETED: (0, 4),
    End.LANDED: (0, 4),
    End.ENDED_EARLY: (3, 3),
    End.NEVER_FLEW: (3, 3),
    End.INTERRUPTED: (130, 130),
    End.IMPORTED: (0, 4),
    End.UNKNOWN: (4, 4),
}
"""Exit status of an end, without and with a shortfall."""

WORDS = st.sampled_from(
    ["completed", " landed ", "hit the ground", ", missed leg 2", "outside of the fence", "unknown"]
)


@pytest.mark.parametrize("end", End)
@given(reason=st.lists(st.one_of(WORDS, st.text(max_size=20))).map("".join))
def test_status_depends_on_the_end_and_the_shortfalls_alone(end: End, reason: str) -> None:
    """A name of the user may say "has landed softly"."""
    assert (Outcome(end, reason).status, Outcome(end, reason, (SHORT,)).status) == STATUSES[end]


@given(end=st.sampled_from(End), reason=st.text(max_size=30))
def test_record_is_read_back(end: End, reason: str) -> None:
    outcome = Outcome(end, reason)
    back = parsed_outcome(outcome.text())
    assert back.end is end
    if end is not End.UNKNOWN and reason.isprintable():
        assert back == outcome


@given(content=st.one_of(st.text(), st.integers(), st.dictionaries(st.text(), st.text())))
def test_foreign_record_is_unknown(content: object) -> None:
    assert read_outcome(content) == parsed_outcome(json.dumps(content)) == UNKNOWN
    assert parsed_outcome("landed") == UNKNOWN


@pytest.mark.parametrize(
    "outcome, sentence",
    [
        (COMPLETED, "completed"),
        (INTERRUPTED, "interrupted"),
        (Outcome(End.COMPLETED, "", (SHORT,)), f"completed, {SHORT.sentence}"),
        (Outcome(End.LANDED, "osprey landed", (SHORT,)), f"osprey landed, {SHORT.sentence}"),
        (ended_early("aircraft was killed"), "aircraft was killed"),
        (never_flew("no y"), "never flew: no y"),
    ],
)
def test_sentence_says_the_end_and_each_shortfall(outcome: Outcome, sentence: str) -> None:
    assert str(outcome) == outcome.as_json()["sentence"] == sentence


def test_node_ends_with_a_status_of_its_own() -> None:
    """A landing and a lost peer are told apart without their sentences."""
    ends = (FlightEnded("diverged"), FlightEnded("landed", End.LANDED), LostContact("lost"))
    assert [ended.status for ended in ends] == [3, 5, 6]
    assert [ended.outcome.end for ended in ends] == [End.ENDED_EARLY, End.LANDED, End.ENDED_EARLY]

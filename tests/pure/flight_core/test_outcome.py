# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the outcome of a flight: its sentence, its exit status, and its record in a log."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight_core.outcome import (
    COMPLETED,
    INTERRUPTED,
    UNKNOWN,
    Aim,
    Allowance,
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

OFF = tuple(
    Shortfall(
        aim=Aim.ERROR,
        sentence=f"{name} off by {times} deg/s rms, 1 allowed, from t = 3.0 to 13.0 s",
        brief=f"{name} off by {times} deg/s rms, 1 allowed",
        times=times,
    )
    for name, times in (("q", 2.0), ("p", 7.0), ("r", 3.0))
)
WINDY = Allowance(sentence="r off by 1.5 deg/s rms, allowed for wind")
SHORT = Shortfall(aim=Aim.FENCE, sentence="outside of the fence for 2.0 s, 20 m at most")

STATUSES = {
    End.COMPLETED: (0, 4),
    End.LANDED: (0, 4),
    End.ENDED_EARLY: (3, 3),
    End.NEVER_FLEW: (3, 3),
    End.INTERRUPTED: (130, 130),
    End.HOST: (7, 4),
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
    """The reason is text of the user, such as "has landed softly".

    It does not change the status.
    """
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
        (Outcome(End.COMPLETED, "", (SHORT,)), f"completed; {SHORT.sentence}"),
        (Outcome(End.LANDED, "osprey landed", (SHORT,)), f"osprey landed; {SHORT.sentence}"),
        (
            Outcome(End.COMPLETED, "", OFF),
            f"completed, 3 shortfalls; worst: {OFF[1].sentence}",
        ),
        (
            Outcome(End.COMPLETED, "", (*OFF, SHORT)),
            f"completed, 4 shortfalls; worst: {SHORT.sentence}",
        ),
        (Outcome(End.COMPLETED, "", (), (WINDY,)), f"completed; {WINDY.sentence}"),
        (
            Outcome(End.COMPLETED, "", (), (WINDY,) * 3),
            "completed; 3 errors allowed for noise or wind",
        ),
        (ended_early("aircraft was killed"), "aircraft was killed"),
        (never_flew("no y"), "never flew: no y"),
    ],
)
def test_headline_says_the_end_and_the_worst(outcome: Outcome, sentence: str) -> None:
    assert str(outcome) == outcome.as_json()["sentence"] == sentence


@given(
    reason=st.text(max_size=400),
    shortfalls=st.lists(st.sampled_from((*OFF, SHORT)), max_size=9),
    allowances=st.lists(st.just(WINDY), max_size=4),
    end=st.sampled_from(End),
)
def test_headline_fits_a_line_and_the_details_have_the_rest(
    reason: str, shortfalls: list[Shortfall], allowances: list[Allowance], end: End
) -> None:
    outcome = Outcome(end, reason, tuple(shortfalls), tuple(allowances))
    assert len(str(outcome)) <= 120
    told = "\n".join([str(outcome), *outcome.details])
    assert all(each.sentence in told for each in shortfalls)
    assert all(each.sentence in told for each in allowances)
    assert reason in told or end.value in str(outcome)


def test_node_ends_with_a_status_of_its_own() -> None:
    """A landing and a lost peer have statuses of their own, whatever their sentences are."""
    ends = (FlightEnded("diverged"), FlightEnded("landed", End.LANDED), LostContact("lost"))
    assert [ended.status for ended in ends] == [3, 5, 6]
    assert [ended.outcome.end for ended in ends] == [End.ENDED_EARLY, End.LANDED, End.ENDED_EARLY]

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the messages of a log and the parameters of a flight on the report page."""

from pathlib import Path

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report import figures
from flight_analysis.report.html import write_page
from flight_analysis.report.parameter_rows import NONE, parameter_rows
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_log.flight_processes import LOG, ROSOUT
from flight_log.learning_messages import DIAGNOSTIC_ARRAY, OK, learning_message
from flight_log.log_messages import LogMessage, StoredText, log_messages
from flight_log.named_vectors import typestore
from flight_log.stored_messages import PARAMETER_EVENT, PARAMETER_EVENTS, parameter_event

SECOND = 1_000_000_000


def line(level: int, text: str) -> bytes:
    """Return a line of rcl_interfaces/msg/Log.

    Level 20 is information, 30 a warning, and 40 an error.
    """
    store = typestore()
    stamp = store.types["builtin_interfaces/msg/Time"](5, 0)
    message = store.types[LOG](stamp, level, "controller", text, "", "", 0)
    return bytes(store.serialize_cdr(message, LOG))


def test_log_tells_warnings_changes_and_learning_of_its_aircraft() -> None:
    def changed(node: str, stamp: int) -> StoredText:
        data = parameter_event(stamp * SECOND, node, {"k_g": 2.5, "A": [0.5] * 64})
        return StoredText(
            topic=PARAMETER_EVENTS, type_name=PARAMETER_EVENT, sent_ns=stamp * SECOND, data=data
        )

    learned = learning_message(7 * SECOND, "model", "flies model 1", level=OK)
    texts = [
        StoredText(
            topic="/one/learning", type_name=DIAGNOSTIC_ARRAY, sent_ns=7 * SECOND, data=learned
        ),
        StoredText(
            topic="/two/learning", type_name=DIAGNOSTIC_ARRAY, sent_ns=7 * SECOND, data=learned
        ),
        changed("/one/controller", 6),
        changed("/two/controller", 6),
        StoredText(topic=ROSOUT, type_name=LOG, sent_ns=5 * SECOND, data=line(30, "y is late")),
        StoredText(topic=ROSOUT, type_name=LOG, sent_ns=5 * SECOND, data=line(20, "ready")),
        StoredText(topic=ROSOUT, type_name=LOG, sent_ns=5 * SECOND, data=b"\0\1damaged"),
    ]
    messages = log_messages(texts, "/one", first_ns=4 * SECOND)
    assert [(message.stamp_ns, message.kind, message.text) for message in messages] == [
        (5 * SECOND, "warning", "controller: y is late"),
        (6 * SECOND, "parameter", "controller: k_g = 2.5, A = 64 values"),
        (7 * SECOND, "learning", "flies model 1"),
    ]


def test_page_has_messages_beside_figures(tmp_path: Path) -> None:
    scenario = find_scenario("osprey_servo", 1.0)
    tape = simulate(scenario)
    warning = LogMessage(
        stamp_ns=tape.start_ns + SECOND // 2, kind="warning", text="controller: <y> is late"
    )
    after = LogMessage(stamp_ns=tape.start_ns + 9 * SECOND, kind="error", text="recorder: ends")
    flight = RecordedFlight(
        name="run",
        scenario=scenario,
        tape=tape,
        summary=summarise(tape, scenario),
        messages=(warning, after),
    )
    write_page(tmp_path / "page.html", [flight])
    page = (tmp_path / "page.html").read_text()
    assert "<b>0.50 s</b> warning: controller: &lt;y&gt; is late" in page
    assert "<b>9.00 s</b> error: recorder: ends" in page
    shapes = figures.tracking_figure(figures.plot_context([flight])).layout["shapes"]
    # the one within the flight
    assert [shape["x0"] for shape in shapes if shape["type"] == "line"] == [0.5]


def test_parameters_other_than_default_come_first_with_both_values() -> None:
    """The defaults are the ones of docs/reference/parameters.md."""
    rows = parameter_rows(find_scenario("osprey_route"))
    assert ("aircraft.kinematics", "euler", "linear") in rows
    assert ("aircraft.wind", "[3, 0]", "[0, 0]") in rows
    assert ("controller.k_g", "3", NONE) in rows
    places = [row[2] == NONE for row in rows]
    assert places == sorted(places)
    servo = dict(row[:2] for row in parameter_rows(find_scenario("osprey_servo")))
    assert "aircraft.kinematics" not in servo  # linear, the default
    assert "aircraft.gusts.vertical.speed" in servo

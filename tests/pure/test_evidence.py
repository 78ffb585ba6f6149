# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The evidence page: every figure comes from a result, and missing, short, failed and unreliable measurements are marked."""

import json
import re
import signal
import subprocess
import sys
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from benchmarks.evidence import MEASUREMENTS, REPOSITORY, cases, read, wanted
from benchmarks.evidence_page import BUSY, SPEED, WIDTH, Result, render

MACHINE = {"processor": "a processor", "cores": 2, "memory": 8, "system": "Linux 6", "python": "3.11.7"}
RUN = {"date": "2020-01-02 03:04 UTC", "revision": "abc1234", "machine": MACHINE, "busy": 0.0, "seconds": 1.0, "status": 0}


def result(name: str, measured: Any, **changes: Any) -> Result:
    return RUN | {"name": name, "command": f"measure {name}", "quick": False, "result": measured} | changes


def row(what: str, figures: dict[str, float], floor: str = "", goals: tuple[dict[str, Any], ...] = ()) -> dict[str, Any]:
    return {"group": "node", "what": what, "figures": figures, "floor": floor, "goals": goals}


TWICE = {"column": "p50 (us)", "at_most": 2.0, "of_floor": True}
NODE = [
    row("bare echo, single", {"p50 (us)": 40.0, "p99 (us)": 80.0}, "bare echo, single"),
    row("bare echo, events", {"p50 (us)": 20.0, "p99 (us)": 60.0}, "bare echo, single"),
    row("controller, u alone", {"p50 (us)": 50.0, "p99 (us)": 320.0}, "bare echo, single", (TWICE,)),
]
TIMES = {"median": 0.1234, "worst": 0.2341}
FAULT = {
    "case": "controller killed",
    "u": "held, then ramped",
    **dict.fromkeys(("injected", "passed"), 10),
    "any_delay": 3,
    **dict.fromkeys(("reaction", "recovery", "ready_to_traffic", "held_back"), TIMES),
    "exec_to_traffic": {"median": 0.4, "worst": 0.51},
    "exec_to_ready": {"median": 0.38, "worst": 0.47},
    "start_run": {"median": 0.31, "worst": 0.33},
    "start_waited": {"median": 0.02, "worst": 0.05},
    "ready_to_caught_up": {"median": 0.4, "worst": 0.62},
    "longest_pause": None,
}
UNCERTAIN = {"mean": 1.75, "worst": 2.48, "lost": 0.0}
LEVEL = {"uncertainty": 0.3, "gust": UNCERTAIN, "turbulence": UNCERTAIN | {"mean": 2.75, "worst": 3.48}}
LAW: dict[str, Any] = {"law": "rise", "sees": "y", "knows": "Omega", "tuned_on": "gust"}
LAW |= {"score": {"gust": 1.61, "turbulence": 2.61}}
LAW |= {"levels": [LEVEL], "late": [{"delay": 0.02, "lost": 0.26}], "slew": {"elevator": 0.077}, "cost": 7.25, "spread": 0.5}
COMPARED = {"aircraft": 200, "seed": 1, "wind": "air_relative", "turbulence_seed": 3}
PI = LAW | {"law": "pi", "score": {"gust": 1.72, "turbulence": 2.51}}
FIGURE = {"mean": 1.31, "q50": 1.21, "q95": 2.31, "q99": 2.71, "worst": 3.01, "deviation": 0.1}
COVERAGE = {"status": 0, "covered": 1234, "number_of_executed_units": 98765, "peak_rss_mb": 321}
CAMPAIGN: dict[str, Any] = {"whole": 120_000.0, "flown": 150_000.0, "memory_early": 900.0, "memory": 905.0, "aircraft": 10_000}
CAMPAIGN |= {"plain": 50.0, "exact": 4, "integration": {"q": 0.0021, "V": 0.0005}}
SHARE = {"count": 3, "share": 3e-4, "low": 1e-4, "high": 9e-4}
DELAYS = {"p50": 0.052, "p99": 0.26}
BESIDE = {"processor": 0.027, "memory": 76.0, "traffic": 22_000.0, "flight": 30.0}
PAIRS = {"missed ticks": [3, 0], "late p99 (ms)": [0.5, 1.23]}
VIEW: dict[str, Any] = {"live": BESIDE, "live with a browser": {"to the screen": DELAYS}}
VIEW |= {"frozen": {"frozen": 10.0, "recovered after": 0.4}}
VIEW |= {"opened": {"flight": 3600.0, "first samples": 0.4, "whole log": 5.0, "processor": 4.6, "memory": 157.0, "log": 626.0}}
VIEW |= {
    "flights": {
        "without": PAIRS,
        "with": PAIRS,
        "start included": PAIRS,
        "starting": [1.25, 1.5],
        "more with": dict.fromkeys(PAIRS, 0.05),
        "more start included": dict.fromkeys(PAIRS, 0.15),
        "interval with": {name: [-1.5, 2.5] for name in PAIRS},
        "interval start included": {name: [-1.5, 2.5] for name in PAIRS},
        "probability with": dict.fromkeys(PAIRS, 0.5),
        "probability start included": dict.fromkeys(PAIRS, 0.5),
    }
}
LONG_FLIGHT: dict[str, Any] = {"flight": "the c172p, in lockstep", "took": 1500.0, "outcome": "completed", "minutes": 60.0}
LONG_FLIGHT |= {
    "legs": 62,
    "missing": {"missing samples": {"y": 3, "u": 1}},
    "lost": 0,
    "guidance": {"steps": 180_001, "differing": 0},
}
LONG_FLIGHT |= {
    "xtrack": 6.5,
    "bank_deg": 30.5,
    "V": 40.5,
    "memory": {"recorder.main": [100e6, 103e6], "rise-di fly": [90e6, 91e6]},
}
LONG_FLIGHT |= {"ticks": {"missed ticks": 3, "missed ticks, excluding host delays": 0}}
LONG_FLIGHT |= {"longest skips": [{"topic": "y", "t": 12.34, "length": 0.004}, {"topic": "u", "t": 50.0, "length": 0.01}]}
LONG_FLIGHT |= {
    "report": {"size": 48.1e6, "memory": 900e6, "written": 12.5, "opened": {"figures in view": 1.2, "all figures": 2.6}}
}
FLEET = {"flights": 10_000, "figures": {"score": FIGURE}, "diverged": SHARE, "lost": SHARE}
RESULTS = {
    "speed-node": result("speed-node", {"seconds": 10.0, "rows": NODE}),
    "faults": result("faults", [FAULT]),
    "random-faults": result("random-faults", {"draws": 110, "two": 9, "lockstep": 10, "passed": 110, "failed": []}),
    "security": result("security", [{"name": "test_an_attacker_receives_nothing", "outcome": "passed", "seconds": 1.0}]),
    "fuzz-coverage": result("fuzz-coverage", {"mcap": COVERAGE}),
    "long-fuzz": result("long-fuzz", {"mcap": COVERAGE}),
    "long-jsbsim": result("long-jsbsim", LONG_FLIGHT),
    "campaign": result("campaign", CAMPAIGN),
    "campaign-fleet": result("campaign-fleet", {"cases": [FLEET]}),
    "cluster": result("cluster", {"faults": "worker killed", "workers": 4, "aircraft": 2000, "chunks": 40, "same": 39}),
    "compare": result("compare", COMPARED | {"laws": [LAW, PI]}),
    "view": result("view", VIEW),
    "replay": result("replay", {"osprey_gust": {"outcome": "completed", "ticks": 6001, "checked": 6001, "equal": True}}),
}


def page(**changes: Result) -> str:
    """The page, each paragraph on one line."""
    return re.sub(r"(?<=[^\n|])\n *(?=[^\s|#-])", " ", render(MEASUREMENTS, RESULTS | changes))


def test_no_line_of_prose_is_longer_than_the_width_and_no_command_is_broken() -> None:
    for line in render(MEASUREMENTS, RESULTS).splitlines():
        assert len(line) <= WIDTH or line.startswith(("|", "    ")), line
        assert line.count("`") % 2 == 0, line


def test_the_page_has_every_section() -> None:
    titles = re.findall(r"^## (.+)$", page(), re.MULTILINE)
    assert titles == ["Faults", "Speed", "Security", "Long flights", "Campaign", "Other laws", "Live view", "Log"]


def test_without_results_the_page_holds_no_figure_but_the_command_for_each() -> None:
    empty = render(MEASUREMENTS, {})
    assert "Nothing has been measured yet." in empty
    for one in MEASUREMENTS:
        assert f'`make evidence ARGS="--again {one.name}"`' in empty
    assert not [line for line in empty.splitlines() if line.startswith("|")]


def test_sections_that_another_machine_measured_stay_and_their_goals_that_are_not_met_are_said_first() -> None:
    other = {"faults": RESULTS["faults"] | {"machine": MACHINE | {"processor": "another processor"}}}
    before = render(MEASUREMENTS, other)
    after = render(MEASUREMENTS, {"view": RESULTS["view"]}, before)
    for part in ("    measure faults    #", "    measure view    #", "- another processor, ", "- a processor, "):
        assert part in after
    assert "- Faults: a killed node is back" in after.partition("## ")[0]
    assert render(MEASUREMENTS, {"view": RESULTS["view"]}, after) == after
    assert "0.41 s" in render(MEASUREMENTS, {"faults": changed_fault(0.41)}, after)


def changed_fault(worst: float) -> Result:
    return result("faults", [FAULT | {"exec_to_traffic": {"median": 0.4, "worst": worst}}])


def test_each_table_stands_below_its_command() -> None:
    for name in RESULTS:
        assert f"\n    measure {name}    # 2020-01-02 03:04 UTC, abc1234\n" in page()


def test_long_measurements_run_only_by_their_name() -> None:
    missing = {one.name for one in wanted((), {}, quick=False)}
    assert not {name for name in missing if name.startswith("long-")}
    assert [one.name for one in wanted(("long-f",), {}, quick=False) if one.name not in missing] == ["long-faults", "long-fuzz"]


def test_a_long_flight_states_its_goals_and_those_that_it_misses() -> None:
    for line in (
        "memory of recorder.main at most 2 % larger at the end of the flight than in the middle. Measured: 3 %, **not met**.",
        "- Goal: memory of rise-di fly at most 2 % larger at the end of the flight than in the middle. Measured: 1.11 %, met.",
        "- Goal: no missing sample. Measured: 4, **not met**.\n- Missing samples: y 3, u 1.",
        "- The longest skips, excluding host delays: y 4 ms at 12.3 s, u 10 ms at 50.0 s.",
        "- Goal: no missed tick, excluding host delays. Measured: 0, met.",
        "- Goal: the report is written within 10 s. Measured: 12.5 s, **not met**.",
        "- Goal: all figures of the report (48 MB) drawn within 3 s. Measured: 2.6 s, met.",
    ):
        assert line in page(), line


def test_a_lockstep_flight_has_no_late_ticks_to_state() -> None:
    text = page(**{"long-jsbsim": result("long-jsbsim", LONG_FLIGHT | {"ticks": {}})})
    assert "- In lockstep a tick waits for its inputs: none is missed or late." in text
    assert "Goal: no missed tick" not in text


def test_a_figure_that_depends_on_the_host_is_a_ratio_to_its_baseline_with_the_figure_in_parentheses() -> None:
    assert "| controller, u alone | 1.25 (50) | 4 (320) |" in page()  # 50 / 40 and 320 / 80
    assert "| *bare echo, single* | 1 (40) | 1 (80) |" in page()


def test_a_count_is_not_a_ratio() -> None:
    rows = [row("timer", {"missed": 4}, "timer"), row("loop", {"missed": 2}, "timer")]
    assert "| loop | 2 |" in page(**{"speed-node": result("speed-node", {"rows": rows})})


@pytest.mark.parametrize(("p50", "verdict"), [(80.0, " times, met."), (80.1, " times, **not met**.")])
def test_a_goal_is_met_up_to_its_limit(p50: float, verdict: str) -> None:
    rows = [NODE[0], row("controller", {"p50 (us)": p50}, "bare echo, single", (TWICE,))]
    text = page(**{"speed-node": result("speed-node", {"rows": rows})})
    (line,) = [line for line in text.splitlines() if line.startswith("- Goal: controller: p50 at most 2 times")]
    assert line.endswith(verdict)


def test_the_page_begins_with_the_goals_that_are_not_met() -> None:
    top = page().partition("## ")[0]
    assert "Goals that are not met: - Faults: a killed node is back" in top.replace("\n\n-", " -").replace("\n", " ")
    rows = [NODE[0], row("controller", {"p50 (us)": 80.1}, "bare echo, single", (TWICE,))]
    top = page(**{"speed-node": result("speed-node", {"rows": rows})}).partition("## ")[0]
    assert "\n- The controller's tick compared with an echo's callback: controller: p50 at most 2 times" in top
    met = render(MEASUREMENTS, {"speed-node": RESULTS["speed-node"]})
    assert "Every goal on this page is met." in met


def test_the_controller_is_also_compared_with_the_fastest_echo() -> None:
    assert "Ratios of p50 to that of the fastest echo (bare echo, events): controller, u alone 2.5." in page()  # 50 / 20


def test_the_page_depends_on_every_figure_of_every_result() -> None:
    """Except those that the page omits."""
    before, hidden = page(), {"seconds", "deviation", "status"}
    for name, whole in RESULTS.items():
        for path in leaves(whole["result"]):
            if path[-1] in hidden or path[-2:] == ("turbulence", "lost"):
                continue
            changed = deepcopy(whole)
            inside = changed["result"]
            for key in path[:-1]:
                inside = inside[key]
            inside[path[-1]] = 3 * inside[path[-1]] + 0.5
            assert page(**{name: changed}) != before, f"{name}: {path}"


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all numbers in a tree."""
    if isinstance(tree, dict | list | tuple):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        return [found for key, value in pairs for found in leaves(value, (*path, key))]
    return [path] if isinstance(tree, int | float) and not isinstance(tree, bool) else []


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"quick": True}, "**A short version**, not to be quoted"),
        ({"busy": BUSY + 0.4}, "**The host was busy** at the start, 50 % of its processors in use"),
        ({"result": None, "status": 2}, "**Failed**, with exit status 2: its goals are **not met**"),
        ({"status": 1}, "- Goal: the measurement ends with exit status 0. Measured: 1, **not met**."),
    ],
)
def test_a_measurement_with_reduced_validity_is_marked(changes: dict[str, Any], expected: str) -> None:
    assert expected not in page()
    marked = page(faults=RESULTS["faults"] | changes)
    assert expected in marked
    assert ("- Faults: " + expected.removeprefix("- Goal: ") in marked.partition("## ")[0]) == ("status" in changes)


def test_a_killed_node_is_timed_from_its_start_and_from_its_being_ready() -> None:
    assert "traffic within 0.5 s of its start. Measured: 0.51 s at worst, **not met**." in page()
    assert "traffic within 0.5 s of being ready. Measured: 0.234 s at worst, met." in page()
    assert "| controller killed | 380 / 470 | 310 / 330 | 20 / 50 |" in page()  # of its start: all, running, waiting
    assert "which publishers keep, 400 / 620 ms after being ready." in page()


@pytest.mark.parametrize(("case", "limit"), [("recorder killed under a live page", "1.5"), ("storm on the live page", "2")])
def test_the_page_of_a_flight_has_the_limit_of_its_fault(case: str, limit: str) -> None:
    text = page(faults=result("faults", [FAULT | {"case": case, "page": {"median": 1.0, "worst": 1.6}}]))
    assert f"- Goal: {case}: the page answers, and says so, within {limit} s. Measured: 1.6 s at worst, " in text


def test_the_page_says_that_nothing_was_measured_on_a_screen_without_a_browser() -> None:
    without = {name: part for name, part in VIEW.items() if name not in {"live with a browser", "frozen"}}
    sentence = "not measured, this host has no Chromium."
    assert sentence in page(view=result("view", without))
    assert sentence not in page(view=result("view", VIEW))


@pytest.mark.parametrize(("probability", "verdict"), [(0.05, "0.05, met."), (0.04, "0.04, **not met**.")])
def test_missed_ticks_of_a_watched_flight_are_told_from_chance(probability: float, verdict: str) -> None:
    flights = VIEW["flights"] | {"probability with": dict.fromkeys(PAIRS, probability)}
    text = page(view=result("view", VIEW | {"flights": flights}))
    assert f"with a client than without, beyond chance (3 to 3): probability at least 0.05. Measured: {verdict}" in text
    assert "| with a client and the start of its server | 3, 0 | 0.5, 1.23 |" in text
    assert "| with a client: median of the differences, 95 % interval | 0.05 (-1.5 to 2.5) | " in text
    assert "late p99, with a client and the start of its server within 0.1 ms of that without, " in text
    assert "Measured: 0.15 ms more, **not met**." in text
    assert "- The start of the server takes 1.25 to 1.5 s." in text


def test_a_busy_host_is_marked_only_for_timed_measurements() -> None:
    assert "host was busy" not in page(replay=RESULTS["replay"] | {"busy": 1.0})


def test_a_timed_measurement_names_those_that_ran_at_the_same_time() -> None:
    hour = {"seconds": 3600.0}
    fuzz = RESULTS["long-fuzz"] | hour | {"date": "2020-01-02 04:00 UTC"}  # the others began at 03:04
    assert "long-fuzz ran at the same time" in page(**{"faults": RESULTS["faults"] | hour, "long-fuzz": fuzz})
    assert "at the same time" not in page(**{"replay": RESULTS["replay"] | hour, "long-fuzz": fuzz})  # it has no times
    later = fuzz | {"date": "2020-01-02 04:04 UTC"}
    assert "at the same time" not in page(**{"faults": RESULTS["faults"] | hour, "long-fuzz": later})


def test_a_random_fault_that_failed_is_named_with_its_seed() -> None:
    failed = {"seed": 417, "case": "storm on y, recorder killed", "error": "not within 3 s: detected"}
    drawn = {"draws": 9, "two": 1, "lockstep": 0, "passed": 7, "failed": [failed]}  # and one that was not injected
    text = page(**{"random-faults": result("random-faults", drawn)})
    assert "- Seed 417, storm on y, recorder killed: not within 3 s: detected" in text
    assert "no draw fails. Measured: 2 of 9, **not met**" in text


def test_a_fault_that_did_not_pass_each_time_is_bold() -> None:
    assert "1 of 1 cases passed every time." in page()
    text = page(faults=result("faults", [FAULT | {"passed": 9}], status=1))
    assert "0 of 1 cases passed every time." in text
    assert "- Goal: every fault ends as expected. Measured: 1 of 10 do not, **not met**." in text
    assert "| **9** |" in text


def test_an_input_that_fuzzing_found_is_a_goal_that_is_not_met() -> None:
    text = page(**{"fuzz-coverage": result("fuzz-coverage", {"mcap": COVERAGE | {"status": 77}})})
    assert "- Goal: no fuzzer ends with a finding or an error. Measured: 1 of 1 readers, **not met**." in text
    assert "| **ended with status 77** |" in text


def test_a_failed_test_is_bold() -> None:
    failed = [{"name": "test_an_attacker_receives_nothing[far]", "outcome": "failed", "seconds": 1.0}]
    assert "| an attacker receives nothing | passed |" in page()
    text = page(security=result("security", failed, status=1))
    assert "| an attacker receives nothing | **failed** |" in text
    assert "- Goal: no test fails. Measured: 1 of 1, **not met**." in text


def test_a_scenario_that_replays_differently_is_bold() -> None:
    differing = {"outcome": "completed", "ticks": 6001, "checked": 6001, "equal": False, "differing": 17}
    for replay, cell in ((differing, "**17 ticks differ**"), ({"outcome": ["error: no aircraft"]}, "**no flight**")):
        text = page(replay=result("replay", {"osprey_gust": replay}))
        assert cell in text
        assert "- Goal: every scenario replays to the bit. Measured: 1 of 1 do not, **not met**." in text


def test_the_lowest_score_among_laws_with_the_same_measurements_and_knowledge_is_bold() -> None:
    assert "| rise | y | Omega | **1.61** | **1.75** (**2.48**) | 2.61 |" in page()
    assert "| pi | y | Omega | 1.72 | **1.75** (**2.48**) | **2.51** |" in page()
    model = LAW | {"law": "lqg", "knows": "A, B", "score": {"gust": 9.0, "turbulence": 9.0}}
    assert "| lqg | y | A, B | **9.00** |" in page(compare=result("compare", COMPARED | {"laws": [LAW, model]}))


def test_the_share_of_lost_aircraft_is_shown_by_the_delay_of_u_and_the_cost_with_its_spread() -> None:
    assert "lost at +-30 %, %, u late by 0 / 20 ms |" in page()
    assert "| 0 / 26 | 0.077 | 7.25 +0.50 |" in page()


def test_the_score_of_a_diverged_law_is_a_word() -> None:
    lost = LAW | {"law": "di", "levels": [LEVEL | {"gust": UNCERTAIN | {"mean": None, "worst": None}}]}
    compared = result("compare", COMPARED | {"laws": [LAW, lost]})
    assert "| di | y | Omega | **1.61** | diverged (diverged) |" in page(compare=compared)


def test_each_table_has_as_many_cells_as_headings() -> None:
    for table in re.findall(r"(?:^\|.*\n)+", page(), re.MULTILINE):
        assert len({line.replace("\\|", "").count("|") for line in table.splitlines()}) == 1, table


def test_a_program_that_measures_ends_before_the_terminated_evidence(tmp_path: Path) -> None:
    begun, ended = tmp_path / "begun", tmp_path / "ended"
    child = f"import pathlib, time\ntry:\n pathlib.Path({str(begun)!r}).touch()\n time.sleep(60)\n"
    child += f"except KeyboardInterrupt:\n pathlib.Path({str(ended)!r}).touch()"
    program = (
        f"from benchmarks import evidence\nevidence.RESULTS = evidence.Path({str(tmp_path)!r})\nevidence.exit_on_sigterm()\n"
    )
    program += f"evidence.measure(evidence.Measurement('one', ('python', '-c', {child!r}), (), '', ''), quick=False)"
    with subprocess.Popen([sys.executable, "-c", program], cwd=REPOSITORY) as running:
        while running.poll() is None and not begun.exists():
            time.sleep(0.01)
        running.terminate()
    assert (running.returncode, ended.exists()) == (128 + signal.SIGTERM, True)


def test_exactly_the_missing_failed_and_short_measurements_run() -> None:
    stored = {one.name: result(one.name, []) for one in MEASUREMENTS}
    assert wanted([], stored, quick=False) == []
    assert [one.name for one in wanted(["speed-"], stored, quick=False)] == [f"speed-{group}" for group in SPEED]
    del stored["faults"]
    stored |= {"compare": result("compare", None, status=1), "security": result("security", [], quick=True)}
    assert [one.name for one in wanted([], stored, quick=False)] == ["faults", "security", "compare"]
    assert [one.name for one in wanted([], stored, quick=True)] == ["faults", "compare"]


def test_every_measuring_program_exists() -> None:
    repository = Path(__file__).parents[2]
    for one in MEASUREMENTS:
        for command in (one.command, one.quick):
            if "-m" in command and command[2].startswith("benchmarks."):
                assert (repository / f"{command[2].replace('.', '/')}.py").exists(), command
            for part in command:
                assert not part.startswith("tests/") or (repository / part).exists(), part


def test_outcomes_of_tests_are_read_from_the_junit_file() -> None:
    junit = """<testsuites><testsuite>
        <testcase name="test_a" time="0.5"/>
        <testcase name="test_b[x]" time="1"><failure>no</failure></testcase>
        <testcase name="test_c" time="0"><skipped/></testcase>
        <testcase name="test_d" time="0"><error/></testcase>
    </testsuite></testsuites>"""
    assert [tuple(one.values()) for one in cases(junit)] == [
        ("test_a", "passed", 0.5),
        ("test_b[x]", "failed", 1.0),
        ("test_c", "skipped", 0.0),
        ("test_d", "failed", 0.0),
    ]


def test_a_result_is_the_file_of_a_program_else_its_output_else_none(tmp_path: Path) -> None:
    left = tmp_path / "left.json"
    assert read(left, '{"a": 1}') == {"a": 1}
    assert read(left, "Traceback") is None
    left.write_text(json.dumps([2]), encoding="utf-8")
    assert read(left, '{"a": 1}') == [2]
    assert read(tmp_path / "left.xml", "") is None

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Evidence: the rows of every result, their goals, and the page, which is a function of the stored rows alone."""

import json
import signal
import subprocess
import sys
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from benchmarks import autopilots, evidence_data, learning
from benchmarks.evidence import EXIT_STATUS, MEASUREMENTS, SPEED, cases, read_result, rows_of, wanted
from benchmarks.evidence_data import BUSY, FOLDER, REPOSITORY, Measured, Origin, Row, read, row, used, write
from benchmarks.evidence_page import PAGE, TITLES, page

pytestmark = pytest.mark.slow

ORIGIN = Origin("measure", "abc1234", "a processor, 2 cores", "2020-01-02 03:04 UTC")
TWICE = {"column": "p50 (us)", "at_most": 2.0, "of_floor": True}


def of_speed(what: str, figures: dict[str, float], floor: str = "", goals: tuple[dict[str, Any], ...] = ()) -> dict[str, Any]:
    return {"what": what, "figures": figures, "floor": floor, "goals": goals}


NODE = [
    of_speed("bare echo, single", {"p50 (us)": 40.0, "p99 (us)": 80.0}, "bare echo, single"),
    of_speed("bare echo, events", {"p50 (us)": 20.0, "missed": 60.0}, "bare echo, single"),
    of_speed("controller, u alone", {"p50 (us)": 50.0, "p99 (us)": 320.0}, "bare echo, single", (TWICE,)),
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
PI = LAW | {"law": "pi", "levels": [LEVEL | {"gust": UNCERTAIN | {"mean": None}}]}
TRADED = {
    "law": "pi",
    "asked": "45",
    "found": 45.6,
    "score": {"0.5": {"mean": 1.75, "worst": 2.48}},
    "lost_late": {"0.5": 0.26},
}
FIGURE = {"mean": 1.31, "q50": 1.21, "q95": 2.31, "q99": 2.71, "worst": 3.01, "deviation": 0.1}
COVERAGE = {"status": 0, "covered": 1234, "number_of_executed_units": 98765, "peak_rss_mb": 321}
CAMPAIGN: dict[str, Any] = {"whole": 120_000.0, "flown": 150_000.0, "memory_early": 900.0, "memory": 905.0, "aircraft": 10_000}
CAMPAIGN |= {"plain": 50.0, "exact": 4, "integration": {"q": 0.0021, "V": 0.0005}}
SHARE = {"count": 3, "share": 3e-4, "low": 1e-4, "high": 9e-4}
DELAYS = {"p50": 0.052, "p99": 0.24}
BESIDE = {"processor": 0.027, "memory": 76.0, "traffic": 22_000.0, "flight": 30.0}
PAIRS = {"missed ticks": [3, 0], "late p99 (ms)": [0.5, 1.23]}
VIEW: dict[str, Any] = {"live": BESIDE, "live with a browser": {"to the screen": DELAYS}}
VIEW |= {"frozen": {"frozen": 10.0, "recovered after": 0.4}}
VIEW |= {"opened": {"flight": 3600.0, "first samples": 0.4, "whole log": 5.0, "processor": 4.6, "memory": 157.0, "log": 626.0}}
WATCHED: dict[str, Any] = dict.fromkeys(("without", "with", "start included"), PAIRS) | {"starting": [1.25, 1.5]}
for kind, more in (("with", 0.05), ("start included", 0.15)):
    WATCHED |= {f"more {kind}": dict.fromkeys(PAIRS, more), f"interval {kind}": {key: [-1.5, 2.5] for key in PAIRS}}
    WATCHED |= {f"probability {kind}": dict.fromkeys(PAIRS, 0.5)}
VIEW |= {"flights": WATCHED}
LONG_FLIGHT: dict[str, Any] = {"flight": "the c172p, in lockstep", "took": 1500.0, "outcome": "completed", "minutes": 60.0}
LONG_FLIGHT |= {
    "legs": 62,
    "missing": {"missing samples": {"y": 3, "u": 1}},
    "lost": 0,
    "xtrack": 6.5,
    "bank_deg": 30.5,
    "V": 40.5,
}
LONG_FLIGHT |= {"guidance": {"steps": 180_001, "differing": 0}, "memory": {"recorder.main": [100e6, 103e6]}}
LONG_FLIGHT |= {"ticks": {"missed ticks": 3, "missed ticks, excluding host delays": 0}}
LONG_FLIGHT |= {"longest skips": [{"topic": "y", "t": 12.34, "length": 0.004}, {"topic": "u", "t": 50.0, "length": 0.01}]}
LONG_FLIGHT |= {
    "report": {"size": 48.1e6, "memory": 900e6, "written": 12.5, "opened": {"figures in view": 1.2, "all figures": 2.6}}
}
FLEET = {"flights": 10_000, "figures": {"score": FIGURE}, "diverged": SHARE, "lost": SHARE}
FAILED = {"seed": 417, "case": "storm on y", "error": "not within 3 s: detected"}
RESULTS: dict[str, Any] = {
    "speed-node": {"rows": NODE},
    "faults": [FAULT],
    "random-faults": {"draws": 110, "two": 9, "lockstep": 10, "passed": 109, "failed": [FAILED]},
    "security": [{"name": "test_an_attacker_receives_nothing", "outcome": "passed", "seconds": 1.0}],
    "fuzz-coverage": {"mcap": COVERAGE},
    "long-fuzz": {"mcap": COVERAGE},
    "long-jsbsim": LONG_FLIGHT,
    "campaign": CAMPAIGN,
    "campaign-fleet": {"cases": [FLEET]},
    "cluster": {"faults": "worker killed", "workers": 4, "aircraft": 2000, "chunks": 40, "same": 39},
    "compare": COMPARED | {"laws": [LAW, PI]},
    "margins": {"aircraft": 200, "seed": 1, "rows": [TRADED]},
    "view": VIEW,
    "replay": {"osprey_gust": {"outcome": "completed", "ticks": 6001, "checked": 6001, "equal": True}},
}


MEASUREMENT = {measurement.name: measurement for measurement in MEASUREMENTS}


def rows(name: str, result: Any) -> dict[str, Row]:
    """The rows of a result by name."""
    return {figure.name: figure for figure in MEASUREMENT[name].rows(result)}


def missed(figures: dict[str, Row]) -> list[str]:
    return [name for name, figure in figures.items() if (used(figure, figures) or 0.0) > 1.0]


def measured(*figures: Row, **changes: str) -> Measured:
    return Measured(figures, ORIGIN._replace(**changes))


def test_page_is_function_of_data() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(read())


def test_page_stays_short() -> None:
    """The sections have a line for each measurement. The goals that are missed stand above: no test limits their number."""
    lines = page(read()).splitlines()
    assert len(lines) - lines.index("## Faults") <= 120


def test_data_is_stable_and_complete(tmp_path: Path) -> None:
    """Each file is what `write` makes of its own rows, has a title, and each baseline is a row of the same file."""
    offenders = []
    for name, measurement in read().items():
        write(name, measurement.rows, measurement.origin, tmp_path)
        names = {figure.name for figure in measurement.rows}
        if (tmp_path / f"{name}.csv").read_bytes() != (FOLDER / f"{name}.csv").read_bytes() or name not in TITLES:
            offenders.append(name)
        offenders += [f"{name}: {figure.name}" for figure in measurement.rows if figure.baseline not in {"", *names}]
    assert offenders == []


def test_ambiguous_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="found a name twice"):
        write("speed-law", [Row("a", "1"), Row("a", "2")], ORIGIN, tmp_path)
    write("speed-law", [Row("a", "1"), Row("b", "2")], ORIGIN, tmp_path)
    file = tmp_path / "speed-law.csv"
    file.write_text(file.read_text(encoding="utf-8").replace("abc1234", "def5678", 1), encoding="utf-8")
    with pytest.raises(ValueError, match="2 origins"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("value", "goal", "met"),
    [
        ("2", "<= 2", True),
        ("2.01", "<= 2", False),
        ("0", "<= 0", True),
        ("-43.3", "<= 0", True),
        ("1", "<= 0", False),
        ("0.05", ">= 0.05", True),
        ("0.04", ">= 0.05", False),
        ("0", ">= 10", False),
        ("nan", "<= 2", False),
        ("inf", "<= 2", False),
        ("not measured", "<= 2", False),
    ],
)
def test_goal_is_met_up_to_its_limit(value: str, goal: str, met: bool) -> None:
    assert ((used(Row("time", value, goal=goal), {}) or 0.0) <= 1.0) is met


@pytest.mark.parametrize(("p50", "verdict"), [("80", "| 1 of 1 | controller: p50 2 times"), ("80.1", "| **0 of 1** |")])
def test_goal_on_a_ratio(p50: str, verdict: str) -> None:
    """The baseline has 40 us, the limit is twice."""
    goal = Row("controller: p50", p50, "us", "echo: p50", "<= 2 x baseline")
    assert verdict in page({"speed-node": measured(goal, Row("echo: p50", "40", "us"))})


def test_page_begins_with_missed_goals() -> None:
    """The worst of the figures with the same goal, with their number."""
    figures = [Row(f"{name}: time", value, "s", goal="<= 2") for name, value in (("a", "2.5"), ("b", "3"), ("c", "1"))]
    text = page({"faults": measured(*figures), "view": measured(Row("d", "1", goal="<= 1"))})
    top, _, sections = text.partition("## Faults")
    assert "| b: time, 2 of 3 miss | **3 s** | at most 2 |" in top
    assert "evidence/view.csv" not in top
    assert "| **1 of 3** | time **3 s** (at most 2) | abc1234, 2020-01-02 |" in sections
    assert "| 1 of 1 | d 1 (at most 1) |" in sections


def test_page_names_what_is_not_measured() -> None:
    assert f"| {TITLES['compare']} | - | not measured | - |" in page({})


def test_page_names_busy_host_and_missing_revision() -> None:
    text = page({"faults": measured(Row("a", "1"), host=f"a processor, 50 % {BUSY}", revision="")})
    assert "| - | no goal | not recorded, 2020-01-02, busy host |" in text


def test_failed_measurement_misses_a_goal() -> None:
    """Also where it left a result."""
    failed = rows_of(MEASUREMENT["faults"], None, 2)
    assert failed == [Row(EXIT_STATUS, "2", goal="<= 0")]
    assert f"| {EXIT_STATUS} | **2** | at most 0 |" in page({"faults": measured(*failed)})
    assert rows_of(MEASUREMENT["faults"], None, 0)[0].value == "no result"
    assert rows_of(MEASUREMENT["faults"], [FAULT], 1)[0] == Row(EXIT_STATUS, "1", goal="<= 0")
    assert EXIT_STATUS not in {figure.name for figure in rows_of(MEASUREMENT["faults"], [FAULT], 0)}


def test_rows_depend_on_every_figure() -> None:
    """Except those that the rows omit."""
    hidden = {"seconds", "deviation"}
    for name, result in RESULTS.items():
        before = rows(name, result)
        for path in leaves(result):
            if path[-1] in hidden or path[-2:] == ("turbulence", "lost"):
                continue
            changed = deepcopy(result)
            inside = changed
            for key in path[:-1]:
                inside = inside[key]
            inside[path[-1]] = 3 * inside[path[-1]] + 0.5
            assert rows(name, changed) != before, f"{name}: {path}"


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all numbers in a tree."""
    if isinstance(tree, dict | list | tuple):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        return [leaf for key, value in pairs for leaf in leaves(value, (*path, key))]
    return [path] if isinstance(tree, int | float) and not isinstance(tree, bool) else []


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("speed-node", Row("controller, u alone: p50", "50", "us", "bare echo, single: p50", "<= 2 x baseline")),
        ("speed-node", Row("controller, u alone: p50 over that of the fastest echo", "2.5")),  # 50 / 20
        ("speed-node", Row("bare echo, events: missed", "60")),  # a count has no baseline
        ("faults", Row("controller killed: traffic from its start, worst", "510", "ms", goal="<= 500")),
        ("faults", Row("controller killed: passed", "10", goal=">= 10")),
        ("faults", Row("controller killed: start to ready, main thread runs, median", "310", "ms")),
        ("security", Row("an attacker receives nothing: passed", "1", "cases")),
        ("fuzz-coverage", Row("mcap: exit status of the fuzzer", "0", goal="<= 0")),
        ("long-jsbsim", Row("recorder.main: growth of the memory from the middle to the end", "3", "%", goal="<= 2")),
        ("long-jsbsim", Row("y: missing samples", "3", goal="<= 0")),
        ("long-jsbsim", Row("y at 12.3 s: skip, excluding host delays", "4", "ms")),
        ("long-jsbsim", Row("missed ticks", "3")),
        ("long-jsbsim", Row("missed ticks, excluding host delays", "0", goal="<= 0")),
        ("long-jsbsim", Row("report: all figures drawn", "2.6", "s", goal="<= 3")),
        ("campaign", Row("campaign with compilation: speed", "120000", "aircraft-s/s", "loop in one process: speed")),
        ("campaign", Row("memory at the end over that after a third", "1.00556", goal="<= 1.1")),
        ("campaign", Row("1,000,000 aircraft of 60 s with gusts on a GPU", "not measured", "s", goal="<= 10")),
        ("cluster", Row("chunks with other bytes than in one process", "1", goal="<= 0")),
        ("compare", Row("rise, tuned on gust: score, gust, +-30 %, worst", "2.48")),
        ("compare", Row("pi, tuned on gust: score, gust, +-30 %, mean", "diverged")),
        ("compare", Row("rise, tuned on gust: lost, +-30 %, u late by 20 ms", "26", "%")),
        ("margins", Row("pi, 45 deg asked: phase margin", "45.6", "deg")),
        ("margins", Row("pi, 45 deg asked: lost, +-50 %, u late by 20 ms", "26", "%")),
        ("view", Row("log of 1 h: read whole after the start of rise-di watch", "5", "s", goal="<= 3")),
        ("view", Row("flight 2, with a client: late p99", "1.23", "ms")),
        ("view", Row("with a client: late p99, median of the differences", "0.05", "ms", goal="<= 0.1")),
        ("replay", Row("osprey_gust: ticks that replay differently", "0", goal="<= 0")),
        ("random-faults", Row("seed 417: failure", "storm on y: not within 3 s: detected")),
    ],
)  # fmt: skip
def test_row_of_a_result(name: str, expected: Row) -> None:
    assert rows(name, RESULTS[name])[expected.name] == expected


PAGE_TIMES = FAULT | {"exec_to_traffic": TIMES, "page": {"median": 1.0, "worst": 1.6}}
LIVE_PAGE = "recorder killed under a live page"
WITHOUT_BROWSER = {name: part for name, part in VIEW.items() if name not in {"live with a browser", "frozen"}}
ON_A_SCREEN = {"to the screen: p50", "to the screen: p99", "page frozen for 10 s: less than 300 ms behind after"}
BY_CHANCE = {"probability with": dict.fromkeys(PAIRS, 0.04), "probability start included": dict.fromkeys(PAIRS, 0.05)}
LATE = "with a client and the start of its server: late p99, median of the differences"  # 0.15 ms of 0.1
READ = "log of 1 h: read whole after the start of rise-di watch"  # 5 s of 3
CHANCE = "with a client: missed ticks, probability of as large a mean difference by chance"
DIFFERS = {"outcome": "completed", "ticks": 9, "checked": 9, "equal": False, "differing": 1}
MISSES: tuple[tuple[str, Any, set[str]], ...] = (
    ("faults", [PAGE_TIMES | {"passed": 9}], {"controller killed: passed"}),
    ("faults", [PAGE_TIMES | {"case": LIVE_PAGE}], {f"{LIVE_PAGE}: page answers and says so, worst"}),
    ("random-faults", {"draws": 9, "two": 1, "lockstep": 0, "passed": 7, "failed": []}, {"draws that fail"}),
    ("security", [{"name": "test_a[x]", "outcome": "failed"}], {"cases that failed", "a: failed"}),
    ("fuzz", [{"name": "test_a", "outcome": "skipped"}], set()),
    ("fuzz-coverage", {"mcap": COVERAGE | {"status": 77}}, {"mcap: exit status of the fuzzer"}),
    ("replay", {"a": {"outcome": ["error: no aircraft"]}}, {"a: ticks that replay differently"}),
    ("replay", {"a": DIFFERS}, {"a: ticks that replay differently"}),
    ("view", WITHOUT_BROWSER, {LATE, READ} | ON_A_SCREEN),  # not measured
    ("view", VIEW | {"flights": VIEW["flights"] | BY_CHANCE}, {LATE, READ, CHANCE}),
)


@pytest.mark.parametrize(("name", "result", "goals"), MISSES)
def test_results_that_miss_their_goals(name: str, result: Any, goals: set[str]) -> None:
    assert set(missed(rows(name, result))) == goals


FLOWN: dict[str, Any] = {"rms": {"q": 0.011, "V": 0.04}, "behind": {"q": 0.0, "V": 0.02}, "limited": {"elevator": 0.5}}
FLOWN |= {"engaged": [{"start": 1.0, "stop": 60.0, "reason": "y too old"}], "delay_margin": 0.05, "replayed": True}
FLOWN |= {"controller": {"outputs": ["q", "V"], "k_g": 1.1, "k_d": [3.2], "lag": [0.06, 0.05], "delay": 0.04}}


def of_autopilot(name: str, result: Any) -> dict[str, Row]:
    return {figure.name: figure for figure in autopilots.ROWS[name](result)}


def test_rows_of_identified_gains() -> None:
    figures = of_autopilot("arduplane", FLOWN)
    assert figures["q: rms of e while commanded"] == Row("q: rms of e while commanded", "11", "mrad/s", goal="<= 10")
    assert figures["V: rms of e while commanded"] == Row("V: rms of e while commanded", "0.04", "m/s", goal="<= 0.05")
    assert figures["engaged until"].value == "60 s: y too old"
    assert missed(figures) == ["q: rms of e while commanded"]
    assert missed(of_autopilot("px4", {"refused": "error: no sign of the elevator\n"})) == ["flight with identified gains"]


def test_rows_of_signs() -> None:
    """One of two experiments calls a right sign wrong, and so finds no flipped sign for sure."""
    right = {"turbulence": 0.5, "as flown": {"a": "right", "b": "right"}}
    right |= {"flipped": {"a": {"a": "wrong", "b": "right"}, "b": {"a": "right", "b": "wrong"}}}
    figures = of_autopilot("signs", {"experiments": [right, right | {"as flown": {"a": "wrong", "b": "right"}}]})
    assert figures["SIM_WIND_TURB 0.5: right signs, called wrong"].value == "1"
    assert figures["SIM_WIND_TURB 0.5: flipped signs, found"].value == "4"
    assert missed(figures) == [
        "experiments that call a right sign wrong",
        "experiments up to SIM_WIND_TURB 0.5 that miss a sign or a flipped one",
    ]


def test_release_without_a_time_misses() -> None:
    suite = {"tests": 2, "failures": 0, "errors": 0, "skipped": 0, "failed": []}
    times = dict.fromkeys(autopilots.RELEASE_GOALS, 0.1) | {"PX4, disarmed": 0.5}
    assert missed(of_autopilot("releases", suite | {"times": times})) == []
    del times["PX4, release"]
    (name,) = missed(of_autopilot("releases", suite | {"times": times}))
    assert name == "PX4, release: until the sticks or PX4's own law act"


def test_terminated_evidence_ends_its_program(tmp_path: Path) -> None:
    begun, ended = tmp_path / "begun", tmp_path / "ended"
    child = f"import pathlib, time\ntry:\n pathlib.Path({str(begun)!r}).touch()\n time.sleep(60)\n"
    child += f"except KeyboardInterrupt:\n pathlib.Path({str(ended)!r}).touch()"
    program = f"from benchmarks import evidence\nfolder = evidence.BUILD = evidence.Path({str(tmp_path)!r})\n"
    program += "evidence.exit_on_sigterm()\n"
    program += f"evidence.measure(evidence.Measurement('a', ('python', '-c', {child!r}), (), list, ''), folder, quick=False)"
    with subprocess.Popen([sys.executable, "-c", program], cwd=REPOSITORY) as running:
        while running.poll() is None and not begun.exists():
            time.sleep(0.01)
        running.terminate()
    assert (running.returncode, ended.exists()) == (128 + signal.SIGTERM, True)


def test_missing_and_failed_measurements_run() -> None:
    """By name, those that begin so: the long ones run by name alone."""
    stored = {measurement.name: measured(Row("a", "1")) for measurement in MEASUREMENTS}
    assert wanted([], stored) == []
    assert [each.name for each in wanted(["speed-"], stored)] == [f"speed-{group}" for group in SPEED]
    assert [each.name for each in wanted(["long-f"], {})] == ["long-faults", "long-fuzz"]
    assert not [each.name for each in wanted([], {}) if each.name.startswith("long-")]
    del stored["faults"]
    stored |= {"compare": measured(row(EXIT_STATUS, 1, at_most=0)), "view": measured(row(EXIT_STATUS, 1), Row("a", "1"))}
    assert [each.name for each in wanted([], stored)] == ["faults", "compare"]


def test_measuring_programs_exist() -> None:
    commands = [command for measurement in MEASUREMENTS for command in (measurement.command, measurement.quick)]
    files = [f"{part.replace('.', '/')}.py" for command in commands for part in command if part.startswith("benchmarks.")]
    files += [part for command in commands for part in command if part.startswith("tests/")]
    assert [file for file in files if not (REPOSITORY / file).exists()] == []


def test_outcomes_are_read_from_junit() -> None:
    junit = """<testsuites><testsuite>
        <testcase name="test_a" time="0.5"/>
        <testcase name="test_b[x]" time="1"><failure>no</failure></testcase>
        <testcase name="test_c" time="0"><skipped/></testcase>
        <testcase name="test_d" time="0"><error/></testcase>
    </testsuite></testsuites>"""
    assert [tuple(case.values()) for case in cases(junit)] == [
        ("test_a", "passed", 0.5),
        ("test_b[x]", "failed", 1.0),
        ("test_c", "skipped", 0.0),
        ("test_d", "failed", 0.0),
    ]


def test_result_of_a_program(tmp_path: Path) -> None:
    left = tmp_path / "left.json"
    assert read_result(left, '{"a": 1}') == {"a": 1}
    assert read_result(left, "Traceback") is None
    left.write_text(json.dumps([2]), encoding="utf-8")
    assert read_result(left, '{"a": 1}') == [2]
    assert read_result(tmp_path / "left.xml", "") is None


def test_revision_of_paths_is_the_last_commit_that_touched_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*arguments: str) -> str:
        command = ("git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments)
        return subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    commits = []
    for name in ("law", "page"):
        (tmp_path / name).write_text(name, encoding="utf-8")
        git("add", name)
        git("commit", "-qm", name)
        commits.append(git("rev-parse", "--short", "HEAD"))
    monkeypatch.setattr(evidence_data, "REPOSITORY", tmp_path)
    assert [evidence_data.revision(name) for name in ("law", "page")] == commits
    (tmp_path / "page").write_text("changed", encoding="utf-8")
    assert [evidence_data.revision(name) for name in ("law", "page")] == [commits[0], f"{commits[1]}-dirty"]


def test_learning_measurement_flies_what_is_missing_and_writes_whole_cells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[tuple[str, set[str]]] = []
    monkeypatch.setattr(evidence_data, "revision", lambda *paths: "abc" if paths else "of all")
    monkeypatch.setattr(learning, "write_page", lambda: None)
    monkeypatch.setattr(
        evidence_data,
        "write",
        lambda name, rows, origin: written.append((origin.revision, {row.name.partition(":")[0] for row in rows})),
    )
    of_dead = [learning.Row("dead", n, 1.0, 1.0, 1.0, revision="abc", dead="rudder") for n in range(2)]
    others = [learning.Row("weak", 0, 1.0, 1.0, 1.0, 1.0, revision="abc"), of_dead[0]._replace(revision="older")]
    learning.write(tmp_path / "rows.csv", [*of_dead, *others])
    learning.main(aircraft=4, cell=["dead"], results=tmp_path / "rows.csv", jobs=1)  # half of the four have a dead surface
    assert written == [("of all", {"dead"})]  # of the cell "weak" a row is missing

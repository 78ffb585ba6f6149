# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The rows of evidence of the results of measuring programs, with goals."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from benchmarks.evidence_data import Row, row

Rows = Callable[[Any], Iterable[Row]]
ECHOES = ("bare echo, single", "bare echo, multi", "bare echo, events")
WITHOUT_BASELINE = ("missed", "missed excluding host delays", "lost", "ticks", "max (us)", "answered (%)")
"""Counts, single outliers, and shares."""

FAULT_TIMES: dict[str, tuple[str, float | None]] = {
    "reaction": ("reaction", None),
    "recovery": ("recovery", None),
    "longest_pause": ("longest pause", None),
    "held_back": ("host delay", None),
    "exec_to_traffic": ("traffic from its start", 500.0),
    "ready_to_traffic": ("traffic from being ready", 500.0),
    "ready_to_caught_up": ("recorder caught up from being ready", None),
    "exec_to_ready": ("start to ready", None),
    "start_run": ("start to ready, main thread runs", None),
    "start_waited": ("start to ready, main thread waits for a processor", None),
}
"""Times of a fault, by key of the result: name and limit, ms."""

BANKS = {"bank_deg": ("bank", 45.0), "last_bank_deg": ("bank ten seconds later", 5.0)}  # deg
PAGE_LIMITS = {"recorder killed under a live page": 1500.0}  # ms, until the page answers; else PAGE_LIMIT
PAGE_LIMIT = 2000.0


def split(name: str) -> tuple[str, str]:
    """A name and its unit: "late p99" and "ms" of "late p99 (ms)"."""
    parts = re.fullmatch(r"(.+?) \(([^()]+)\)(.*)", name)
    return (parts[1] + parts[3], parts[2]) if parts else (name, "")


def speed(result: Any) -> Iterator[Row]:
    """Of a group of benchmarks/speed.py."""
    rows = result["rows"]
    by_name = {of["what"]: of["figures"] for of in rows}
    medians = {what: figures["p50 (us)"] for what, figures in by_name.items() if "p50 (us)" in figures}
    fastest = min((medians[name] for name in ECHOES if name in medians), default=None)
    for of in rows:
        what, floor = of["what"], of["floor"]
        goals = {goal["column"]: goal for goal in of["goals"]}
        for column, value in of["figures"].items():
            figure, unit = split(column)
            goal = goals.get(column, {"at_most": None, "of_floor": False})
            compared = floor != what and column in by_name.get(floor, {}) and column not in WITHOUT_BASELINE
            yield row(
                f"{what}: {figure}",
                value,
                unit,
                at_most=goal["at_most"],
                of_baseline=goal["of_floor"],
                baseline=f"{floor}: {figure}" if compared else "",
            )
        if fastest is not None and what in medians and what not in ECHOES:
            yield row(f"{what}: p50 over that of the fastest echo", medians[what] / fastest)


def faults(result: Any) -> Iterator[Row]:
    """Of benchmarks/faults.py: by fault the median and the worst of times, ms, and of banks, deg."""
    for fault in result:
        case = fault["case"]
        yield row(f"{case}: injected", fault["injected"])
        yield row(f"{case}: passed", fault["passed"], at_least=fault["injected"])
        page = {"page": ("page answers and says so", PAGE_LIMITS.get(case, PAGE_LIMIT))}
        figures = [(key, 1e3, "ms", *of) for key, of in (FAULT_TIMES | page).items()]
        for key, factor, unit, name, limit in (*figures, *((key, 1.0, "deg", *of) for key, of in BANKS.items())):
            for kind, value in (fault.get(key) or {}).items():
                yield row(f"{case}: {name}, {kind}", factor * value, unit, at_most=limit if kind == "worst" else None)
    yield row("runs with a host delay above 20 ms", sum(fault["any_delay"] for fault in result))


def random_faults(result: Any) -> Iterator[Row]:
    """Of benchmarks/random_faults.py."""
    yield row("draws", result["draws"])
    yield row("draws of two faults at a time", result["two"])
    yield row("draws in lockstep", result["lockstep"])
    yield row("draws that fail", result["draws"] - result["passed"], at_most=0)
    for draw in result["failed"]:
        yield row(f"seed {draw['seed']}: failure", f"{draw['case']}: {draw['error']}"[:200])


def tests(result: Any) -> Iterator[Row]:
    """Of pytest: how many cases of a test passed, failed and were skipped."""
    totals = Counter({"passed": 0, "failed": 0, "skipped": 0})
    by_test: Counter[tuple[str, str]] = Counter()
    for case in result:
        totals[case["outcome"]] += 1
        by_test[case["name"].partition("[")[0].removeprefix("test_").replace("_", " "), case["outcome"]] += 1
    for outcome, count in totals.items():
        yield row(f"cases that {'were ' * (outcome == 'skipped')}{outcome}", count, at_most=0 if outcome == "failed" else None)
    for (name, outcome), count in by_test.items():
        yield row(f"{name}: {outcome}", count, "cases", at_most=0 if outcome == "failed" else None)


def fuzz(result: Any) -> Iterator[Row]:
    """Of the fuzzers: a status other than 0 is a finding or an error."""
    for target, of in result.items():
        yield row(f"{target}: inputs tried", of.get("number_of_executed_units"))
        yield row(f"{target}: branches covered", of["covered"])
        yield row(f"{target}: memory", of.get("peak_rss_mb"), "MB")
        yield row(f"{target}: exit status of the fuzzer", of["status"], at_most=0)


def long_flight(result: Any) -> Iterator[Row]:
    """Of benchmarks/long_flight.py."""
    guidance, report = result["guidance"], result["report"]
    yield row("flight", result["flight"])
    yield row("outcome", result["outcome"])
    yield row("flight time", result["minutes"], "min")
    yield row("time taken, with the first report", result["took"] / 60.0, "min")
    yield row("legs", result["legs"])
    yield row("largest cross-track error after 30 s", result["xtrack"], "m")
    yield row("largest bank", result["bank_deg"], "deg")
    yield row("lowest V", result["V"], "m/s")
    for process, (middle, end) in result["memory"].items():
        yield row(f"{process}: memory in the middle", middle / 1e6, "MB")
        yield row(f"{process}: memory at the end", end / 1e6, "MB")
        yield row(f"{process}: growth of the memory from the middle to the end", 100.0 * (end / middle - 1.0), "%", at_most=2)
    *_, judged = result["missing"]  # excluding host delays where they are known
    for figure, missing in result["missing"].items():
        for topic, count in missing.items():
            yield row(f"{topic}: {figure}", count, at_most=0 if figure == judged else None)
    for skip in result.get("longest skips", [])[:5]:
        yield row(f"{skip['topic']} at {skip['t']:.1f} s: skip, excluding host delays", 1e3 * skip["length"], "ms")
    yield row("messages that the recorder lost", result["lost"], at_most=0)
    judged = [name for name in result["ticks"] if name.startswith("missed ticks")][-1:]
    for name, value in result["ticks"].items():
        figure, unit = split(name)
        yield row(figure, value, unit, at_most=0 if name in judged else None)
    yield row("guidance steps", guidance["steps"])
    yield row("guidance steps that replay differently", guidance["differing"], at_most=0)
    yield row("report: memory to write", report["memory"] / 1e6, "MB")
    yield row("report: time to write", report["written"], "s", at_most=10)
    yield row("report: size", report["size"] / 1e6, "MB")
    for figure in ("figures in view", "all figures"):
        yield row(f"report: {figure} drawn", (report["opened"] or {}).get(figure), "s", at_most=3)


def campaign(result: Any) -> Iterator[Row]:
    """Of benchmarks/campaign.py."""
    unit, loop = "aircraft-s/s", "loop in one process: speed"
    yield row(loop, result["plain"], unit)
    yield row("campaign with compilation: speed", result["whole"], unit, baseline=loop)
    yield row("campaign after the first chunks: speed", result["flown"], unit, at_least=150_000, baseline=loop)
    yield row("aircraft", result["aircraft"])
    yield row("memory after a third of the aircraft", result["memory_early"], "MB")
    yield row("memory at the end", result["memory"], "MB")
    yield row("memory at the end over that after a third", result["memory"] / result["memory_early"], at_most=1.1)
    yield row("aircraft whose integration is checked", result["exact"])
    for name, share in result["integration"].items():
        yield row(f"{name}: integration error, share of the rms error", 100.0 * share, "%", at_most=1)
    yield row("1,000,000 aircraft of 60 s with gusts on a GPU", None, "s", at_most=10)  # no host has had a GPU


def fleet(result: Any) -> Iterator[Row]:
    """Of `rise-di campaign --json`: figures in SI over all flights."""
    for case in result["cases"]:
        for name, of in case["figures"].items():
            for key, words in (("mean", "mean"), ("q50", "median"), ("q95", "95 %"), ("q99", "99 %"), ("worst", "worst")):
                yield row(f"{name}: {words}", of[key], "SI")
        yield row("flights", case["flights"])
        for key, words in (("diverged", "diverged"), ("lost", "loss of track, a score above 10")):
            of = case[key]
            yield row(f"{words}: flights", of["count"])
            for part, share in (("share", "share"), ("low", "share, lower 95 % limit"), ("high", "share, upper 95 % limit")):
                yield row(f"{words}: {share}", 100.0 * of[part], "%")


def cluster(result: Any) -> Iterator[Row]:
    """Of benchmarks/cluster.py."""
    yield row("aircraft", result["aircraft"])
    yield row("workers", result["workers"])
    yield row("faults", result["faults"])
    yield row("chunks", result["chunks"])
    yield row("chunks with other bytes than in one process", result["chunks"] - result["same"], at_most=0)


def compare(result: Any) -> Iterator[Row]:
    """Of `rise-di compare --json`: scores by law and wind, shares of lost aircraft, slew of the inputs, cost of the tuning."""
    for name in ("aircraft", "seed", "turbulence_seed", "wind"):
        yield row(name.replace("_", " "), result[name])
    for of in result["laws"]:
        law = f"{of['law']}, tuned on {of['tuned_on']}"
        for key in ("sees", "knows"):
            yield row(f"{law}: {key}", of[key])
        for wind, value in of["score"].items():
            yield row(f"{law}: score, {wind}", _score(value))
        for level in of["levels"]:
            spread = f"+-{100 * level['uncertainty']:g} %"
            for wind in of["score"]:
                for kind in ("mean", "worst"):
                    yield row(f"{law}: score, {wind}, {spread}, {kind}", _score(level[wind][kind]))
        first = of["levels"][0]
        for late in ({"delay": 0.0, "lost": first["gust"]["lost"]}, *of["late"]):
            about = f"+-{100 * first['uncertainty']:g} %, u late by {1e3 * late['delay']:g} ms"
            yield row(f"{law}: lost, {about}", 100.0 * late["lost"], "%")
        for name, value in of["slew"].items():
            yield row(f"{law}: mean slew of {name}", value, "SI")
        yield row(f"{law}: cost", of["cost"])
        yield row(f"{law}: cost of the worst seed of the tuning less the least", of["spread"])


def margins(result: Any) -> Iterator[Row]:
    """Of benchmarks/margins.py: by law and phase margin asked, the margin found, scores, and shares of lost aircraft."""
    for name in ("aircraft", "seed"):
        yield row(name, result[name])
    for of in result["rows"]:
        asked = "as it ships" if of["asked"] == "-" else f"{of['asked']} deg asked"
        law = f"{of['law']}, {asked}"
        yield row(f"{law}: phase margin", of["found"], "deg")
        for level, score in of["score"].items():
            spread = f"+-{100 * float(level):g} %"
            for kind in ("mean", "worst"):
                yield row(f"{law}: score, {spread}, {kind}", _score(score[kind]))
            yield row(f"{law}: lost, {spread}, u late by 20 ms", 100.0 * of["lost_late"][level], "%")


def effectors(result: Any) -> Iterator[Row]:
    """Of benchmarks/effectors.py: by scenario, effector, fault and law."""
    yield row("flights of a fault under a law", result["seeds"])
    yield row("largest u beyond its end stop", max(of["beyond"] for of in result["rows"]), "SI", at_most=0)
    for of in result["rows"]:
        fault = f" {of['fault']}" if of["fault"] else ""
        about = f"{of['scenario']}, {of['effector']}{fault}, {of['law']}"
        yield row(f"{about}: score, mean", of["mean"])
        yield row(f"{about}: score, worst", of["worst"])
        yield row(f"{about}: loss of track, a score above 10", of["lost"])
        yield row(f"{about}: an effector at its stop", 100.0 * of["held"], "% of the time")
        if of["lost"]:
            yield row(f"{about}: output that is lost", of["output"])


def _score(value: float | None) -> float | str:
    return "diverged" if value is None else value


def view(result: Any) -> Iterator[Row]:
    """Of benchmarks/view.py. Where the host has no browser, what a browser shows is not measured."""
    live, opened = result["live"], result["opened"]
    screen = result.get("live with a browser", {}).get("to the screen", {})
    frozen = result.get("frozen", {"frozen": 10.0, "recovered after": None})
    yield row(f"flight of {live['flight']:g} s: processor of the server", 100.0 * live["processor"], "% of a core", at_most=3)
    yield row(f"flight of {live['flight']:g} s: memory of the server", live["memory"], "MB", at_most=80)
    yield row(f"flight of {live['flight']:g} s: traffic to a page", live["traffic"] / 1e3, "kB/s")
    for key, limit in (("p50", 120), ("p99", 250)):
        yield row(f"to the screen: {key}", 1e3 * screen[key] if screen else None, "ms", at_most=limit)
    about = f"page frozen for {frozen['frozen']:g} s: less than 300 ms behind after"
    yield row(about, frozen["recovered after"], "s", at_most=1)
    log = f"log of {opened['flight'] / 3600:.2g} h"
    yield row(f"{log}: first samples after the start of rise-di watch", opened["first samples"], "s", at_most=3)
    yield row(f"{log}: read whole after the start of rise-di watch", opened["whole log"], "s", at_most=3)
    yield row(f"{log}: size", opened["log"], "MB")
    yield row(f"{log}: processor time of the server", opened["processor"], "s")
    yield row(f"{log}: memory of the server", opened["memory"], "MB")
    yield from _watched_flights(result["flights"])


def _watched_flights(flights: Mapping[str, Any]) -> Iterator[Row]:
    kinds = {"without": "without a client", "with": "with a client"}
    kinds |= {"start included": "with a client and the start of its server"}
    counted = [name for name in flights["with"] if name.startswith("missed ticks")]
    yield row("start of the server: shortest", min(flights["starting"]), "s")
    yield row("start of the server: longest", max(flights["starting"]), "s")
    for kind, words in kinds.items():
        for name, values in flights[kind].items():
            figure, unit = split(name)
            for number, value in enumerate(values, 1):
                yield row(f"flight {number}, {words}: {figure}", value, unit)
            if kind == "without":
                continue
            low, high = flights[f"interval {kind}"][name]
            limit = None if name in counted else 0.1
            yield row(f"{words}: {figure}, median of the differences", flights[f"more {kind}"][name], unit, at_most=limit)
            yield row(f"{words}: {figure}, median of the differences, lower 95 % limit", low, unit)
            yield row(f"{words}: {figure}, median of the differences, upper 95 % limit", high, unit)
            chance = 0.05 if name == counted[-1] else None
            about = f"{words}: {figure}, probability of as large a mean difference by chance"
            yield row(about, flights[f"probability {kind}"][name], at_least=chance)


def replay(result: Any) -> Iterator[Row]:
    """Of the replay of every scenario."""
    for name, of in result.items():
        yield row(f"{name}: flight", of["outcome"] if isinstance(of["outcome"], str) else " ".join(of["outcome"]))
        if "ticks" in of:
            yield row(f"{name}: ticks", of["ticks"])
            yield row(f"{name}: ticks checked", of["checked"])
        differing = "no flight" if "ticks" not in of else 0 if of["equal"] else of["differing"]
        yield row(f"{name}: ticks that replay differently", differing, at_most=0)

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The page docs/evidence.md from results of measurements (benchmarks/evidence.py). Pure: every figure comes from a result."""

import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

Result = dict[str, Any]
"""name, command, quick, date, revision, machine, busy (before it), seconds, status (exit), result (None where it failed)."""

WIDTH = 120  # characters of a line of words
HARD = "\u00a0"  # a space at which no line is broken
BUSY = 0.1  # share of the processors in use, just before a measurement, from which on the page says so


class Measurement(NamedTuple):
    """A program that measures, and what it leaves behind."""

    name: str
    command: tuple[str, ...]  # FILE stands for the file that it writes; without it, its output is the result
    quick: tuple[str, ...]
    what: str  # in a line
    takes: str  # about, on two cores
    timed: bool = False  # whether a busy machine spoils it


SPEED = {
    "law": ("one step of the law", 10.0),
    "node": ("the controller's tick beside the callback of an echo", 10.0),
    "latency": ("from y sent to u there, over DDS", 10.0),
    "ticks": ("how late ticks begin", 60.0),
    "flight": ("share of a core and memory of each process of a flight in real time", 10.0),
    "start": ("from the start of a process to its first u", 10.0),
    "lockstep": ("flights that wait for nobody", 30.0),
    "recorder": ("the log's writer, at 1 kHz on six topics", 30.0),
}


class Results(NamedTuple):
    """What there is to measure, and what was measured, by name."""

    measurements: Sequence[Measurement]
    found: Mapping[str, Result]


def render(measurements: Sequence[Measurement], found: Mapping[str, Result]) -> str:
    """The page from the results that were found, by name of the measurement."""
    results = Results(measurements, found)
    lines = [
        "# Evidence",
        "",
        "Written by `make evidence` from measurements; do not edit. Each table says which command makes it.",
        "",
        *_about(found),
    ]
    sections: dict[str, Callable[[Results], Iterator[str]]] = {
        "Faults": _faults,
        "Speed": _speeds,
        "Security": _security,
        "Campaign": _campaign,
        "Other laws": _compare,
        "Log": _log,
    }
    for title, section in sections.items():
        lines += ["", f"## {title}", "", *section(results)]
    text = "\n".join(wrapped for line in lines for wrapped in _wrapped(line.rstrip()))
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def _wrapped(line: str) -> list[str]:
    """A paragraph or an item of a list in lines of at most WIDTH, code in one piece; anything else as it is."""
    if line.startswith(("|", "#", "    ")) or not line:
        return [line]
    whole = re.sub("`[^`]*`", lambda code: code.group().replace(" ", HARD), line)
    wrapped = textwrap.wrap(
        whole, WIDTH, subsequent_indent="  " * line.startswith("- "), break_long_words=False, break_on_hyphens=False
    )
    return [part.replace(HARD, " ") for part in wrapped]


def _about(found: Mapping[str, Result]) -> Iterator[str]:
    if not found:
        yield "Nothing has been measured yet."
        return
    machines = sorted({_machine(result["machine"]) for result in found.values()})
    dates = sorted(result["date"] for result in found.values())
    revisions = ", ".join(sorted({f"`{result['revision']}`" for result in found.values() if result["revision"]}))
    yield f"Measured from {dates[0]} to {dates[-1]}, revision {revisions}, on:"
    yield ""
    yield from (f"- {one}" for one in machines)
    yield ""
    yield (
        "Figures that depend on the machine are ratios to a floor, the least that does the same on this machine in the same "
        "run; the figure itself stands beside in parentheses. Ratios travel to other machines, the figures do not."
    )
    yield ""
    yield (
        "What all of it leaves open: one host, the loopback interface, simulated aircraft; nothing is said of a network or a "
        "real-time kernel. A virtual machine also waits for its host, which no time here tells from the stack's own; "
        "missed ticks alone are told apart."
    )


def _machine(of: Mapping[str, Any]) -> str:
    return f"{of['processor']}, {of['cores']} cores, {of['memory']} GiB, {of['system']}, Python {of['python']}"


def _result(results: Results, name: str, lines: list[str]) -> Any:
    """What was measured, with the lines about the measurement; None with a line that says how to measure it."""
    one = next(one for one in results.measurements if one.name == name)
    anew = f'`make evidence ARGS="--again {name}"`'
    if name not in results.found:
        lines += ["", f"Not measured yet: {one.what}. {anew} measures it, in about {one.takes}."]
        return None
    result = results.found[name]
    lines += ["", f"    {result['command']}    # {result['date']}, {result['revision']}", ""]
    if result["quick"]:
        lines += ["**A short version**, not to be quoted; the whole one: " + anew + ".", ""]
    if one.timed and result["busy"] > BUSY:
        share = f"{100 * result['busy']:.0f} % of its processors in use"
        lines += [f"**The machine was busy** when this began, {share}: times are longer than on a free one.", ""]
    if result["result"] is None:
        lines += [f"**Failed**, with exit status {result['status']}; the command above says why."]
    elif result["status"]:
        lines += [f"**Exit status {result['status']}.**", ""]
    return result["result"]


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> list[str]:
    """A table of Markdown; the first columns hold words, the others figures."""
    sides = ["---" if column < texts else "---:" for column in range(len(headings))]
    return ["", *(f"| {' | '.join(cells)} |" for cells in (headings, sides, *rows)), ""]


def _number(value: float | None) -> str:
    """Three digits, or all of a larger number."""
    if value is None or math.isnan(value):
        return "-"
    if value == 0 or abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) >= 1e-3 else f"{value:.1e}"


# Faults


def _faults(results: Results) -> Iterator[str]:
    yield (
        "A flight of four processes over DDS, into which faults are put one after the other, seeded. *Reaction*: from the "
        "fault to the first that anybody notices it; *recovery*: from the fault's end, of a killed node from its being "
        "ready, to the law flying again; *traffic*: until all that a killed node says is there again, from its start and from "
        "its being ready. Most of these times are limits set on purpose (ages, leases), not the machine's. What each node does "
        "then, and says: [faults.md](faults.md)."
    )
    lines: list[str] = []
    found = _result(results, "faults", lines)
    yield from lines
    if found is None:
        return
    injected, passed = (sum(one[key] for one in found) for key in ("injected", "passed"))
    whole = sum(one["passed"] == one["injected"] for one in found)
    yield f"{whole} of {len(found)} cases passed every time; {passed} of {injected} faults ended as they should."
    rows = []
    for one in found:
        failed = "" if one["passed"] == one["injected"] else "**"
        detected = "-" if one["detected"] is None else str(one["detected"])
        shown = (
            _pair(one.get(key)) for key in ("reaction", "recovery", "exec_to_traffic", "ready_to_traffic", "longest_pause")
        )
        marked = one["case"] + ("" if one.get("quiet", 1) else " \\*")
        rows.append((marked, one["u"], str(one["injected"]), detected, f"{failed}{one['passed']}{failed}", *shown))
    times = ("reaction (ms)", "recovery (ms)", "traffic, of start (ms)", "of ready (ms)", "longest pause (ms)")
    yield from _table(("fault", "u meanwhile", "injected", "detected", "passed", *times), rows, texts=2)
    yield (
        "Times are median / worst. *Longest pause*: of a topic that is to go on. \\*: other work, or the fault itself, held "
        "processes back in every run, and the times are the machine's too."
    )
    for key, since in (("exec_to_traffic", "its start"), ("ready_to_traffic", "its being ready")):
        if back := [one[key]["worst"] for one in found if one.get(key)]:
            yield ""
            yield _goal(f"a killed node is back to full traffic within 0.5 s of {since}", max(back), 0.5, "s at worst")
    if caught_up := [one["ready_to_caught_up"] for one in found if one.get("ready_to_caught_up")]:
        took = " or ".join(_pair(one) for one in caught_up)
        yield f"- A recorder also has the samples of the last two seconds, which publishers keep, {took} ms after being ready."


def _pair(times: Mapping[str, float] | None) -> str:
    return "-" if times is None else f"{1e3 * times['median']:.0f} / {1e3 * times['worst']:.0f}"


def _goal(sentence: str, value: float, at_most: float, unit: str) -> str:
    verdict = "met" if value <= at_most else "**not met**"
    return f"- Goal: {sentence}. Found {_number(value)}{' ' + unit if unit else ''}: {verdict}."


# Speed

MEANING = {
    "law": "Pure functions, four channels. The floor is one multiply-add of four numbers in NumPy: what any NumPy costs. "
    "`guard.tick` is the whole tick of the controller; it takes the guarded step only where a limit is reached.",
    "node": "In one thread, beginning with a y that has arrived. The controller: y and y_m taken, the law stepped, u "
    "published; the whole tick also publishes `internals`, a second, longer message that an echo does not have. The echo: the "
    "executor's way to the callback, and y published again by it. `single` is what `rclpy.spin` uses.",
    "latency": "Round trip of a y to another process and back. The controller works at fixed ticks, so a y waits for the "
    "next one, anywhere between nothing and a period, as the phase of the two processes has it: the row with the wait. "
    "*Tick to u* is from the beginning of that tick to u there. *CPU each*: processor time of the whole process, its "
    "middleware, services and diagnostics too, for each u; the controller also takes a y_m and publishes `internals` each "
    "time. The stack's own data goes through none of these executors: a tick reads what has come; an executor serves "
    "parameters and services between ticks.",
    "ticks": "How long after its deadline a tick begins. One that is later than a period is *missed*. *By itself*: missed, "
    "less the time in which the machine ran nothing of ours, a virtual one while its host ran something else; a process on "
    "each core that goes before all others notices. The stack's loop sleeps until shortly before an absolute deadline on the "
    "monotonic clock and watches the clock for the rest, with no executor on the way; it is an empty node, with its services "
    "and its 1 Hz reports. *FIFO*: started by `chrt -f 50`, as in `chrt -f 50 rise-di fly osprey_gust`, which gives all its "
    "processes that priority. *Full load*: every core busy with something else.",
    "flight": "Real time, `osprey_gust`: aircraft and reference model at 500 Hz, controller at 100 Hz, recorder of all topics. "
    "Memory by itself is what the process does not share with others.",
    "start": "Wall time. A flight waits on purpose until its recorder and controller are ready, and then as long again for the "
    "others to find each other.",
    "lockstep": "Steps of the controller a second, aircraft and reference model at its 100 Hz, recorded; a step over topics is "
    "three hops on its way and nine messages. Higher is better.",
    "recorder": "Processor time a message: the recorder's from the topics to the disk, compressed; that of rosbags' writer "
    "from memory to the disk, uncompressed.",
}


def _speeds(results: Results) -> Iterator[str]:
    yield "In italics the floor that the ratios of a table are to."
    yield ""
    for group in SPEED:
        if group != "recorder":
            yield from _speed_group(results, group)


def _speed_group(results: Results, group: str) -> Iterator[str]:
    what, _ = SPEED[group]
    yield f"### {what[0].upper()}{what[1:]}"
    yield ""
    yield MEANING[group]
    lines: list[str] = []
    found = _result(results, f"speed-{group}", lines)
    yield from lines
    if found is None:
        yield ""
        return
    rows = found["rows"]
    by_name = {row["what"]: row["figures"] for row in rows}
    columns = list(dict.fromkeys(column for row in rows for column in row["figures"]))
    shown = []
    for row in rows:
        floor = by_name.get(row["floor"], {})
        name = f"*{row['what']}*" if row["what"] == row["floor"] else row["what"]
        shown.append((name, *(_beside(row["figures"].get(column), floor.get(column), column) for column in columns)))
    yield from _table(("", *columns), shown)
    for row in rows:
        for goal in row["goals"]:
            yield _speed_goal(row, goal, by_name)
    if group == "node":
        yield from _fastest_echo(by_name)
    yield ""


PLAIN = ("missed", "by itself", "lost", "ticks", "max (us)")  # counts, and single outliers, of which a ratio says nothing


def _beside(value: float | None, floor: float | None, column: str) -> str:
    """A figure as a ratio to its floor, the figure in parentheses; by itself without a floor and where it is PLAIN."""
    if value is None:
        return ""
    if math.isnan(value):
        return "-"
    if not floor or column in PLAIN:
        return _number(value)
    return f"{_number(value / floor)} ({_number(value)})"


def _speed_goal(row: Mapping[str, Any], goal: Mapping[str, Any], by_name: Mapping[str, Mapping[str, float]]) -> str:
    column, value = goal["column"], row["figures"][goal["column"]]
    name, unit = re.fullmatch(r"([^(]+?)(?: \((.*)\))?", column).groups()  # type: ignore[union-attr]
    limit = _number(goal["at_most"])
    if goal["of_floor"]:
        sentence = f"{row['what']}: {name} at most {limit} times that of {row['floor']}"
        return _goal(sentence, value / by_name[row["floor"]][column], goal["at_most"], "times")
    return _goal(f"{row['what']}: {name} at most {limit}{' ' + unit if unit else ''}", value, goal["at_most"], unit or "")


def _fastest_echo(by_name: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    column = "p50 (us)"
    echoes = {name: figures[column] for name, figures in by_name.items() if name.startswith("bare echo")}
    if not echoes:
        return
    fastest = min(echoes, key=lambda name: echoes[name])
    others = (
        f"{name} {_number(figures[column] / echoes[fastest])}"
        for name, figures in by_name.items()
        if name not in echoes and column in figures
    )
    yield f"- Beside the fastest echo ({fastest}), times in p50: {'; '.join(others)}."


# Security


def _security(results: Results) -> Iterator[str]:
    yield (
        "What is open and how to close it: [security.md](security.md). By default everything listens on the loopback interface "
        "alone; another process of the same host is let in unless samples are signed with a key (`key_file`). Hosts are "
        "network namespaces joined by a virtual cable; tests that need them are skipped without the right to make them."
    )
    for name in ("security", "fuzz"):
        lines: list[str] = []
        found = _result(results, name, lines)
        yield from lines
        if found is not None:
            yield from _cases(found)
    lines = []
    found = _result(results, "fuzz-coverage", lines)
    yield from lines
    if found is None:
        return
    rows = [
        (
            target,
            _number(one.get("number_of_executed_units")),
            _number(one["covered"]),
            _number(one.get("peak_rss_mb")),
            "nothing" if one["status"] == 0 else f"**an input, status {one['status']}**",
        )
        for target, one in found.items()
    ]
    yield from _table(("reads", "inputs tried", "branches seen", "memory (MB)", "found"), rows)
    yield (
        "An input counts as found where reading it raises anything but a refusal in a sentence, hangs, or takes too much "
        "memory (the limits stand in benchmarks/fuzz.py). What earlier runs found is kept in `tests/corpus/` and read again "
        "by the tests."
    )


def _cases(found: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    outcomes = [one["outcome"] for one in found]
    counts = ", ".join(f"{outcomes.count(kind)} {kind}" for kind in ("passed", "failed", "skipped") if kind in outcomes)
    yield f"{counts}."
    together: dict[str, list[str]] = {}
    for one in found:
        together.setdefault(one["name"].partition("[")[0], []).append(one["outcome"])
    rows = []
    for name, those in together.items():
        outcome = next((kind for kind in ("failed", "skipped") if kind in those), "passed")
        times = "" if len(those) == 1 else f" ({len(those)} cases)"
        rows.append(
            (name.removeprefix("test_").replace("_", " "), f"**{outcome}**" if outcome == "failed" else outcome + times)
        )
    yield from _table(("what is shown", "outcome"), rows, texts=2)


# Campaign


def _campaign(results: Results) -> Iterator[str]:
    yield "Thousands of aircraft, every entry of A and B off by up to 30 %, flown by the same functions under JAX, 64 bit."
    lines: list[str] = []
    found = _result(results, "campaign", lines)
    yield from lines
    if found is not None:
        plain = found["plain"]
        errors = ", ".join(f"{name} {100 * share:.2g} %" for name, share in found["integration"].items())
        rows = [
            ("loop in one process, one aircraft after the other", f"*1* ({_number(plain)})"),
            (f"campaign of {found['aircraft']:,} aircraft, compiling too", _beside(found["whole"], plain, "")),
            ("the same after the first chunks", _beside(found["flown"], plain, "")),
        ]
        yield from _table(("aircraft-seconds a second", "beside the loop"), rows)
        memory = f"{found['memory_early']:.0f} MB after a third of the aircraft, {found['memory']:.0f} MB at the end"
        yield f"Memory: {memory}. Error of the integration beside steps of 0.1 ms, as a share of the rms error: {errors}."
        yield ""
        grown = found["memory"] / found["memory_early"]
        yield _goal("memory flat in the number of aircraft, within a tenth", grown, 1.1, "times")
        yield _goal("integration error below 1 % of the tracking error", 100 * max(found["integration"].values()), 1.0, "%")
        fast = "met" if found["whole"] >= 100_000 else "**not met**"
        yield f"- Goal: 100,000 aircraft-seconds a second on two cores. Found {_number(found['whole'])}: {fast}."
    lines = []
    found = _result(results, "campaign-fleet", lines)
    yield from lines
    for case in found["cases"] if found is not None else ():
        keys = ("mean", "q50", "q95", "q99", "worst")
        rows = [(name, *(_number(of[key]) for key in keys)) for name, of in case["figures"].items()]
        yield from _table(("SI", "mean", "median", "95 %", "99 %", "worst"), rows)
        for word, meaning in (("diverged", ""), ("lost", " (score above 10)")):
            of = case[word]
            interval = f"{100 * of['low']:.2g} to {100 * of['high']:.2g} %"
            yield f"- {word}{meaning}: {of['count']:,} of {case['flights']:,}, {100 * of['share']:.3g} % (95 %: {interval})"


# Other laws


def _compare(results: Results) -> Iterator[str]:
    yield (
        "Same aircraft, reference, gusts, noise, limits and tuning procedure for each law. *Score*: sum of the rms true "
        "errors over 10 mrad/s, 0.1 m/s, 20 mrad/s (p); smaller is better, mean (worst) over the uncertain aircraft. "
        "*Lost*: score above 10. *Slew*: mean abs(u_dot) of each input on the nominal aircraft, SI. *Delay*: by how much u "
        "may be late before the score triples. Bold is the lowest among laws that see the same. Differences of a few percent "
        "are the tuning's noise. What the laws are, and what else they flew in: [experiments.md](experiments.md#other-laws)."
    )
    lines: list[str] = []
    found = _result(results, "compare", lines)
    yield from lines
    if found is None:
        return
    for aims in dict.fromkeys(law["tuned_on"] for law in found["laws"]):
        laws = [law for law in found["laws"] if law["tuned_on"] == aims]
        levels = [level["uncertainty"] for level in laws[0]["levels"]]
        best = {sees: _lowest([law for law in laws if law["sees"] == sees]) for sees in {law["sees"] for law in laws}}
        rows = []
        for law in laws:
            least = best[law["sees"]]
            scores = [_mark(law["score"], least[0])]
            for k, level in enumerate(law["levels"]):
                scores.append(f"{_mark(level['mean'], least[2 * k + 1])} ({_mark(level['worst'], least[2 * k + 2])})")
            lost = " / ".join(f"{100 * level['lost']:.3g}" for level in law["levels"])
            slew = " / ".join(f"{of:.2g}" for of in law["slew"].values())
            rows.append((law["law"], law["sees"], *scores, lost, slew, f"{1e3 * law['delay']:.0f}"))
        inputs = ", ".join(laws[0]["slew"])
        yield f"Gains tuned on: {aims}. Inputs: {inputs}. {found['aircraft']} aircraft a level, seed {found['seed']}."
        heads = (f"+-{100 * level:g} %" for level in levels)
        yield from _table(("law", "sees", "nominal", *heads, "lost (%)", "slew", "delay (ms)"), rows, texts=2)


def _scores(law: Mapping[str, Any]) -> list[float]:
    values = [law["score"], *(level[key] for level in law["levels"] for key in ("mean", "worst"))]
    return [float("inf") if value is None else value for value in values]


def _lowest(laws: Sequence[Mapping[str, Any]]) -> list[float]:
    return [min(column) for column in zip(*map(_scores, laws), strict=True)]


def _mark(value: float | None, least: float) -> str:
    if value is None:
        return "diverged"
    return f"**{value:.2f}**" if value <= least else f"{value:.2f}"


# Log


def _log(results: Results) -> Iterator[str]:
    lines: list[str] = []
    yield "Every scenario flown in lockstep over topics, recorded, and u recomputed from the log, tick by tick."
    found = _result(results, "replay", lines)
    yield from lines
    if found is not None:
        rows = []
        for name, one in found.items():
            if "ticks" not in one:
                rows.append((name, "**no flight**", "", ""))
                continue
            equal = "every bit" if one["equal"] else f"**{one['differing']} ticks differ**"
            rows.append((name, str(one["outcome"]), f"{one['checked']:,} of {one['ticks']:,}", equal))
        yield from _table(("scenario", "flight", "ticks checked", "equal"), rows, texts=4)
    yield ""
    yield from _speed_group(results, "recorder")

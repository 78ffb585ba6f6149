# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Prove the source of the exported controllers: `python -m tools.source_proof [SCENARIO ...]`.

Frama-C Eva follows all values of y and y_m within BOUND, with any loss of y, over some ticks. It
reports each access out of bounds, each read before a write, overflow, division by zero, and each
NaN or infinity that is not excluded. cppcheck names the rules of MISRA C:2012 that the source
breaks. Source: A. Blanchard, "Introduction to C program proof with Frama-C"; the manual of Eva.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from c_export.constants import exportable
from c_export.proof import write_code
from flight_analysis.closed_loop.scenario_library import find_scenario

REPOSITORY = Path(__file__).resolve().parents[1]
BOUND = 1000.0  # largest abs(y) and abs(y_m) that Eva follows, SI
EXPORTS: Mapping[str, int] = MappingProxyType(
    {
        "osprey_servo": 3,
        "osprey_observer": 2,
        "osprey_vtail": 2,
        str(REPOSITORY / "examples/px4_airplane/rates.yaml"): 2,
        str(REPOSITORY / "examples/px4_airplane/rates_observer.yaml"): 2,
    }
)
"""Scenarios, and how many ticks Eva follows. The law engages at the first tick, and steps from the
second one on."""

SELF_TEST = "is_rounded_once() && is_nan_told()"
"""The self-test, which is left out because it makes infinity and NaN on purpose."""

DEVIATIONS: Mapping[str, str] = MappingProxyType(
    {
        "2.3": "a type of the interface that a scenario does not need",
        "2.4": "a tag that a scenario does not need",
        "2.5": "constants of all exports stand in each",
        "5.9": "a helper of two files has the name of its purpose in both",
        "8.7": "functions of the interface that the other file does not call",
        "9.3": "{0} sets an array to zero",
        "10.8": "a sum of integers becomes a real",
        "11.3": "a struct of reals is checked as an array of reals",
        "11.4": "null pointers are written (type *)0",
        "11.5": "the table of parameters finds a member by its place",
        "12.1": "sizeof a / sizeof b",
        "12.3": "several members in one declaration",
        "18.4": "the table of parameters finds a member by its place",
        "19.2": "a union reads the bits of a number in the self-test",
        "20.9": "FLT_EVAL_METHOD is of <float.h>",
    }
)
"""Rules of MISRA C:2012 that the source breaks, and why."""

PROGRAM = """
#include "rise_di.h"
#include "__fc_builtin.h"
static const rise_di_parameters parameters = RISE_DI_PARAMETERS;
static rise_di_controller controller;
static rise_di_output output;
int main(void) {{
    rise_di_real y[RISE_DI_M], y_m[RISE_DI_M];
    int64_t now_ns = 0;
    (void)rise_di_start(&controller, &parameters);
    for (int k = 0; k < {ticks}; k++) {{
        now_ns += parameters.period_ns;
        for (int i = 0; i < RISE_DI_M; i++) {{
            y[i] = Frama_C_double_interval(-{bound}, {bound});
            y_m[i] = Frama_C_double_interval(-{bound}, {bound});
        }}
        (void)rise_di_take_y_m(&controller, now_ns, now_ns, y_m);
        if (Frama_C_interval(0, 1) != 0) {{
            (void)rise_di_take_y(&controller, now_ns, now_ns, y);
        }}
        (void)rise_di_tick(&controller, now_ns, true, &output);
    }}
    return 0;
}}
"""

OPTIONS = (
    "-eva", "-eva-precision", "3", "-eva-slevel", "400", "-eva-auto-loop-unroll", "400",
    "-warn-special-float", "non-finite", "-c11",
)  # fmt: skip

ALLOCATION = [
    "pass_on",
    "moved",
    "take_inside",
    "towards",
    "add_by_priority",
    "allocate",
    "is_inside",
]
"""Functions whose paths Eva joins, because it would have too many with one path for each effector
at each stop. To bound the effectors, Eva does not need separate paths."""

JOINED = (
    "-eva-slevel-function", ",".join(f"{name}:0" for name in ALLOCATION),
    "-eva-slevel-merge-after-loop", ",".join((*ALLOCATION, "step")),
)  # fmt: skip


class Result(NamedTuple):
    """What Eva says of an export."""

    functions: int  # number of functions that Eva analysed
    alarms: tuple[str, ...]


def exported(scenario: str, folder: Path) -> None:
    """Write the code of a scenario without its self-test."""
    scenario_flown = find_scenario(scenario)
    controller = exportable(scenario_flown.controller)
    write_code(
        controller, scenario_flown.name, folder, scenario_flown.reference_model, float32=False
    )
    path = folder / "rise_di.c"
    text = path.read_text(encoding="utf-8")
    if text.count(SELF_TEST) != 1:
        raise AssertionError("rise_di_start has no self-test of this name")
    path.write_text(text.replace(SELF_TEST, "true"), encoding="utf-8")


def eva(folder: Path, ticks: int) -> Result:
    """Run Frama-C Eva on exported code."""
    program = PROGRAM.format(ticks=ticks, bound=BOUND)
    (folder / "eva.c").write_text(program, encoding="utf-8")
    share = _output(["frama-c", "-print-share-path"], folder).strip()
    header = (folder / "rise_di_parameters.h").read_text(encoding="utf-8")
    options = OPTIONS if "#define RISE_DI_P 0 " in header else (*OPTIONS, *JOINED)
    evaluation = "-D__FLT_EVAL_METHOD__=0 -DFLT_EVAL_METHOD=0"
    sources = ["rise_di.c", "eva.c", f"{share}/libc/__fc_builtin.c"]
    text = _output(["frama-c", *options, f"-cpp-extra-args=-I. {evaluation}", *sources], folder)
    functions = re.search(r"(\d+) functions analyzed", text)
    count = re.search(r"(\d+) alarms? generated", text)
    if functions is None or count is None:
        raise SystemExit(f"frama-c: {text[-2000:]}")
    alarms = re.findall(r"\[eva:alarm\] (.*?) Warning: *\n *(.*)", text)
    alarms_found = tuple(f"{place} {what}" for place, what in alarms)
    if len(alarms_found) < int(count[1]):
        alarms_found = (*alarms_found, *["an alarm"] * (int(count[1]) - len(alarms_found)))
    return Result(int(functions[1]), alarms_found)


def broken_rules(folder: Path) -> set[str]:
    """Return the broken rules of MISRA C:2012, and the ids of the other findings of cppcheck."""
    command = ["cppcheck", "--enable=warning,performance,portability,style", "--std=c99"]
    command += ["--addon=misra", "--quiet", "--template={id}", "rise_di.c", "rise_di_table.c"]
    words = _output(command, folder).split()
    return {name.removeprefix("misra-c2012-") for name in words}


def _output(command: list[str], folder: Path) -> str:
    process = subprocess.run(  # noqa: S603 - a tool of the user
        command,
        cwd=folder,
        env=os.environ | {"PWD": str(folder)},  # Frama-C takes this for its folder
        capture_output=True,
        text=True,
        check=False,
    )
    return process.stdout + process.stderr


def main(scenarios: list[str]) -> int:
    """Print what both tools find in each scenario.

    Returns 1 if there is an alarm, or a broken rule that DEVIATIONS does not have.
    """
    tools = {name: shutil.which(name) is not None for name in ("frama-c", "cppcheck")}
    for name, package in (("frama-c", "frama-c-base of Debian"), ("cppcheck", "cppcheck")):
        if not tools[name]:
            print(f"skipped: {name} is not installed ({package})")
    status = 0
    for scenario in scenarios or EXPORTS:
        with tempfile.TemporaryDirectory(prefix="rise_di_proof_") as name:
            folder = Path(name)
            exported(scenario, folder)
            ticks = EXPORTS.get(scenario, 2)
            if tools["frama-c"]:
                result = eva(folder, ticks)
                print(
                    f"{Path(scenario).stem}: {result.functions} functions, {ticks} ticks, "
                    f"{len(result.alarms)} alarms",
                    *result.alarms,
                    sep="\n    ",
                    flush=True,
                )
                status |= bool(result.alarms)
            if tools["cppcheck"]:
                rules = broken_rules(folder)
                unknown = sorted(rules - set(DEVIATIONS))
                print(
                    f"{Path(scenario).stem}: {len(rules)} rules with a reason, without: {unknown}"
                )
                status |= bool(unknown)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

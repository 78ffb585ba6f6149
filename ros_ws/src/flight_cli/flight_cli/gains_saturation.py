# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Print and write what `rise-di gains guarantee --saturation INPUT` proves."""

import math
from collections.abc import Sequence
from pathlib import Path

from flight_analysis.linear_loop.certificate import limit_certificate
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_analysis.linear_loop.saturation import TRIED, LimitGuarantee
from flight_analysis.report.margin_figures import proved_percent
from flight_cli.output import write_text
from flight_core.parameters import require
from flight_design.gains.first_scenario import airframe_to_check, scenario_to_check
from rise_di.c_code import certificate_sources


def require_saturation(
    saturation: str | None,
    *,
    scenario: str,
    late: float,
    entries: Sequence[str],
    worst: Path | None,
) -> None:
    """Check that the input of --saturation exists, and that the other options fit it.

    Raises ParameterError if not.
    """
    if saturation is None:
        return
    inputs = scenario_to_check(scenario).controller.inputs
    require(saturation in inputs, "saturation", saturation, f"an input: {', '.join(inputs)}")
    require(late == 0.0, "saturation", f"--late {late:g} beside it", "u in time")
    lags = [text for text in entries if text.startswith("1/")]
    require(not lags, "saturation", f"{', '.join(lags)} beside it", "exact lags")
    require(worst is None, "saturation", "--worst beside it", "one of the two")


def write_limit_certificate(
    path: Path | None,
    loop: LinearLoop,
    guarantee: LimitGuarantee | None,
    airframe: str,
    scenario: str,
) -> list[str]:
    """Write the certificate for a loop in which one input saturates, if a path is given.

    Returns a sentence if the law has no C code, because a checker computes the loop from the
    constants in that code.
    """
    if path is None:
        return []
    require(guarantee is not None, "--certificate", "no guarantee for any box", "one")
    assert guarantee is not None  # noqa: S101 - for mypy
    frame = airframe_to_check(airframe, scenario_to_check(scenario))
    sources = certificate_sources(frame, scenario)
    write_text("certificate", path, limit_certificate(loop, guarantee, sources.texts))
    return sources.notes()


def limit_text(name: str, guarantee: LimitGuarantee | None, certificate: str) -> list[str]:
    """Write in sentences what is guaranteed for a loop in which one input saturates."""
    if guarantee is None:
        least = f"{100.0 * TRIED[-1]:g} % of this box"
        return [f"guarantee: none with any limits of {name}: no taps prove as much as {least}"]
    within = f"for every aircraft within {proved_percent(guarantee.size)}"
    if guarantee.zeros:
        within += f", entries that are 0 within {proved_percent(guarantee.zeros)} of their rows"
    limits = f"with any limits of {name}"
    sampled = (
        "found at samples of the frequency: examples/check_certificate.py proves the certificate"
    )
    if guarantee.is_settling:
        settles = f"the loop settles {within}, {limits} around where it settles"
        return [f"guarantee: {settles} (certificate {certificate})", sampled]
    period = 2.0 * math.pi / guarantee.multiplier.slowest
    periodic = f"no motion is periodic up to {period:.0f} s {within}, {limits}"
    return [
        f"guarantee: {periodic} (certificate {certificate})",
        "that the loop settles is not proved for this box: a smaller --uncertainty tries less",
        sampled,
    ]

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Explain the words that tables and cards use.

In a terminal, the meanings are printed below a table. On a page, the heading of a column shows its
meaning, and all meanings are listed at the end.
"""

import math
from collections.abc import Iterable
from types import MappingProxyType

from flight_analysis.metrics.settling import MIN_BAND_NOISE_FLOORS, SETTLING_BAND
from flight_analysis.metrics.transients import (
    CAPTURE_ANGLE,
    CAPTURE_TIME,
    SETTLING_DWELL,
    TURN_BANK,
    Air,
)
from flight_analysis.report.display_units import QUANTITY_UNITS
from flight_analysis.report.guided import BANDS
from rise_di_controller.learning.divergence import WINDOW

_AFTER = f"until {SETTLING_DWELL:g} s after its end"
_REST = (
    f"all other times, without the first {SETTLING_DWELL:g} s after the law engaged"
    " and, in a guided flight, without gusts"
)
_HELD = ", ".join(
    f"{band * QUANTITY_UNITS[name].factor:g} {QUANTITY_UNITS[name].unit} of {name}"
    for name, band in BANDS.items()
)

GLOSSARY = MappingProxyType(
    {
        # Errors
        "worst": f"the {WINDOW:g} s in which the error comes nearest to what is allowed, or "
        "exceeds it most",
        "allowed": "twice the error that the linear loop makes of the same commands, noise and "
        "wind, plus a floor",
        "true error": "y - y_m without the noise of the sensors, which only a simulation knows",
        "measured error": "y - y_m as the sensors have it, with their noise",
        "rms": "the root of the mean square",
        "max": "the largest absolute value",
        "whole": "over the whole flight",
        **{air: _REST + ("; the wind is not known" if air is Air.UNKNOWN else "") for air in Air},
        "command": f"from an edge of a command {_AFTER}",
        "gust": f"from the entry into a gust {_AFTER}",
        "turn": f"while a bank above {math.degrees(TURN_BANK):.0f} deg is commanded, and {_AFTER}",
        "capture": "outside of turns: while a path steeper than "
        f"{math.degrees(CAPTURE_ANGLE):.0f} deg or a change of V is commanded, or the aircraft "
        f"is farther from its path than it flies in {CAPTURE_TIME:g} s, and {_AFTER}",
        "ultimate bound": f"the largest error in {Air.CALM} air, once the law has settled",
        "noise floor": "the rms that noise and rounding leave in y: a smaller measured error "
        "cannot be distinguished from them",
        "switches (1/s)": "how often the sign term of the law changes its direction",
        "settling (s)": f"the time until the error stays for {SETTLING_DWELL:g} s within "
        f"{SETTLING_BAND:.0%} of the largest y_m, or within {MIN_BAND_NOISE_FLOORS:g} noise "
        "floors if it is measured; the slowest of the flight. If the error had not settled "
        "when the next command or gust came, > stands before the longest time. In a segment of "
        f"guidance the error has to stay within {_HELD}",
        # Inputs
        "trim": "the constant input or output of the undisturbed flight; the median, if the log "
        "does not say it",
        "rate": "the mean absolute value of the derivative, in the unit of the row per second",
        "saturated %": "the part of the ticks in which the law asked for more than the largest "
        "deflection / than the largest rate",
        # Guidance
        "segment": "a part of the flight with the same modes, commands and leg of the route",
        "overshoot": "the largest error beyond the command, if the segment begins outside of "
        "the settling band",
        # Models
        "initial law": "the law with the model of the file, before the first learned model",
        # Time
        "jitter": "how far the time between two ticks is from a whole number of periods",
        "age of y": "how old the newest y is when the controller uses it",
        "age of u": "how old a u is when the actuators get it",
        # Margins
        "phase": "how much more phase lag at one input the loop withstands, and the frequency at "
        "which it would then oscillate; the other inputs closed",
        "gain": "the factor by which the effect of one input may change, the other inputs closed",
        "largest S": "the largest factor by which the loop amplifies a disturbance at this "
        "input; it is 1 without a loop, and 2 at the circle of the Nyquist plot",
        "disk": "the size of the disk of gains and phases around 1 that the loop withstands at "
        "this input; from 0, none, to 2",
        "delay": "how much later u may come before the loop is unstable",
        "all inputs": "a disk of its own in each input at the same time; phase and gain are the "
        "margins that it guarantees, and the delay is the margin of all inputs together",
        "damping": "the damping ratio of the slow modes of the loop",
        "linear loop": "the law and the aircraft of the file for small deviations, sampled, "
        "with actuators, delay and hold",
    }
)


def words_in(texts: Iterable[str]) -> tuple[str, ...]:
    """Return which of the texts are words that the glossary explains, without repetition."""
    return tuple(dict.fromkeys(text for text in texts if text in GLOSSARY))


def legend(words: Iterable[str]) -> str:
    """Return the meanings of words as text for a terminal: "word: meaning. word: meaning"."""
    return ". ".join(f"{word}: {GLOSSARY[word]}" for word in words)

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Say which required margins a loop lacks, and which change of the loop would help."""

import math
from collections.abc import Sequence

import numpy as np

from flight_core.outcome import Refusal
from flight_design.gains.gain_conditions import GainCondition
from flight_design.gains.gain_selection import LoopSetting, Selection, gain_sets
from flight_design.gains.requirement import ACCEPTED_PHASE_MARGIN, PHASE_MARGINS


def binding(selection: Selection) -> GainCondition:
    """Return the condition that limits the engineering gains most.

    Among the unmet conditions, this is the condition that the gains miss by the largest factor.
    """
    return min(selection.engineering.unmet, key=lambda condition: condition.margin)


def reason_against_gains(selection: Selection, *, options: Sequence[str] = ()) -> Refusal | None:
    """Say why the best gains of the search do not meet the requirement, or return None if they do.

    The sentences name the condition that limits the gains most, every other unmet condition, and
    every change of the loop that reaches the margins. Such a change is a lower required margin,
    half of the lags, no delay, or twice the rate. For each change, gains are searched again.
    `options` says which of phase_margin, lag, delay and rate are options of the calling command. If
    the command has an option for a change, the sentence names the change by this option.
    """
    assessed = selection.engineering
    if not assessed.unmet:
        return None
    outputs = assessed.controller.outputs
    rows = "; ".join(condition.sentence(outputs) for condition in assessed.unmet)
    relaxed = [
        text
        for text, setting in _relaxed(selection, options).items()
        if not gain_sets(selection.study, setting).engineering.unmet
    ]
    mend = f"met with {' or with '.join(relaxed)}" if relaxed else "met with no single change"
    limit = binding(selection)
    where = "the loop" if limit.channel is None else outputs[limit.channel]
    return Refusal(f"{rows}: the best of the search, bound by {limit.name} of {where}; {mend}")


def _relaxed(selection: Selection, options: Sequence[str]) -> dict[str, LoopSetting]:
    """Return the setting of the loop for each change that `reason_against_gains` tries.

    The keys are texts that describe the change.
    """
    setting = selection.setting
    changes: dict[str, LoopSetting] = {}
    margins = selection.engineering.margins
    if margins is not None:
        least = min(float(margins.nominal.phase.min()), setting.requirement.phase)
        phase = math.floor(np.degrees(least) + 1e-6)
        if PHASE_MARGINS[0] <= phase < np.degrees(setting.requirement.phase) - 1e-6:
            accept = " --accept" if phase < ACCEPTED_PHASE_MARGIN else ""
            requirement = setting.requirement._replace(phase=math.radians(phase))
            changes[f"--phase-margin {phase}{accept}"] = setting._replace(requirement=requirement)
    halved = {name: lag / 2.0 for name, lag in setting.lag.items()}
    lags = ",".join(f"{halved.get(name, 0.0):.4g}" for name in selection.study.airframe.inputs)
    words = {
        "lag": (f"--lag {lags}", "actuators of half the lag"),
        "delay": ("--delay 0", "no delay"),
        "rate": (f"--rate {2.0 * setting.rate:g}", f"a law at {2.0 * setting.rate:g} Hz"),
    }
    settings = {
        "lag": setting._replace(lag=halved),
        "delay": setting._replace(delay=0.0),
        "rate": setting._replace(rate=2.0 * setting.rate),
    }
    changes |= {words[key][key not in options]: row for key, row in settings.items()}
    return changes

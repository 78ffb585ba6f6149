# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the commands of a first flight, which follow one rule, and the text of the scenario."""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx
from tests.conftest import REPOSITORY, refusing

from flight_analysis.closed_loop.scenario import parse_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.parameters import ParameterError
from flight_core.units import GRAVITY
from flight_design.gains.first_scenario import (
    GAINS,
    Channel,
    first_commands,
    scenario_text,
    scenario_to_design,
)
from flight_design.gains.gain_design import select_gains
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference

CHANNELS = {
    "q": Channel(motion="q", authority=5.0, bandwidth=12.0),
    "V": Channel(motion="V", authority=1.0, bandwidth=0.6),
    "p": Channel(motion="p", authority=5.0, bandwidth=12.0),
    "r": Channel(motion="r", authority=1.0, bandwidth=8.0),
}


@given(
    authority=st.floats(0.05, 10.0),
    bandwidth=st.floats(0.1, 20.0),
    damping=st.floats(0.0, 0.5),
    speed=st.floats(10.0, 250.0),
)
def test_command_needs_at_most_a_third_of_the_authority(
    authority: float, bandwidth: float, damping: float, speed: float
) -> None:
    # What the input gives along y_m is y_m_dot + damping y_m. The edge of 0.2 s only rounds it off.
    channel = Channel(motion="V", authority=authority, bandwidth=bandwidth, damping=damping)
    commands = first_commands({"V": channel}, speed, 100.0, banks=False)
    y_m = Reference(ReferenceModelConfig.validate_mapping(commands.reference, "reference_model"))
    samples = np.array([y_m.sample(k)[0] for k in range(round(20.0 * 100.0))])
    demand = np.gradient(samples, 0.01) + damping * samples
    assert demand.max() <= authority / 3.0 * 1.01
    assert samples.max() <= min(2.0, 0.03 * speed) * 1.006  # a height has three digits


def test_reference_is_slower_than_half_of_the_loop() -> None:
    reference = first_commands(CHANNELS, 50.0, 200.0, banks=True).reference
    # 4 and 5 rad/s at most of q and p; half of 0.6 and of 8 rad/s
    assert reference["second_order"]["natural_frequency"] == approx([4.0, 0.3, 5.0, 4.0])


@pytest.mark.parametrize("speed, largest", [(50.0, 0.05), (250.0, GRAVITY / 250.0)])
def test_pitch_rate_asks_for_one_g_at_most(speed: float, largest: float) -> None:
    pulses = first_commands(CHANNELS, speed, 200.0, banks=True).reference["pulses"]
    assert max(pulses["q"]["value"]) == approx(largest, rel=0.01)


def test_each_channel_is_commanded_by_itself_and_comes_back() -> None:
    commands = first_commands(CHANNELS, 50.0, 200.0, banks=True, wait=30.0)
    pulses = commands.reference["pulses"]
    # bank commands r, by the turn
    assert [*pulses] == ["q", "p", "V"]
    ends = [(min(pulse["start"]), max(pulse["stop"])) for pulse in pulses.values()]
    assert all(before[1] <= after[0] for before, after in itertools.pairwise(ends))
    assert ends[0][0] == 32.0
    for name in ("q", "p"):
        pulse = pulses[name]
        spans = np.subtract(pulse["stop"], pulse["start"]) * pulse["value"]
        angles = np.cumsum(spans)
        assert angles[-1] == approx(0.0)  # the attitude
        assert np.sum(angles) == approx(0.0, abs=1e-12)  # and the path, pair by pair
    assert commands.duration >= ends[-1][1] + 10.0
    assert commands.reference["coordinated_turn"]["speed"] == 50.0


def test_in_hover_every_rate_is_commanded_alone() -> None:
    channels = {
        **{name: CHANNELS[name] for name in ("q", "p", "r")},
        "climb": Channel(motion="climb", authority=2.0, bandwidth=2.0),
    }
    reference = first_commands(channels, None, 100.0, banks=True).reference
    assert [*reference["pulses"]] == ["q", "p", "r", "climb"]
    assert "coordinated_turn" not in reference
    # 0.15 rad/s, but r: a third of 1 rad/s^2 / (4 rad/s / e) = 0.2265 is enough too
    assert [max(pulse["value"]) for pulse in reference["pulses"].values()] == approx(
        [0.15, 0.15, 0.15, 1.0]
    )


def test_command_is_seen_beside_the_noise() -> None:
    weak = Channel(motion="V", authority=0.01, bandwidth=1.0, noise=0.05)
    assert weak.size(50.0) == approx(5.0 * 0.05)
    assert weak._replace(noise=0.0).size(50.0) == approx(0.01 / 3.0 * math.e / 0.5)


def test_text_reads_back_with_units_beside_the_keys() -> None:
    commands = first_commands(CHANNELS, 25.0, 200.0, banks=True)
    text = scenario_text(
        ["first", "", "second"],
        {
            "flight": {"duration": commands.duration},
            "aircraft": {"airframe": "osprey", "rate": 200.0, "gusts": {}, "commands": None},
            "reference_model": commands.reference,
            "controller": "/**/controller:\n  ros__parameters:\n    rate: 0.0\n",
        },
    )
    assert text.startswith("# SPDX-FileCopyrightText")
    assert "#\n# first\n# second\n" in text
    assert "gusts" not in text
    assert f"duration: {commands.duration}  # s\n" in text
    # every section is there: the first complaint is about a value of the aircraft
    with pytest.raises(ParameterError, match=r"^aircraft\.step: missing"):
        parse_scenario(text.encode(), Path("first.yaml"))


def test_scenario_without_gains_has_those_of_the_scenario_with_gains(tmp_path: Path) -> None:
    """The selection does not depend on the gains in the section."""
    example = REPOSITORY / "examples" / "arduplane" / "rates.yaml"
    text = example.read_text("utf-8").replace("examples/arduplane", str(example.parent))
    keys = "|".join([*GAINS, "sign", "softening"])
    bare = re.sub(rf"^    (?:{keys}):.*\n", "", text, flags=re.MULTILINE)
    bare = re.sub(r"    feedforward:.*?(?=/\*\*/recorder)", "", bare, flags=re.DOTALL)
    assert len(bare) < len(text)
    path = tmp_path / "bare.yaml"
    path.write_text(bare, "utf-8")
    with refusing(r"^controller: missing D, input_scale, k_g, k_d, Lambda, beta, expected"):
        find_scenario(str(path))
    airframe = str(example.parent / "rates_airframe.yaml")
    selections = [select_gains(airframe, name, samples=1) for name in (str(path), str(example))]
    bare_gains, gains = (selection.chosen for selection in selections)
    assert bare_gains == gains
    partial = tmp_path / "partial.yaml"
    partial.write_text(re.sub(r"^    beta:.*\n", "", text, flags=re.MULTILINE), "utf-8")
    with refusing(r"^controller\.beta: missing"):  # a forgotten gain is no choice
        scenario_to_design(str(partial))

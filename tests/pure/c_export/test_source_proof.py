# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the proof of the source: Frama-C finds no alarm in an export, and finds one put in."""

import shutil
from pathlib import Path

import pytest
from tools.source_proof import eva, exported

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("frama-c") is None, reason="no frama-c on this machine: frama-c-base of Debian"
    ),
]


def test_frama_c_finds_no_alarm_but_the_one_that_is_put_in(tmp_path: Path) -> None:
    """A division by the time of a sample, which may be 0, is an alarm."""
    exported("osprey_servo", tmp_path)
    result = eva(tmp_path, 2)
    assert result.alarms == ()
    assert result.functions > 30
    path = tmp_path / "rise_di.c"
    text = path.read_text("utf-8")
    mutant = text.replace("(span_ns > 0U) ? span_ns : 1U", "span_ns")
    assert mutant != text
    path.write_text(mutant, "utf-8")
    alarms = eva(tmp_path, 2).alarms
    assert any("rise_di.c" in alarm for alarm in alarms)

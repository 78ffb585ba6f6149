# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the certificate of a guarantee with the checker, which imports nothing of this stack."""

import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from pytest import approx
from tests.conftest import REPOSITORY, invoke, refusing

import rise_di
from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.certificate import certificate, keep
from flight_analysis.linear_loop.guarantee import Guarantee, loop_guarantee
from flight_analysis.linear_loop.loop_margins import LinearLoop, scenario_loop
from flight_analysis.linear_loop.uncertain_loop import plants_at
from rise_di_controller.law.linear_loop import closed_loop

pytestmark = pytest.mark.slow

CHECKER = REPOSITORY / "examples" / "check_certificate.py"
Content = dict[str, Any]


@cache
def _checker() -> Any:
    spec = spec_from_file_location("check_certificate", CHECKER)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


BEYOND = 0.99
"""Deviation beyond which no aircraft is proved stable: such a box has no disks to prove.

A certificate does not have them.
"""


def loop_of(name: str) -> LinearLoop:
    scenario = find_scenario(name)
    return scenario_loop(scenario, scenario.controller, 1, BEYOND)


@cache
def guarantee_of(name: str) -> Guarantee:
    return loop_guarantee(loop_of(name))


@pytest.fixture(scope="module")
def servo() -> Content:
    linear = loop_of("osprey_servo")
    content: Content = json.loads(certificate(linear, guarantee_of("osprey_servo"), {}))
    return content


def signed(content: Content) -> Content:
    """Return the content with the name and the digest of its numbers."""
    rest = {key: value for key, value in content.items() if key != "digest"}
    rest["loop"] = _checker().digest_of(rest)
    text = json.dumps(rest, sort_keys=True)
    return rest | {"digest": hashlib.sha256(text.encode()).hexdigest()}


def run(content: Content, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the checker in this process."""
    path = folder / "certificate.json"
    path.write_text(json.dumps(content))
    command = [str(CHECKER), str(path), *words]
    out, error = StringIO(), StringIO()
    with patch.object(sys, "argv", command), redirect_stdout(out), redirect_stderr(error):
        status = _checker().main()
    return subprocess.CompletedProcess(command, status, out.getvalue(), error.getvalue())


@pytest.mark.parametrize("name", ["osprey_servo", "jsbsim_c172p"])
def test_checker_proves_a_guarantee(name: str, tmp_path: Path) -> None:
    """The checker proves the size of the guarantee.

    For c172p an interval had been proved across a crossing that the pencil did not show because of
    an integrator. The checker refused it.
    """
    linear = loop_of(name)
    guarantee = guarantee_of(name)
    done = run(json.loads(certificate(linear, guarantee, {})), tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("PROVED")
    within = np.floor(1e3 * guarantee.stable) / 10.0
    assert linear.box is not None
    assert f"{linear.box.names[-1]} (B " in done.stdout
    assert f") {within:g} %" in done.stdout


def test_motion_of_the_checker_is_the_exact_loop(servo: Content, tmp_path: Path) -> None:
    """The motion of the checker is the exact closed loop within 1e-8, with four coefficients of w.

    This is checked at the corners of the guarantee.
    """
    module = _checker()
    linear = loop_of("osprey_servo")
    assert linear.box is not None
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(servo))
    loop = module.loop_of(module.read(path))
    k = len(linear.box.names)
    q, p = loop.states, module.TERMS * k
    d = servo["size"] * np.sign(np.random.default_rng(5).standard_normal(k))
    closed = module.closed(loop.big[: q + p, : q + p], slice(q, q + p), np.tile(d, module.TERMS))
    aircraft = plants_at(linear.nominal, linear.box, d)
    exact = closed_loop(aircraft, linear.law, linear.loop, np.zeros(4))
    assert closed[:q, :q] == approx(exact, abs=1e-8)
    # the proof's own two coefficients are 100 times worse: what they leave out, the checker bounds
    two = np.r_[0:q, q : q + 2 * k]
    fewer = module.closed(loop.big[np.ix_(two, two)], slice(q, q + 2 * k), np.tile(d, 2))
    assert np.abs(fewer[:q, :q] - exact).max() > 100.0 * np.abs(closed[:q, :q] - exact).max()


def _numbers(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the places of all real numbers of a JSON value that are not 0."""
    if isinstance(value, dict):
        return [place for key, inner in value.items() for place in _numbers(inner, (*path, key))]
    if isinstance(value, list):
        return [place for i, inner in enumerate(value) for place in _numbers(inner, (*path, i))]
    return [path] if isinstance(value, float) and value else []


def test_certificate_with_an_altered_number_is_refused(
    servo: Content,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Thirty real numbers are altered in the last digit, one at a time, and the digest changes."""
    module = _checker()
    places = _numbers(servo)
    path = tmp_path / "certificate.json"
    for place in np.random.default_rng(2).choice(len(places), 30, replace=False).tolist():
        altered = json.loads(json.dumps(servo))
        inner = altered
        for key in places[place][:-1]:
            inner = inner[key]
        value = inner[places[place][-1]]
        inner[places[place][-1]] = np.nextafter(value, 0.0)
        path.write_text(json.dumps(altered))
        monkeypatch.setattr(sys, "argv", [str(CHECKER), str(path)])
        assert module.main() == 1
        assert "digest" in capsys.readouterr().err


def _states_exchanged(servo: Content) -> Content:
    """Exchange the names q and alpha everywhere.

    The same numbers then describe other entries.
    """
    other = {"q": "alpha", "alpha": "q"}
    states = [other.get(name, name) for name in servo["states"]]
    place = re.compile(r"(?<=[\[,])(q|alpha)(?=[\],])")
    names = [place.sub(lambda found: other[found[0]], name) for name in servo["names"]]
    return servo | {"states": states, "names": names}


@pytest.mark.parametrize(
    "alter",
    [lambda servo: servo | {"delay": servo["delay"] - 0.001}, _states_exchanged],
    ids=["delay", "names"],
)
def test_certificate_with_the_name_of_another_loop_is_refused(
    alter: Callable[[Content], Content], servo: Content, tmp_path: Path
) -> None:
    """The name that a report or a replay shows belongs to these names and numbers."""
    assert servo["loop"] == loop_of("osprey_servo").digest
    named = signed(alter(servo))
    assert named["loop"] != servo["loop"]
    text = json.dumps(
        {key: named[key] for key in named if key != "digest"} | {"loop": servo["loop"]},
        sort_keys=True,
    )
    other = json.loads(text) | {"digest": hashlib.sha256(text.encode()).hexdigest()}
    refused = run(other, tmp_path)
    assert refused.returncode == 1
    assert "the loop is not the one that its name says" in refused.stderr


@pytest.mark.usefixtures("coarse")
def test_command_writes_a_certificate_and_refuses_what_it_cannot_state(tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    words = ["gains", "guarantee", "osprey", "--samples", "1", "--certificate", str(path)]
    late = invoke(*words, "--late", "0.01")
    assert late.exit_code == 0, late.output
    assert json.loads(path.read_text())["late"]["time"] == 0.01
    path.unlink()
    for place in (tmp_path, tmp_path / "none" / "certificate.json"):
        refused = invoke(*words[:-1], str(place))
        sentence = f"certificate: found {place}, expected a file in a folder that can be written"
        assert sentence in str(refused.exception)
    done = invoke(*words)
    assert done.exit_code == 0, done.output
    assert "certificate.json" in done.output
    content = json.loads(path.read_text())
    assert content == signed(content)
    assert {"scenario", "airframe", "constants"} <= set(content)
    name = f"(certificate {content['loop'][:12]})"
    assert name in " ".join(done.output.split())
    flight = rise_di.fly(
        rise_di.find_scenario("osprey_servo", duration=0.5), runs=tmp_path / "runs"
    )
    report = flight.report.read_text()
    assert name in report
    assert re.search(r"proved stable while each is within \d+\.\d % of its row", report)
    assert name in invoke("replay", str(flight.mcap)).output
    # u with other gains is another loop
    assert "certificate" not in invoke("replay", str(flight.mcap), "--set", "k_s=1").output


ONE_CHANNEL = """\
name: one
source: an unstable short period
speed: 60.0
states: {alpha: rad, q: rad/s}
inputs:
  elevator: {unit: deg, positive: nose up}
outputs: [q]
A: [[-0.9, 0.97], [2.6, -1.4]]
B: [[0.0005], [0.06]]
gusts:
  vertical: {alpha: 0.9, q: -2.6}
"""


@pytest.mark.usefixtures("coarse")
def test_section_that_gains_wrote_has_margins_and_a_certificate(tmp_path: Path) -> None:
    """The conditions agree with the selection, to the six digits that the section has."""
    frame, section = tmp_path / "one.yaml", tmp_path / "gains.yaml"
    path = tmp_path / "certificate.json"
    frame.write_text(ONE_CHANNEL)
    written = invoke("gains", "select", str(frame), "--samples", "4", "--write", str(section))
    assert written.exit_code == 0, written.output
    selected = rise_di.select_gains(frame, samples=4).engineering
    again = rise_di.check_gains(frame, section, samples=4)
    for part in ("theorem", "rules", "loop"):
        found = [condition.value for condition in getattr(again, part)]
        assert found == approx([condition.value for condition in getattr(selected, part)], rel=1e-4)
    words = ["gains", "guarantee", str(frame), "--scenario", str(section), "--samples", "4"]
    refused = invoke(*words, "--worst", str(tmp_path / "worst"))
    assert "worst: found no aircraft in" in str(refused.exception)
    done = invoke(*words, "--certificate", str(path))
    assert done.exit_code == 0, done.output
    assert "has a controller alone: commands and gusts of osprey_servo" in done.stderr
    content = json.loads(path.read_text())
    assert run(content, tmp_path).stdout.startswith("PROVED")
    # there is no scenario yet, nor the constants of an export
    assert not {"scenario", "constants"} & content.keys()
    text = as_yaml(load_airframe(frame))
    assert content["airframe"] == hashlib.sha256(text.encode()).hexdigest()


def test_file_with_some_sections_is_no_section_alone(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    sections = {"/**/controller": {"rate": 100.0}, "/**/flight": {"duration": 1.0}}
    tree = {name: {"ros__parameters": values} for name, values in sections.items()}
    path.write_text(json.dumps(tree))
    with refusing("scenario.yaml: aircraft: found no such section"):
        rise_di.check_gains("osprey", path)


def test_export_puts_the_certificate_beside_the_code_of_its_constants(tmp_path: Path) -> None:
    """Without a computed guarantee there is no certificate.

    The checker refuses the certificate together with other constants.
    """
    code = tmp_path / "c"
    exported = rise_di.export("osprey_servo", code, proof=False)
    assert not any(path.name == "certificate.json" for path in exported.files)
    keep(guarantee_of("osprey_servo"))
    exported = rise_di.export("osprey_servo", code, proof=False)
    assert code / "certificate.json" in exported.files
    content = json.loads((code / "certificate.json").read_text())
    header = code / "rise_di_parameters.h"
    assert run(content, tmp_path, str(header)).returncode == 0
    header.write_text(header.read_text().replace("RISE_DI_M 4", "RISE_DI_M 5"))
    assert "holds other constants" in run(content, tmp_path, str(header)).stderr


@pytest.mark.usefixtures("coarse")
def test_command_certifies_an_aircraft_of_jsbsim_or_refuses_before_the_work(
    tmp_path: Path,
) -> None:
    """The loop of y_dot = Omega u has four entries of B and the name of the scenario's loop."""
    path = tmp_path / "certificate.json"
    words = ["gains", "guarantee", "jsbsim:c172p", "--scenario", "jsbsim_c172p", "--samples", "1"]
    refused = invoke(*words, "--worst", str(tmp_path / "worst"))
    assert "worst: found jsbsim:c172p, expected an aircraft of an airframe" in str(
        refused.exception
    )
    words += ["--certificate", str(path)]
    done = invoke(*words)
    content = json.loads(path.read_text())
    assert content["loop"] == loop_of("jsbsim_c172p").digest, done.output
    assert content["names"][0] == "B[q,elevator]"
    assert run(content, tmp_path).stdout.startswith("PROVED")
    with refusing("of jsbsim_c172p, as jsbsim:c172p has"):
        rise_di.check_gains("osprey", "jsbsim_c172p")


@pytest.mark.usefixtures("coarse")
def test_law_without_c_code_has_a_certificate_without_constants(tmp_path: Path) -> None:
    """Vanes do not prevent a proof, only the C code.

    A changed entry shows that the proof is real.
    """
    path = tmp_path / "certificate.json"
    words = ["gains", "guarantee", "osprey", "--scenario", "osprey_vanes", "--samples", "1"]
    words += ["--uncertainty", "0", "--entry", "A[q,q]=0.6"]
    done = invoke(*words, "--certificate", str(path))
    said = " ".join(done.output.split())
    assert "certificate without constants: controller.observer.vanes: found a section" in said
    proved = run(json.loads(path.read_text()), tmp_path)
    assert proved.stdout.startswith("PROVED"), proved.stderr
    assert "law: of no exported constants" in proved.stdout


def test_closed_pipe_is_no_traceback(servo: Content, tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(servo))
    command = [sys.executable, str(CHECKER), str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as checker:
        assert checker.stdout is not None
        assert checker.stderr is not None
        checker.stdout.close()
        assert checker.stderr.read() == b""
    assert checker.returncode == 0


def test_file_that_cannot_be_read_is_status_2(tmp_path: Path) -> None:
    command = [sys.executable, str(CHECKER), str(tmp_path / "none.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("REFUSED")


def test_checker_without_a_file_says_how_it_is_called() -> None:
    done = subprocess.run([sys.executable, CHECKER], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("expected: check_certificate.py certificate.json")

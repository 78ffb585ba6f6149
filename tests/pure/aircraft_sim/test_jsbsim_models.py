# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test JSBSim models of the user.

They are found by path, with engines beside them or in a root, and electric engines are possible.
"""

import shutil
import zipfile
from pathlib import Path
from typing import Any

import jsbsim
import numpy as np
import pytest
from tests.builders import aircraft_parameters
from tests.conftest import refusing

from aircraft_sim.airframes.airframe import AIRPLANE_STATES
from aircraft_sim.atmosphere.disturbance import AXES, Gusts
from aircraft_sim.jsbsim import jsbsim_linearization, jsbsim_trim
from aircraft_sim.jsbsim.jsbsim_aircraft import (
    INPUTS,
    PREFIX,
    FlightCondition,
    WindModel,
    aircraft_names,
    require_aircraft,
    root,
    root_of,
)
from aircraft_sim.jsbsim.jsbsim_commands import hysteresis_of
from aircraft_sim.jsbsim.jsbsim_model import JsbsimModel
from aircraft_sim.jsbsim.jsbsim_trim import TrimSolution, nearest_trim, trim_solution
from aircraft_sim.plant.actuators import Actuators
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.outcome import FlightEnded
from flight_core.vectors import FloatArray
from rise_di import Scenario, fly

pytestmark = pytest.mark.slow

PACKAGE = Path(jsbsim.get_default_root_dir())
CESSNA = (PACKAGE / "aircraft" / "c172p" / "c172p.xml").read_text()
STEP_NS = 5_000_000
SECTION: dict[str, Any] = {"speed": 46.3, "altitude": 1219.2, "rate": 200.0, "step": 0.005}


def write_model(
    folder: Path, engine: str, name: str = "plane.xml", engines: str = "Engines"
) -> Path:
    """Write a c172p with an engine of the package, whose file is copied beside the model."""
    (folder / engines).mkdir(parents=True)
    (folder / engines / "own_engine.xml").write_bytes(
        (PACKAGE / "engine" / f"{engine}.xml").read_bytes()
    )
    (folder / name).write_text(CESSNA.replace("eng_io320", "own_engine"))
    return folder / name


@pytest.fixture(scope="module")
def electric(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the model of a c172p with an electric engine and another name than its folder."""
    return write_model(tmp_path_factory.mktemp("my planes"), "electric147kW")


@pytest.fixture
def external(tmp_path: Path) -> Path:
    """Return a c172p whose flight control reads the elevator in rad, with half of the opposite.

    It reads the ailerons from two properties.
    """
    declared = "".join(
        f'<property value="0.0">fcs/cmd{name}</property>'
        for name in ("Elev_ext_rad", "AilL", "AilR")
    )
    text = CESSNA.replace(
        '<flight_control name="FCS: c172">', f'<flight_control name="FCS: c172">{declared}', 1
    )
    half = (
        "<channel name='External'>"
        + "".join(
            "<fcs_function "
            f'name="{name}"><function>{term}</function><output>{name}</output></fcs_function>'
            for name, term in {
                "own/elevator": "<product><v>-2.0</v><p>fcs/cmdElev_ext_rad</p></product>",
                "own/aileron": "<difference><p>fcs/cmdAilR</p><p>fcs/cmdAilL</p></difference>",
            }.items()
        )
        + "</channel>"
    )
    text = text.replace('<channel name="Pitch">', f'{half}<channel name="Pitch">', 1)
    text = text.replace("<input>fcs/elevator-cmd-norm</input>", "<input>own/elevator</input>")
    text = text.replace("<input>fcs/aileron-cmd-norm</input>", "<input>own/aileron</input>")
    text = text.replace("<input>fcs/pitch-trim-cmd-norm</input>", "").replace(
        "<input>fcs/roll-trim-cmd-norm</input>", ""
    )
    path = tmp_path / "own.xml"
    path.write_text(text)
    return path


def test_hysteresis_of_a_model_is_named(external: Path) -> None:
    assert hysteresis_of(external) == ""
    servo = (
        '<actuator name="servo"><input>own/elevator</input>'
        "<hysteresis_width>0.02</hysteresis_width></actuator>"
    )
    text = external.read_text()
    marked = text.replace('<channel name="Pitch">', f'<channel name="Pitch">{servo}', 1)
    external.write_text(marked)
    assert hysteresis_of(external).startswith("; servos of the model have a hysteresis_width")


def test_command_without_effect_is_named_with_what_the_model_reads(external: Path) -> None:
    with pytest.raises(FlightEnded) as error:
        trim_solution(FlightCondition(str(external), 46.3, 1219.2, STEP_NS))
    sentence = str(error.value)
    assert (
        "cannot be flown: elevator: fcs/elevator-cmd-norm, aileron: fcs/aileron-cmd-norm moves "
        "no acceleration" in sentence
    )
    assert (
        "its flight control reads fcs/cmdAilL, fcs/cmdAilR, fcs/cmdElev_ext_rad: name them in "
        "`commands`" in sentence
    )
    assert "rudder" not in sentence
    assert "throttle" not in sentence


def test_aircraft_flies_by_the_properties_that_the_user_names(external: Path) -> None:
    """The command is the same as the c172p's: -2 rad^-1 x -0.5 rad.

    Each side gets half of the aileron.
    """
    commands = {
        "elevator": "fcs/cmdElev_ext_rad=-0.5",
        "aileron": "fcs/cmdAilR=0.5 fcs/cmdAilL=-0.5",
    }
    named = aircraft_parameters(
        **SECTION, airframe=f"{PREFIX}{external}", commands=commands
    ).flight_condition()
    flights = []
    for condition in (named, FlightCondition("c172p", 46.3, 1219.2, STEP_NS)):
        none = np.zeros(len(AXES))
        model = JsbsimModel(condition, Actuators(), WindModel(Gusts(none, none, none + 1.0), None))
        for k in range(100):
            model.advance(k * STEP_NS, np.array([0.02, 0.0, 0.05, 0.0]), STEP_NS)
        flights.append((model.trim.commands, model.y()))
    for own, expected in zip(*flights, strict=True):
        assert own == pytest.approx(expected, abs=0.01)
    assert abs(flights[0][1][0]) > 0.01  # q has moved
    assert flights[0][1][2] > 0.03  # p, to the right


def test_aircraft_without_rudder_has_three_inputs() -> None:
    """The aircraft flies as with its rudder at trim, and r is still measured."""
    section = aircraft_parameters(**SECTION, airframe=f"{PREFIX}c172p", commands={"rudder": "none"})
    assert [*section.channels().inputs] == ["elevator", "throttle", "aileron"]
    assert [*section.channels().outputs] == ["q", "V", "p", "r"]
    flights = []
    for condition in (section.flight_condition(), FlightCondition("c172p", 46.3, 1219.2, STEP_NS)):
        none = np.zeros(len(AXES))
        model = JsbsimModel(condition, Actuators(), WindModel(Gusts(none, none, none + 1.0), None))
        u = np.array([0.02, 0.0, 0.05, 0.0])[: len(condition.inputs())]
        model.advance(0, u, 50 * STEP_NS)
        flights.append(model.y().tolist())
    assert flights[0] == pytest.approx(flights[1], abs=1e-4)  # two trims


@pytest.mark.parametrize("effect", [0.0, 0.1])
def test_rudder_that_moves_nothing_is_seen(effect: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rudder without an effect is not an input of the linear aircraft, and r is not commanded."""

    def response(_: FlightCondition, __: object, name: str, size: float) -> FloatArray:
        rows = np.zeros((20, len(AIRPLANE_STATES)))
        effects = {"rudder": effect}
        output = jsbsim_linearization.driven(name)
        rows[:, list(AIRPLANE_STATES).index(output)] = size * effects.get(name, 1.0)
        return rows

    monkeypatch.setattr(jsbsim_linearization, "_response", response)
    result = jsbsim_linearization.linearize(FlightCondition("c172p", 46.3, 1219.2, STEP_NS))
    assert ("rudder" in result.airframe.inputs) == bool(effect)
    assert ("r" in result.airframe.outputs) == bool(effect)
    assert "r" in result.airframe.states


@pytest.mark.parametrize(
    "commands, sentence",
    [
        ({"flaps": "fcs/flap"}, "commands: found 'flaps', expected an input: elevator"),
        (
            {"elevator": "simulation/write-state-file"},
            "commands.elevator: found 'simulation/write-state-file', expected",
        ),
        ({"elevator": "fcs/a=0"}, "commands.elevator: found 'fcs/a=0', expected PROPERTY=VALUE"),
        ({"elevator": " "}, "commands.elevator: found ' ', expected a property"),
    ],
)
def test_named_property_that_is_none_is_refused(commands: dict[str, str], sentence: str) -> None:
    with refusing(sentence):
        aircraft_parameters(
            **SECTION, airframe=f"{PREFIX}c172p", commands=commands
        ).flight_condition()


def test_named_property_that_the_model_lacks_is_refused(external: Path) -> None:
    condition = FlightCondition(
        name=str(external),
        speed=46.3,
        altitude=1219.2,
        step_ns=STEP_NS,
        named=(("elevator", (("fcs/absent", 1.0),)),),
    )
    with pytest.raises(FlightEnded, match="it has no property fcs/absent"):
        trim_solution(condition)


def throttle_step(airframe: str) -> FloatArray:
    """Return V as the deviation from trim, m/s, for two seconds with 0.1 more throttle."""
    none = np.zeros(len(AXES))
    condition = FlightCondition(require_aircraft(airframe), 46.3, 1219.2, STEP_NS)
    model = JsbsimModel(condition, Actuators(), WindModel(Gusts(none, none, none + 1.0), None))
    u = np.array([0.1 * (name == "throttle") for name in INPUTS])
    V = []
    for k in range(400):
        model.advance(k * STEP_NS, u, STEP_NS)
        V.append(model.y()[1])
    return np.array(V)


def test_electric_aircraft_of_own_trims_and_answers_throttle(electric: Path) -> None:
    V = throttle_step(f"{PREFIX}{electric}")
    # 0.1 of 147 kW at 46.3 m/s and 1100 kg is 0.29 m/s^2; the propeller loses a part
    assert 0.1 < V[-1] < 0.6
    assert np.all(np.diff(V[100:]) > 0.0)


def test_folder_names_its_only_model(electric: Path) -> None:
    assert require_aircraft(f"{PREFIX}{electric.parent}") == str(electric)


def test_relative_path_is_that_of_working_folder(
    electric: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(electric.parent)
    assert require_aircraft(f"{PREFIX}plane.xml") == str(electric)


def test_archive_of_run_flies_alike(electric: Path, tmp_path: Path) -> None:
    c172p = find_scenario("jsbsim_c172p")
    own = Scenario.from_parts(
        "own",
        flight={"duration": 1.0},
        aircraft=c172p.aircraft.model_dump() | {"airframe": f"{PREFIX}{electric}"},
        reference_model=c172p.reference_model,
        controller=c172p.controller,
    )
    result = fly(own, tmp_path / "runs")
    with zipfile.ZipFile(result.mcap.parent / "aircraft.zip") as archive:
        archive.extractall(tmp_path / "elsewhere")
    copy = tmp_path / "elsewhere" / "aircraft" / "plane"
    assert np.array_equal(throttle_step(f"{PREFIX}{copy}"), throttle_step(f"{PREFIX}{electric}"))
    assert (
        tmp_path / "elsewhere" / "engine" / "prop_75in2f.xml"
    ).is_file()  # of the package, which the model names


def test_model_without_trim_of_its_own_trims_by_its_elevator(
    electric: Path, tmp_path: Path
) -> None:
    # As on flying wings no surface reads fcs/pitch-trim-cmd-norm.
    text = electric.read_text()
    cut = text.replace("fcs/pitch-trim-cmd-norm", "fcs/yaw-trim-cmd-norm")
    assert cut != text
    for part in electric.parent.iterdir():
        if part.is_dir():
            shutil.copytree(part, tmp_path / part.name)
    model = tmp_path / electric.name
    model.write_text(cut)
    solution = trim_solution(FlightCondition(str(model), 46.3, 1219.2, STEP_NS))
    assert solution is not None
    assert solution[-1] == 1.0  # all of it by the elevator


def test_root_of_user_has_names_and_engines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = tmp_path / "root"
    model = write_model(tree / "aircraft" / "mine", "electric147kW", "mine.xml")
    (tree / "engine").mkdir()
    (model.parent / "Engines" / "own_engine.xml").rename(tree / "engine" / "own_engine.xml")
    (tree / "engine" / "prop_75in2f.xml").write_bytes(
        (PACKAGE / "engine" / "prop_75in2f.xml").read_bytes()
    )
    expected = throttle_step(f"{PREFIX}{model}")  # the root is that of the path
    monkeypatch.setenv("JSBSIM_ROOT", str(tree))
    aircraft_names.cache_clear()
    try:
        assert aircraft_names() == ("mine",)
        assert np.array_equal(throttle_step(f"{PREFIX}mine"), expected)
        monkeypatch.setenv("JSBSIM_ROOT", str(tmp_path))
        with refusing(r"^JSBSIM_ROOT: found .*, expected a folder with aircraft and engine$"):
            root()
    finally:
        aircraft_names.cache_clear()


@pytest.mark.parametrize("path", ["/plane.xml", "/aircraft/plane.xml"])
def test_model_near_top_of_disk_has_root_of_package(path: str) -> None:
    assert root_of(Path(path)) == root()


@pytest.mark.parametrize(
    "path, sentence",
    [
        (
            "nowhere.xml",
            (
                "found 'jsbsim:nowhere.xml', where no file is, expected the XML file of an "
                "aircraft of JSBSim"
            ),
        ),
        (
            "./two",
            "found 'jsbsim:./two', a folder with a.xml, b.xml, expected a folder with one model",
        ),
        ("empty", "found 'jsbsim:empty', expected jsbsim:./empty perhaps"),
        ("./page", "found 'jsbsim:./page', a file with html, expected the XML file of an aircraft"),
        ("zzz", "found 'jsbsim:zzz', expected a name in .*/aircraft, or jsbsim:PATH with a /"),
    ],
)
def test_wrong_path_refused_with_what_is_there(
    path: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("empty", "two", "page"):
        (tmp_path / folder).mkdir()
    (tmp_path / "page" / "page.xml").write_text("<html/>")
    for name in ("a", "b"):
        (tmp_path / "two" / f"{name}.xml").write_text('<?xml version="1.0"?><fdm_config/>')
    (tmp_path / "engine.xml").write_bytes((PACKAGE / "engine" / "eng_io320.xml").read_bytes())
    (tmp_path / "text.xml").write_text("x,y\n1,2\n")
    with refusing(f"^aircraft.airframe: {sentence}") as error:
        aircraft_parameters(**SECTION, airframe=f"{PREFIX}{path}")
    assert len(str(error.value)) < 300  # no list of all names


def test_missing_engine_named_with_folders_searched(electric: Path, tmp_path: Path) -> None:
    model = tmp_path / "lone.xml"
    model.write_bytes(electric.read_bytes())
    condition = FlightCondition(str(model), 46.3, 1219.2, STEP_NS)
    with pytest.raises(
        FlightEnded,
        match=r"cannot be loaded: .*found no file own_engine.xml, expected it in "
        rf"{tmp_path}/Engines or .*/engine$",
    ):
        trim_solution(condition)


def test_nearest_trim_is_the_first_neighbour_that_trims(monkeypatch: pytest.MonkeyPatch) -> None:
    """The aircraft needs 27 m/s and flies up to 4,000 m.

    A tenth more speed is nearer than a third. If no speed helps, half of the altitude is tried.
    """
    seconds = []

    def trims(condition: FlightCondition, timeout: float) -> TrimSolution:
        seconds.append(timeout)
        if condition.speed < 27.0 or condition.altitude > 4000.0:
            raise FlightEnded("no trim")
        return ()

    monkeypatch.setattr(jsbsim_trim, "trim_solution", trims)

    def near(speed: float, altitude: float) -> str | None:
        return nearest_trim(FlightCondition("plane", speed, altitude, STEP_NS))

    assert near(25.0, 1000.0) == "it trims at 27.5 m/s and 1000 m"
    assert near(22.0, 1000.0) == "it trims at 29.7 m/s and 1000 m"
    assert near(40.0, 5000.0) == "it trims at 40 m/s and 2500 m"
    assert near(15.0, 1000.0) is None
    assert near(40.0, 9000.0) is None
    # A refusal waits for at most six conditions.
    assert max(seconds) <= 3.0

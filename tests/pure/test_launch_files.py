# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The launch files, as far as they can be checked without `launch`, which is not on PyPI.

With a stand-in that notes what it is given (tests/launch_stand_in.py): which arguments there are, which processes start when,
with which parameters, and what their end does.
"""

import importlib.util
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from tests import launch_stand_in as stand_in
from tests.conftest import REPOSITORY
from tests.launch_stand_in import (
    DeclareLaunchArgument,
    ExecutableInPackage,
    ExecuteProcess,
    LaunchConfiguration,
    LaunchContext,
    Node,
    OpaqueFunction,
    ProcessExited,
    ProcessIO,
    RegisterEventHandler,
    Shutdown,
    TimerAction,
)

from autopilot_bridge.params import LIBRARY, BridgeParameters, load_map
from flight_analysis.closed_loop.scenario import SCHEMAS, Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_cli.cli import COMMANDS, application
from flight_core.parameters import ParameterError, Parameters
from flight_core.scenario import read_sections
from flight_log.bag import Enclosed
from flight_log.tape_writer import write_run

app = application([*COMMANDS])

FILES = sorted((REPOSITORY / "ros_ws" / "src" / "flight_bringup" / "launch").glob("*.launch.py"))
INSTALLED = REPOSITORY / "ros_ws" / "install"
NODES: dict[str, type[Parameters]] = {
    **{name: schema for name, schema in SCHEMAS.items() if name != "flight"},
    "bridge": BridgeParameters,
}
SHARED = "flight_bringup.launch.stages"
READY = ProcessIO(b"[INFO] [12.5] [one.controller]: ready\n")


@pytest.fixture(autouse=True)
def launch(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The stand-in in the place of launch, also for what the launch files share."""
    for name, module in stand_in.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, SHARED, raising=False)
    yield
    sys.modules.pop(SHARED, None)


def described(name: str) -> Sequence[Any]:
    """What a launch file describes."""
    path = next(file for file in FILES if file.name == f"{name}.launch.py")
    spec = importlib.util.spec_from_file_location(f"{name}_launch", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    entities: Sequence[Any] = module.generate_launch_description().entities
    return entities


def started(name: str, **given: object) -> tuple[list[Any], LaunchContext]:
    """The actions of a launch with arguments, and its context; those not given have their default."""
    entities = described(name)
    declared = {one.name: one.default_value for one in entities if isinstance(one, DeclareLaunchArgument)}
    assert given.keys() <= declared.keys()
    context = LaunchContext(**{key: value for key, value in declared.items() if value is not None})
    context.launch_configurations.update({key: str(value) for key, value in given.items()})
    (function,) = [one.function for one in entities if isinstance(one, OpaqueFunction)]
    return list(function(context)), context


def nodes(actions: Sequence[Any]) -> dict[str, Node]:
    """The nodes among actions, by their executables."""
    return {one.executable: one for one in actions if isinstance(one, Node)}


def told(node: Node) -> dict[str, Any]:
    """What a node is told beside its section of the scenario."""
    found: dict[str, Any] = node.parameters[1]
    return found


def say(actions: Sequence[Any], node: Any, event: ProcessIO) -> list[Any]:
    """The actions that follow what a node says."""
    follow: list[Any] = []
    for one in actions:
        if isinstance(one, RegisterEventHandler) and one.event_handler.target_action is node:
            follow += one.event_handler.on_stdout(event) or []
    return follow


def all_ready(actions: Sequence[Any]) -> list[Any]:
    """What follows when all nodes are ready; nothing before that, and nothing twice."""
    *others, last = nodes(actions).values()
    for one in others:
        assert say(actions, one, READY) == []
        assert say(actions, one, READY) == []
    follow = say(actions, last, READY)
    assert say(actions, last, READY) == []
    return follow


def ends(actions: Sequence[Any]) -> bool:
    return any(isinstance(one, Shutdown) for one in actions)


@pytest.fixture
def short(osprey_gust: Scenario, tmp_path: Path) -> Path:
    """A recorded flight of half a second."""
    tape = simulate(osprey_gust.vary(flight={"duration": 0.5}))
    return write_run(tape, tmp_path / "log", Enclosed(osprey_gust.path)).parent


CASES: tuple[tuple[str, dict[str, str], tuple[str, ...], tuple[str, ...]], ...] = (
    ("fly", {}, ("recorder", "controller"), ("aircraft", "reference_model")),
    ("fly", {"lockstep": "true"}, ("recorder", "controller"), ("aircraft", "reference_model")),
    ("bridge", {"map": "ardupilot"}, ("recorder", "controller"), ("bridge", "reference_model")),
    ("bridge", {"map": "px4", "recorder": "false"}, ("controller",), ("bridge", "reference_model")),
    ("replay", {}, ("controller",), ()),
    ("replay", {"recorder": "true", "lockstep": "true"}, ("recorder", "controller"), ()),
    ("replay", {"controller": "false", "aircraft": "true"}, ("aircraft",), ()),
    ("replay", {"map": "ardupilot", "reference_model": "true"}, ("controller", "reference_model", "bridge"), ()),
)


def test_every_launch_file_is_installed_and_tested_here() -> None:
    names = [path.name.removesuffix(".launch.py") for path in FILES]
    assert set(names) == {name for name, *_ in CASES}
    for path in FILES:
        assert (INSTALLED / "flight_bringup" / "share" / "flight_bringup" / "launch" / path.name).is_file()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_argument_is_described_and_its_default_is_one_of_its_choices(path: Path) -> None:
    arguments = [one for one in described(path.name.removesuffix(".launch.py")) if isinstance(one, DeclareLaunchArgument)]
    assert len({one.name for one in arguments}) == len(arguments) > 3
    for one in arguments:
        assert one.description, one.name
        if one.choices is not None:
            assert one.default_value in one.choices, one.name
        else:
            assert one.default_value not in {"true", "false"}, f"{one.name} needs choices"


@pytest.mark.parametrize(
    ("name", "given", "first", "then"), CASES, ids=lambda one: "-".join(one) if isinstance(one, dict) else ""
)
def test_nodes_start_in_order_with_parameters_that_they_have(
    name: str, given: dict[str, str], first: tuple[str, ...], then: tuple[str, ...], short: Path, tmp_path: Path
) -> None:
    log = {"run": str(short)} if name == "replay" else {}
    actions, context = started(name, **given, **log, runs=tmp_path / "runs")
    follow = all_ready(actions)
    assert tuple(nodes(actions)) == first
    assert tuple(nodes(follow)) == then
    assert context.launch_configurations["launch-prefix"].endswith("setpriv --pdeathsig TERM")
    for executable, node in {**nodes(actions), **nodes(follow)}.items():
        assert (INSTALLED / node.package / "lib" / node.package / executable).is_file()
        assert node.namespace == LaunchConfiguration("namespace")
        assert node.exec_name == executable
        file, given_to_node = node.parameters
        section = {} if executable == "bridge" else read_sections(Path(file), tuple(SCHEMAS))[executable]
        NODES[executable].validate_mapping(section | given_to_node, executable)


@pytest.mark.parametrize(
    ("name", "given", "first", "then"), CASES, ids=lambda one: "-".join(one) if isinstance(one, dict) else ""
)
def test_the_end_of_any_node_ends_the_launch_with_an_error(
    name: str, given: dict[str, str], first: tuple[str, ...], then: tuple[str, ...], short: Path, tmp_path: Path
) -> None:
    log = {"run": str(short)} if name == "replay" else {}
    actions, context = started(name, **given, **log, runs=tmp_path / "runs")
    for executable, node in {**nodes(actions), **nodes(all_ready(actions))}.items():
        assert node.on_exit is not None
        for status in (0, 3, -9):
            context.is_shutdown = False
            with pytest.raises(RuntimeError, match=f"{executable}-1 ended before the flight did"):
                node.on_exit(ProcessExited(f"{executable}-1", status), context)
            context.is_shutdown = True
            assert node.on_exit(ProcessExited(f"{executable}-1", status), context) is None


def test_a_flight_ends_after_its_duration_and_in_lockstep_when_it_is_flown(tmp_path: Path) -> None:
    follow = all_ready(started("fly", duration=5, runs=tmp_path)[0])
    (timer,) = [one for one in follow if isinstance(one, TimerAction)]
    assert timer.period == pytest.approx(5.5, abs=0.4)  # and the half second in which nodes find each other
    assert ends(timer.actions)
    assert {"start_time"} == told(nodes(follow)["reference_model"]).keys() - {"lockstep"}

    follow = all_ready(started("fly", lockstep="true", duration=5, runs=tmp_path)[0])
    aircraft = nodes(follow)["aircraft"]
    assert told(aircraft)["duration"] == 5.0
    assert not [one for one in follow if isinstance(one, TimerAction)]
    assert not say(follow, aircraft, READY)
    assert ends(say(follow, aircraft, ProcessIO(b"[INFO] [1.0] [aircraft]: flown to its end at t = 5 s\n")))


def test_a_bridge_sends_nothing_unless_it_is_told_to_and_its_topics_are_recorded(tmp_path: Path) -> None:
    actions, _ = started("bridge", map="ardupilot", runs=tmp_path)
    bridge = told(nodes(all_ready(actions))["bridge"])
    assert bridge == {"map": str(LIBRARY / "ardupilot.yaml"), "dry_run": True}
    recorder = told(nodes(actions)["recorder"])
    assert set(load_map("ardupilot").topics) <= set(recorder["topics"])
    assert "bridge/would_send" in recorder["topics"]
    assert bridge["map"] in recorder["attach"]
    follow = all_ready(started("bridge", map="ardupilot", dry_run="false", runs=tmp_path)[0])
    assert told(nodes(follow)["bridge"])["dry_run"] is False
    assert not [one for one in follow if isinstance(one, TimerAction)]  # until Ctrl-C
    follow = all_ready(started("bridge", map="ardupilot", duration=5, runs=tmp_path)[0])
    (timer,) = [one for one in follow if isinstance(one, TimerAction)]
    assert ends(timer.actions)


def test_a_bridge_with_a_flipped_sign_is_refused_before_anything_starts(tmp_path: Path) -> None:
    content = yaml.safe_load((LIBRARY / "ardupilot.yaml").read_text(encoding="utf-8"))
    content["inputs"]["rudder"] = {**content["inputs"]["rudder"], "sign": -1}
    (tmp_path / "flipped.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ParameterError, match="D of r and rudder is -1, the controller has \\+1"):
        started("bridge", map=tmp_path / "flipped.yaml", runs=tmp_path)
    assert not list(tmp_path.glob("*-osprey_gust"))


def player(actions: Sequence[Any]) -> ExecuteProcess:
    (found,) = [one for one in actions if isinstance(one, ExecuteProcess)]
    return found


def options(process: ExecuteProcess) -> dict[str, Any]:
    """What `rise-di play` makes of its command line."""
    executable, command, *words = process.cmd
    assert executable == ExecutableInPackage(package="flight_bringup", executable="rise-di")
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    with group.commands[command].make_context(command, [*words]) as context:
        return dict(context.params)


@pytest.mark.parametrize(
    ("given", "topics"),
    [
        ({}, "/truth,/y,/y_m"),  # the controller says u and internals itself
        ({"controller": "false", "aircraft": "true"}, "/internals,/u,/y_m"),
        ({"controller": "false", "reference_model": "true"}, "/internals,/truth,/u,/y"),
        ({"map": "ardupilot"}, "/truth,/y_m"),  # y is the bridge's
        ({"namespace": "one"}, "/internals,/truth,/u,/y,/y_m"),  # a flight without one: nobody in it says these
        ({"topics": "y,y_m"}, "y,y_m"),
    ],
    ids=str,
)
def test_what_no_node_says_itself_is_played(given: dict[str, str], topics: str, short: Path, osprey_gust: Scenario) -> None:
    actions, _ = started("replay", run=short, scenario=osprey_gust.path, **given)
    found = options(player(all_ready(actions)))
    assert found["topics"] == topics
    assert found["run"] == short
    assert (found["rate"], found["start"], found["loop"], str(found["stamps"])) == (1.0, 0.0, False, "now")


def test_playing_follows_the_arguments_and_the_end_of_the_log_is_the_end(short: Path, tmp_path: Path) -> None:
    given = {"rate": "2", "start": "0.1", "loop": "true", "lockstep": "true", "recorder": "true"}
    actions, context = started("replay", run=short, runs=tmp_path, **given)
    assert told(nodes(actions)["controller"]) == {"lockstep": True, "y_rate": 500.0}
    process = player(all_ready(actions))
    found = options(process)
    assert (found["rate"], found["start"], found["loop"], str(found["stamps"])) == (2.0, 0.1, True, "recorded")
    assert process.on_exit is not None
    assert ends(process.on_exit(ProcessExited("play-3", 0), context))
    with pytest.raises(RuntimeError, match="play-3 ended before the flight did"):
        process.on_exit(ProcessExited("play-3", 2), context)


def test_a_log_is_played_to_nobody_at_once(short: Path) -> None:
    actions, context = started("replay", run=short, controller="false")
    process = player(actions)
    assert options(process)["topics"] == "/internals,/truth,/u,/y,/y_m"
    assert process.on_exit is not None
    assert ends(process.on_exit(ProcessExited("play-1", 0), context))


def test_lockstep_is_for_the_controller_alone(short: Path) -> None:
    with pytest.raises(ParameterError, match="lockstep: found true with aircraft, expected controller and recorder alone"):
        started("replay", run=short, lockstep="true", aircraft="true")

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the launch files with a stand-in for `launch` (tests/launch_stand_in.py).

The tests cover the arguments, the order in which processes start by their `node_state`, their
parameters, and the effect of their end.
"""

import re
import runpy
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import pytest
import typer
import yaml
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import KeyValue
from tests import launch_stand_in as stand_in
from tests.conftest import REPOSITORY, refusing
from tests.launch_stand_in import (
    ExecuteProcess,
    LaunchContext,
    Node,
    OpaqueFunction,
    ProcessExited,
    TimerAction,
)
from tests.maps import MAP_FILES

from aircraft_sim.airframes.airframe import LIBRARY as AIRFRAMES
from autopilot_bridge.params import LIBRARY, BridgeConfig, load_map
from flight_analysis.closed_loop.scenario import (
    SCHEMAS,
    Scenario,
    load_scenario,
    parse_scenario_sections,
)
from flight_analysis.closed_loop.simulate import simulate
from flight_cli.cli import COMMANDS, application
from flight_core.environment import PROFILE_VARIABLE
from flight_core.outcome import (
    COMPLETED,
    INTERRUPTED,
    STATUS_LANDED,
    End,
    ended_early,
    never_flew,
    parsed_outcome,
)
from flight_core.parameters import Config
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_log.bag import LogAttachments
from flight_log.tape_writer import write_run
from flight_ros.messages import stamp_of
from flight_ros.topics import NodeState
from flight_ros.transport import DISCOVERY_VARIABLE

app = application([*COMMANDS])
FILES = sorted((REPOSITORY / "ros_ws" / "src" / "flight_bringup" / "launch").glob("*.launch.py"))
INSTALLED = REPOSITORY / "ros_ws" / "install"
NODES: dict[str, type[Config]] = {
    name: schema for name, schema in SCHEMAS.items() if name != "flight"
}
NODES["bridge"] = BridgeConfig
SHARED = ("flight_bringup.launch.stages", "flight_bringup.launch.flight")
PID = 0  # of a process of this launch
T = TypeVar("T")
Case = tuple[list[Any], LaunchContext, tuple[str, ...], tuple[str, ...]]


@pytest.fixture(autouse=True)
def launch(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Put the stand-in in the place of launch, also for the shared code of the launch files."""
    for name in (PROFILE_VARIABLE, DISCOVERY_VARIABLE):
        monkeypatch.setenv(name, "")  # restored afterwards
        monkeypatch.delenv(name)
    for name, module in stand_in.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    for name in SHARED:
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield
    for name in SHARED:
        sys.modules.pop(name, None)


@pytest.fixture(scope="module", autouse=True)
def process() -> Iterator[None]:
    global PID  # noqa: PLW0603 - one process for all tests
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        PID = child.pid
        yield
        child.terminate()


def described(name: str) -> Sequence[Any]:
    path = next(file for file in FILES if file.name == f"{name}.launch.py")
    entities: Sequence[Any] = runpy.run_path(str(path))["generate_launch_description"]().entities
    return entities


def started(name: str, pushed: str = "", **given: object) -> tuple[list[Any], LaunchContext]:
    """Return the actions of a launch after the domain is known, and its context.

    `pushed` is the namespace of a launch file that includes it.
    """
    actions, context = begun(name, pushed, **given)
    assert not nodes(actions)  # none before the domain is known
    return discovered(actions, context), context


def discovered(actions: Sequence[Any], context: LaunchContext) -> list[Any]:
    """Return the actions, with those that follow half a second later.

    By then, other flights of the domain are known.
    """
    follow = list(actions)
    for timer in every(TimerAction, actions):
        assert timer.period == 0.5
        (look,) = every(OpaqueFunction, timer.actions)
        follow.remove(timer)
        follow += look.function(context) or ()
    return follow


def begun(name: str, pushed: str = "", **given: object) -> tuple[list[Any], LaunchContext]:
    """Return the first actions of a launch, and its context."""
    context = LaunchContext()
    return included(name, context, pushed, **given), context


def included(
    name: str,
    context: LaunchContext,
    pushed: str = "",
    scope: Mapping[str, Any] = MappingProxyType({}),
    /,
    **given: object,
) -> list[Any]:
    """Return the first actions of a launch file that another one includes with these arguments.

    `scope` has what actions of launch_ros left in the launch configurations.
    """
    entities = described(name)
    declared = {
        argument.name: argument.default_value
        for argument in every(stand_in.DeclareLaunchArgument, entities)
    }
    assert given.keys() <= declared.keys()
    context.launch_configurations.clear()
    context.launch_configurations.update(
        {key: value for key, value in declared.items() if value is not None}
    )
    context.launch_configurations.update({key: str(value) for key, value in given.items()})
    context.launch_configurations.update(scope)
    if pushed:
        context.launch_configurations["ros_namespace"] = pushed
    (preparation,) = every(OpaqueFunction, entities)
    return list(preparation.function(context) or ())


def nodes(actions: Sequence[Any]) -> dict[str, Node]:
    """Return the nodes among actions, by their executables."""
    return {node.executable: node for node in every(Node, actions)}


def overrides(node: Node) -> dict[str, Any]:
    """Return the parameters that a node has besides its section of the scenario."""
    values: dict[str, Any] = node.parameters[1]
    return values


def publish(
    actions: Sequence[Any],
    context: LaunchContext,
    key: str,
    state: str = "ready",
    topic: str = "/node_state",
) -> list[Any]:
    """Return the actions that follow a message on `node_state`."""
    context.ros_node.subscriptions[topic](KeyValue(key=key, value=state))
    return context.handle(actions)


def all_ready(actions: Sequence[Any], context: LaunchContext, namespace: str = "") -> list[Any]:
    """Return the actions that follow when all nodes are ready.

    No action follows before that, or after a second message.
    """
    topic = f"{namespace}/node_state"
    *others, last = (f"{namespace}/{name}#{PID}" for name in nodes(actions))
    for key in others:
        assert publish(actions, context, key, topic=topic) == []
        assert publish(actions, context, key, topic=topic) == []
    follow = publish(actions, context, last, topic=topic)
    assert publish(actions, context, last, topic=topic) == []
    return follow


def ends(actions: Sequence[Any], *processes: Any) -> bool:
    """Return whether actions stop the processes of this launch, and only these."""
    matchers = [
        action.event.process_matcher
        for action in every(stand_in.EmitEvent, actions)
        if isinstance(action.event, stand_in.ShutdownProcess)
    ]
    other = ExecuteProcess(cmd=[])
    assert not any(matches(other) for matches in matchers)
    return any(all(map(matches, processes)) for matches in matchers)


def restored(actions: Sequence[Any], context: LaunchContext) -> dict[str, Any]:
    """Return the launch configurations that a process among actions is started with."""
    kinds = [type(action) for action in actions]
    push = kinds.index(stand_in.PushLaunchConfigurations)
    assert stand_in.PopLaunchConfigurations in kinds[push:]
    before = dict(context.launch_configurations)
    actions[push + 1].execute(context)
    configurations = dict(context.launch_configurations)
    context.launch_configurations.clear()
    context.launch_configurations.update(before)
    return configurations


def every(kind: type[T], actions: Sequence[Any]) -> list[T]:
    return [action for action in actions if isinstance(action, kind)]


@pytest.fixture(scope="module")
def short(osprey_gust: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recorded flight of half a second."""
    tape = simulate(osprey_gust.vary(flight={"duration": 0.5}))
    folder = tmp_path_factory.mktemp("short") / "log"
    return write_run(tape, folder, LogAttachments(osprey_gust.path)).parent


CASES: tuple[tuple[str, dict[str, str], tuple[str, ...], tuple[str, ...]], ...] = (
    ("fly", {}, ("recorder", "controller"), ("aircraft", "reference_model")),
    ("fly", {"lockstep": "true"}, ("recorder", "controller"), ("aircraft", "reference_model")),
    ("bridge", {"map": "ardupilot"}, ("recorder", "controller"), ("bridge", "reference_model")),
    ("bridge", {"map": "px4", "recorder": "false"}, ("controller",), ("bridge", "reference_model")),
    ("replay", {}, ("controller",), ()),
    ("replay", {"recorder": "true", "lockstep": "true"}, ("recorder", "controller"), ()),
    ("replay", {"controller": "false", "aircraft": "true"}, ("aircraft",), ()),
    (
        "replay",
        {"map": "ardupilot", "reference_model": "true"},
        ("controller", "reference_model", "bridge"),
        (),
    ),
)


def test_every_launch_file_installed_and_tested_here() -> None:
    names = [path.name.removesuffix(".launch.py") for path in FILES]
    assert set(names) == {"fleet", *(name for name, *_ in CASES)}
    for path in FILES:
        assert (
            INSTALLED / "flight_bringup" / "share" / "flight_bringup" / "launch" / path.name
        ).is_file()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_argument_described_and_default_is_one_of_choices(path: Path) -> None:
    arguments = every(
        stand_in.DeclareLaunchArgument, described(path.name.removesuffix(".launch.py"))
    )
    assert len({argument.name for argument in arguments}) == len(arguments) > 2
    for argument in arguments:
        assert argument.description, argument.name
        if argument.choices is not None:
            assert argument.default_value in argument.choices, argument.name
        else:
            assert argument.default_value not in {"true", "false"}, f"{argument.name} needs choices"


SIM_TIME = {"global_params": [("use_sim_time", True)]}  # as SetParameter leaves it


def test_set_parameter_chooses_clock_as_argument_does(tmp_path: Path) -> None:
    fleet = tmp_path / "fleet.yaml"
    fleet.write_text("{composed: true, aircraft: {uav1: {}}}")
    given: tuple[tuple[str, dict[str, object]], ...] = (("fly", {}), ("fleet", {"fleet": fleet}))
    for name, arguments in given:
        actions = included(name, LaunchContext(), "", SIM_TIME, **arguments)
        by_argument = included(name, LaunchContext(), use_sim_time="true", **arguments)
        (process,), (other,) = (every(ExecuteProcess, each) for each in (actions, by_argument))
        assert "--use-sim-time" in process.cmd
        assert [*map(str, process.cmd)] == [*map(str, other.cmd)]
    with refusing("use_sim_time: found true by SetParameter, expected false"):
        included("bridge", LaunchContext(), "", SIM_TIME, map="ardupilot")


@pytest.mark.parametrize(
    ("scope", "found"),
    [
        ({"global_params": [("k_g", 2.0), ("use_sim_time", True)]}, "SetParameter k_g"),
        ({"global_params": ["own.yaml"], "use_sim_time": "true"}, "SetParametersFromFile own.yaml"),
        ({"ros_remaps": [("y", "/imu")], "use_sim_time": "true"}, "SetRemap y"),
    ],
)
def test_what_no_node_of_rise_di_fly_would_get_is_refused(
    scope: Mapping[str, Any], found: str
) -> None:
    with refusing(f"found {found} of the launch, expected values in the file"):
        included("fly", LaunchContext(), "", scope)


def test_later_set_parameter_of_launch_reaches_no_node_of_flight(tmp_path: Path) -> None:
    context = LaunchContext()
    parameters = [("k_g", 2.0)]
    actions = included("fly", context, "", {"global_params": parameters}, runs=tmp_path / "runs")
    actions = discovered(actions, context)
    parameters.append(("k_g", 3.0))  # as launch_ros does for the next group
    assert restored(actions, context)["global_params"] == [("k_g", 2.0)]


def test_node_that_is_matched_before_the_others_are_ready_does_not_hold_up_the_flight(
    tmp_path: Path,
) -> None:
    """The aircraft and the reference model are the user's.

    They published before the controller started.
    """
    actions, context = started(
        "fly", aircraft="false", reference_model="false", runs=tmp_path / "runs"
    )
    publish(actions, context, f"/controller#{PID}")
    publish(actions, context, f"/controller#{PID}", "matched")
    follow = publish(actions, context, f"/recorder#{PID}")
    for already in every(OpaqueFunction, follow):
        follow += already.function(context) or []
    assert context.ros_node.published == []
    publish(follow, context, f"/recorder#{PID}", "matched")
    assert [topic for topic, _ in context.ros_node.published] == ["/start"]
    (run,) = (tmp_path / "runs").glob("*-osprey_servo")
    assert (tmp_path / "runs" / "latest").resolve() == run.resolve()


def test_fleet_is_a_process_and_its_end_ends_launch(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text("{composed: true, aircraft: {uav1: {}}}")
    actions, context = started("fleet", fleet=file, duration="3.0", watch="true")
    (fleet,) = every(ExecuteProcess, actions)
    assert [str(word) for word in fleet.cmd[1:]] == [
        "fly",
        str(file),
        "--runs",
        "runs",
        "--real-time",
        "--duration",
        "3.0",
        "--watch",
    ]
    assert fleet.on_exit is not None
    assert ends(fleet.on_exit(ProcessExited("fleet", 0), context), fleet)
    actions, context = started("fleet", fleet=file)
    (fleet,) = every(ExecuteProcess, actions)
    assert fleet.on_exit is not None
    with pytest.raises(RuntimeError, match="rise-di fly ended with status 3"):
        fleet.on_exit(ProcessExited("fleet", 3), context)
    file.write_text("aircraft: {1a: {}}")
    with refusing("found '1a'"):
        started("fleet", fleet=file)


@pytest.fixture(params=CASES, ids=lambda case: "-".join((case[0], *case[1])))
def case(request: pytest.FixtureRequest, short: Path, tmp_path: Path) -> Case:
    """Return a launch: actions, context, and the nodes of its first and its second stage."""
    name, given, first, then = request.param
    log = {"run": str(short)} if name == "replay" else {}
    return (*started(name, **given, **log, runs=tmp_path / "runs"), first, then)


def test_nodes_start_in_order_with_parameters_that_they_have(case: Case) -> None:
    actions, context, first, then = case
    follow = all_ready(actions, context)
    assert tuple(nodes(actions)) == first
    assert tuple(nodes(follow)) == then
    for stage in (actions, follow):
        prefix = restored(stage, context)["launch-prefix"]
        assert prefix.endswith("setpriv --pdeathsig TERM")
    assert "launch-prefix" not in context.launch_configurations  # of whoever includes the file
    for executable, node in {**nodes(actions), **nodes(follow)}.items():
        assert (INSTALLED / node.package / "lib" / node.package / executable).is_file()
        assert node.namespace == ""
        assert node.ros_arguments == ["--log-level", "info"]
        assert node.exec_name == executable
        file, given_to_node = node.parameters
        section = (
            {}
            if executable == "bridge"
            else parse_scenario_sections(Path(file).read_bytes(), Path(file))[executable]
        )
        NODES[executable].validate_mapping(section | given_to_node, executable)


@pytest.mark.parametrize("number", [0, -1], ids=["first stage", "last stage"])
def test_end_of_any_node_ends_launch_with_error(number: int, case: Case, tmp_path: Path) -> None:
    """Status 0 is an error, too, because no node may end before the flight."""
    actions, context, first, _ = case
    left = [file.read_text() for file in tmp_path.glob("runs/2*/outcome")]
    assert left == ([INTERRUPTED.text()] if "recorder" in first else [])  # the outcome of Ctrl-C
    processes = {**nodes(actions), **nodes(all_ready(actions, context))}
    executable, node = [*processes.items()][number]
    assert node.on_exit is not None
    with pytest.raises(RuntimeError, match=f"{executable}-1 ended before the flight did"):
        node.on_exit(ProcessExited(f"{executable}-1", 0), context)
    if "recorder" in first:
        text = next(tmp_path.glob("runs/2*/outcome")).read_text()
        sentence = ended_early(f"{executable}-1 ended before the flight did")
        assert parsed_outcome(text) == sentence
    for other in processes.values():  # which the flight, or the launch, has stopped
        assert other.on_exit is not None
        assert not other.on_exit(ProcessExited("other-1", 0), context)


def test_landing_of_the_aircraft_ends_launch_without_error(case: Case, tmp_path: Path) -> None:
    actions, context, first, _ = case
    started = {**nodes(actions), **nodes(all_ready(actions, context))}
    if "aircraft" not in started:
        pytest.skip("this launch file starts no aircraft")
    context.is_shutdown = False
    on_exit = started["aircraft"].on_exit
    assert on_exit is not None
    done = on_exit(ProcessExited("aircraft-1", STATUS_LANDED), context)
    assert ends(done, *started.values())
    left = [parsed_outcome(file.read_text()).end for file in tmp_path.glob("runs/2*/outcome")]
    assert left == ([End.LANDED] if "recorder" in first else [])


def test_node_of_first_stage_that_is_never_ready_ends_launch(case: Case, tmp_path: Path) -> None:
    actions, context, first, _ = case
    timer = every(TimerAction, actions)[-1]
    assert timer.period == 20.0
    (require_ready,) = every(OpaqueFunction, timer.actions)
    for executable in first[:-1]:
        publish(actions, context, f"/{executable}#{PID}")
    with pytest.raises(RuntimeError, match=f"^never flew: {first[-1]} not ready after 20 s$"):
        require_ready.function(context)
    left = [file.read_text() for file in tmp_path.glob("runs/2*/outcome")]
    sentence = never_flew(f"{first[-1]} not ready after 20 s").text()
    assert left == ([sentence] if "recorder" in first else [])
    publish(actions, context, f"/{first[-1]}#{PID}")
    assert require_ready.function(context) is None


TAKEN: tuple[tuple[str, dict[str, str], str], ...] = (
    ("fly", {}, "/y"),
    ("fly", {"recorder": "rosbag2"}, "/y_m"),
    ("fly", {"namespace": "uav1"}, "/uav1/y"),
    ("bridge", {"map": "ardupilot"}, "/y"),
    ("bridge", {"map": "ardupilot", "recorder": "rosbag2", "namespace": "uav1"}, "/uav1/y_m"),
    ("replay", {}, "/y"),
    ("replay", {"reference_model": "true", "topics": "y"}, "/y_m"),
)


@pytest.mark.parametrize("name, given, topic", TAKEN)
def test_another_flight_in_the_domain_ends_launch_before_any_node_starts(
    name: str, given: dict[str, str], topic: str, short: Path, tmp_path: Path
) -> None:
    log = {"run": str(short)} if name == "replay" else {}
    actions, context = begun(name, **given, **log, runs=tmp_path / "runs")
    context.ros_node.publishers[topic] = 1
    assert not every(Node, actions)
    assert not every(ExecuteProcess, actions)
    sentence = f"never flew: ROS_DOMAIN_ID .*: found 1 publishers of {topic} already"
    with pytest.raises(RuntimeError, match=sentence):
        discovered(actions, context)


def test_launch_flies_beside_another_namespace_and_plays_beside_a_reference_model_of_ones_own(
    short: Path, tmp_path: Path
) -> None:
    for name, given in (
        ("fly", {"namespace": "uav1"}),
        ("replay", {"run": str(short), "topics": "/y"}),
    ):
        actions, context = begun(name, **given, runs=tmp_path)
        context.ros_node.publishers["/y_m"] = 1
        assert nodes(discovered(actions, context))


def flown_to(context: LaunchContext, actions: Sequence[Any], instant: float) -> list[Any]:
    """Return the actions that follow when the log has y, y_m and u up to an instant.

    The instant is in s of the system clock.
    """
    sec, nanosec = divmod(nanoseconds(instant), NANOSECONDS)
    context.ros_node.subscriptions["/recorded"](Time(sec=sec, nanosec=nanosec))
    return context.handle(actions)


FLYING = ("recorder", "controller", "aircraft", "reference_model")


def all_matched(
    follow: Sequence[Any], context: LaunchContext, names: Sequence[str] = FLYING
) -> list[Any]:
    """Return the actions that follow when these nodes are matched.

    A node may already fly before this launch has discovered it.
    """
    states = {"aircraft": NodeState.FLYING}
    return [
        action
        for name in names
        for action in publish(
            follow, context, f"/{name}#{PID}", states.get(name, NodeState.MATCHED)
        )
    ]


def test_flight_begins_once_all_are_matched_and_ends_once_log_holds_it(tmp_path: Path) -> None:
    actions, context = started("fly", duration=5, runs=tmp_path)
    follow = all_ready(actions, context)
    assert overrides(nodes(follow)["reference_model"])["start_time"] == -1.0
    assert not any(ends(timer.actions) for timer in every(TimerAction, follow))
    assert not all_matched(follow, context, FLYING[:-1])
    assert not flown_to(context, follow, time.time() + 5.0)
    assert context.ros_node.published == []
    before = time.time()
    timers = every(TimerAction, all_matched(follow, context, FLYING[-1:]))
    ((topic, message),) = context.ros_node.published
    start = stamp_of(message) / NANOSECONDS
    assert topic == "/start"
    # Half a second in which `start` reaches the nodes.
    # It begins on a tenth of a second.
    assert before + 0.4 <= start <= time.time() + 0.6
    assert not flown_to(context, follow, start + 4.9)
    assert not any(timer.is_canceled for timer in timers)
    flight = flown_to(context, follow, start + 5.0)
    assert ends(flight, *nodes(actions).values(), *nodes(follow).values())
    assert all(timer.is_canceled for timer in timers)  # the launch waits for nothing more
    (give_up,) = every(OpaqueFunction, timers[-1].actions)
    assert give_up.function(context) is None
    text = (next(tmp_path.glob("*-osprey_servo")) / "outcome").read_text(encoding="utf-8")
    assert parsed_outcome(text) == COMPLETED


def test_log_that_stops_ends_the_flight_early(tmp_path: Path) -> None:
    actions, context = started("fly", duration=5, runs=tmp_path)
    follow = all_ready(actions, context)
    timers = every(TimerAction, all_matched(follow, context, FLYING))
    ((_, message),) = context.ros_node.published
    assert not flown_to(context, follow, stamp_of(message) / NANOSECONDS + 4.9)
    (give_up,) = every(OpaqueFunction, timers[-1].actions)
    with pytest.raises(
        RuntimeError, match=r"^ended early: the log holds y, y_m and u up to t = 4\.900 of 5 s$"
    ):
        give_up.function(context)


# every argument twice, as two includes in one launch file have them
TWO: dict[str, tuple[dict[str, object], dict[str, object]]] = {
    "fly": (
        {"namespace": "uav1", "duration": 9, "recorder": "rosbag2", "log_level": "warn"},
        {"namespace": "uav2", "duration": 5, "recorder": "true", "log_level": "debug"},
    ),
    "bridge": (
        {"map": "ardupilot", "namespace": "uav1", "recorder": "true", "duration": 3},
        {"map": "ardupilot_mavlink", "namespace": "uav2", "recorder": "true", "duration": ""},
    ),
    "replay": (
        {"namespace": "uav1", "controller": "true", "topics": "/y,/y_m", "rate": "2.0"},
        {"namespace": "uav2", "controller": "true", "topics": "/truth", "rate": "1.0"},
    ),
}


@pytest.mark.parametrize("name", TWO)
def test_each_of_two_includes_has_its_own_arguments(
    name: str, short: Path, osprey_gust: Scenario, tmp_path: Path
) -> None:
    """Launch runs later actions when another include has replaced the configurations."""
    more: dict[str, object] = {"scenario": osprey_gust.path}
    more |= {"run": short} if name == "replay" else {}
    one, other = ({**more, **given, "runs": tmp_path / "runs"} for given in TWO[name])
    context = LaunchContext()
    actions = included(name, context, **one)
    second = included(name, context, **other)
    context.launch_configurations.clear()  # the groups have ended
    for entities, given in ((actions, one), (second, other)):
        first_stage = discovered(entities, context)
        follow = all_ready(first_stage, context, f"/{given['namespace']}")
        assert nodes(first_stage)
        for stage in (first_stage, follow):
            configurations = restored(stage, context)
            assert {key: configurations[key] for key in given} == {
                key: str(value) for key, value in given.items()
            }
            for node in nodes(stage).values():
                assert node.namespace == given["namespace"]
                assert list(node.ros_arguments)[-1] == given.get("log_level", "info")
        if name == "replay":
            assert options(player(follow))["topics"] == given["topics"]


def test_end_of_a_flight_stops_its_own_nodes_and_its_failure_waits_for_the_others(
    tmp_path: Path,
) -> None:
    actions, context = started("fly", duration=5, runs=tmp_path, namespace="uav1")
    second = included("fly", context, duration=9, runs=tmp_path, namespace="uav2")
    second = discovered(second, context)
    failed = nodes(actions)["controller"]
    assert failed.on_exit is not None
    done = failed.on_exit(ProcessExited("controller-1", 1), context)
    assert ends(done, *nodes(actions).values())
    assert not ends(done, *nodes(second).values())
    assert all(timer.is_canceled for timer in every(TimerAction, actions))
    assert not any(timer.is_canceled for timer in every(TimerAction, second))
    follow = all_ready(second, context, "/uav2")
    aircraft = nodes(follow)["aircraft"]
    assert aircraft.on_exit is not None
    with pytest.raises(RuntimeError, match="controller-1 ended before the flight did"):
        aircraft.on_exit(ProcessExited("aircraft-2", STATUS_LANDED), context)
    ended = {parsed_outcome(file.read_text()).end for file in tmp_path.glob("*/outcome")}
    assert ended == {End.ENDED_EARLY, End.LANDED}


def test_flight_around_an_aircraft_and_a_reference_model_of_ones_own(tmp_path: Path) -> None:
    further = tmp_path / "mine.yaml"
    further.write_text("/uav1/controller: {ros__parameters: {k_g: 2.5, delay: 0.01}}\n")
    actions, context = begun(
        "fly",
        runs=tmp_path,
        namespace="uav1",
        aircraft="false",
        reference_model="false",
        params_file=further,
    )
    context.ros_node.publishers |= {"/uav1/y": 1, "/uav1/y_m": 1}  # of one's own nodes
    actions = discovered(actions, context)
    assert nodes(actions).keys() == {"recorder", "controller"}
    follow = all_ready(actions, context, "/uav1")
    assert not nodes(follow)
    file = Path(nodes(actions)["controller"].parameters[0])
    sections = parse_scenario_sections(file.read_bytes(), file)
    assert (sections["controller"]["k_g"], sections["controller"]["delay"]) == (2.5, 0.01)
    recorder = overrides(nodes(actions)["recorder"])
    assert Path(recorder["scenario_file"]) == file  # what flies
    attached = {Path(each).name: Path(each) for each in recorder["attach"]}
    parameters = attached["parameters.yaml"]
    unflown = re.findall(r"^# not started: (\w+), ", parameters.read_text(), re.MULTILINE)
    assert unflown == ["aircraft", "reference_model"]
    assert attached["airframe.yaml"].read_text().startswith("# not started: aircraft, ")
    assert load_scenario(parameters).controller.delay == 0.01  # it can fly again
    with refusing("aircraft: found false in lockstep, expected true"):
        started("fly", runs=tmp_path, aircraft="false", lockstep="true")


def test_refused_params_file_is_named_with_what_it_holds(tmp_path: Path) -> None:
    further = tmp_path / "mine.yaml"
    given = {"runs": str(tmp_path), "params_file": str(further)}
    further.write_text("{/uav1/controller: {ros__parameters: {k_g: 2.5}}}\n")
    with refusing(
        f"{further}: found sections for /uav1/controller, expected a section for a node in /uav2, "
        "as /uav2/controller"
    ):
        started("fly", namespace="uav2", **given)
    further.write_text("{/uav1/controller: {ros__parameters: {kg: 2.5}}}\n")
    with refusing("mine.yaml: controller.kg: unknown key, expected "):
        started("fly", namespace="uav1", **given)


def test_airframe_beside_the_params_file_flies(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    shutil.copy(AIRFRAMES / "osprey.yaml", tmp_path / "mine" / "hawk.yaml")
    further = tmp_path / "mine" / "mine.yaml"
    further.write_text("{/**/aircraft: {ros__parameters: {airframe: hawk.yaml}}}\n")
    actions, _ = started("fly", runs=tmp_path / "runs", params_file=further)
    file = Path(nodes(actions)["controller"].parameters[0])
    assert load_scenario(file).aircraft.airframe == str(tmp_path / "mine" / "hawk.yaml")


def test_rosbag2_is_not_for_lockstep(tmp_path: Path) -> None:
    with refusing("recorder: found rosbag2 in lockstep, expected true"):
        started("fly", recorder="rosbag2", lockstep="true", runs=tmp_path)
    assert not list(tmp_path.iterdir())


def test_bridge_is_dry_run_by_default_and_topics_recorded(tmp_path: Path) -> None:
    actions, context = started("bridge", map="ardupilot", runs=tmp_path)
    bridge = overrides(nodes(all_ready(actions, context))["bridge"])
    assert bridge == {"map": str(LIBRARY / "ardupilot.yaml"), "dry_run": True}
    recorder = overrides(nodes(actions)["recorder"])
    assert set(load_map("ardupilot").topics) <= set(recorder["topics"])
    assert "bridge/would_send" in recorder["topics"]
    assert bridge["map"] in recorder["attach"]
    slow = REPOSITORY / "tests" / "ros" / "slow_autopilot.yaml"
    follow = all_ready(
        *started(
            "bridge",
            map=str(MAP_FILES["ardupilot_2024"]),
            scenario=slow,
            dry_run="false",
            runs=tmp_path,
        )
    )
    assert overrides(nodes(follow)["bridge"])["dry_run"] is False
    assert not every(TimerAction, follow)  # until Ctrl-C


def test_bridge_with_flipped_sign_refused_before_anything_starts(tmp_path: Path) -> None:
    content = yaml.safe_load((LIBRARY / "ardupilot.yaml").read_text())
    content["inputs"]["rudder"] = {**content["inputs"]["rudder"], "sign": -1}
    (tmp_path / "flipped.yaml").write_text(yaml.safe_dump(content))
    with refusing("D of r and rudder is -1, the controller has \\+1"):
        started("bridge", map=tmp_path / "flipped.yaml", runs=tmp_path)
    assert not list(tmp_path.glob("*-osprey_servo"))


def test_limits_beyond_those_of_map_refused_before_anything_sent(tmp_path: Path) -> None:
    """The bridge clips u, and the anti-windup of the law does not know about this."""
    # Thrust from -0.4 to 0.4, the map from -0.2 to 0.3.
    scenario = REPOSITORY / "tests" / "ros" / "slow_autopilot.yaml"
    sentence = (
        r"controller\.lower: found -0\.4, expected at least -0\.2, the lower limit of "
        r"thrust in the map ardupilot"
    )
    with refusing(sentence):
        started("bridge", map="ardupilot", scenario=scenario, dry_run="false", runs=tmp_path)
    with refusing(r"osprey_servo: controller\.lower: found -0\.5"):
        started("bridge", map="ardupilot", dry_run="false", runs=tmp_path)
    assert not list(tmp_path.iterdir())


def player(actions: Sequence[Any]) -> ExecuteProcess:
    (process,) = every(ExecuteProcess, actions)
    return process


def options(process: ExecuteProcess) -> dict[str, Any]:
    """Return the options of `rise-di play` on its command line."""
    executable, command, *words = process.cmd
    assert executable == stand_in.ExecutableInPackage(package="flight_cli", executable="rise-di")
    assert (
        INSTALLED / executable.package / "lib" / executable.package / executable.executable
    ).is_file()
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    with group.commands[command].make_context(command, [*words]) as context:
        return dict(context.params)


@pytest.mark.parametrize(
    "given, topics",
    [
        ({}, "/pose,/truth,/y,/y_m"),  # the controller publishes u and internals
        ({"controller": "false", "aircraft": "true"}, "/internals,/u,/y_m"),
        ({"map": "ardupilot"}, "/truth,/y_m"),  # y is the bridge's
        ({"topics": "y,y_m"}, "y,y_m"),
    ],
    ids=str,
)
def test_topics_without_a_publisher_are_played(
    given: dict[str, str], topics: str, short: Path, osprey_gust: Scenario
) -> None:
    actions, context = started("replay", run=short, scenario=osprey_gust.path, **given)
    values = options(player(all_ready(actions, context, "/one" if "namespace" in given else "")))
    assert values["topics"] == topics
    assert values["run"] == short
    assert (values["rate"], values["start"], values["loop"], str(values["stamps"])) == (
        1.0,
        0.0,
        False,
        "now",
    )


def test_lockstep_is_for_the_controller_alone(short: Path) -> None:
    with refusing("lockstep: found true with aircraft, expected controller and recorder alone"):
        started("replay", run=short, lockstep="true", aircraft="true")

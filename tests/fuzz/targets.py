# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide fuzz targets: every reader of external input, as a function of bytes.

A target returns if the input is read, or rejected with one sentence. It raises any other exception.
`SEEDS` has the initial inputs of each target, made by the writers of the stack.
tests/corpus/<target>/ has the findings.
"""

import asyncio
import atexit
import gc
import json
import logging
import math
import re
import shutil
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from mcap.writer import CompressionType, IndexType, Writer
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from tests.joint_states import JOINT_STATE, parameter_event, vector
from tests.maps import MAP_FILES
from tests.vehicle_logs import write_dataflash, write_tlog, write_ulog
from tests.view_link import NodesInMemory

from aircraft_sim.airframes.airframe import LIBRARY as AIRFRAMES
from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.simulator import Simulator
from autopilot_bridge.bridge import Bridge
from autopilot_bridge.params import load_map
from c_export.constants import exportable, header
from c_export.library import TUNABLE, Units, model_description
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_core.channels import POSE
from flight_core.files import dump_yaml
from flight_core.parameters import ParameterError
from flight_core.vectors import ChannelError, StampedVector
from flight_guidance.guidance import Guidance
from flight_guidance.guidance_state import TARGETS as MODE_TARGETS
from flight_guidance.params import GuidanceConfig
from flight_guidance.routes.route_file import ENDINGS, Origin, read_fence_file, read_route_file
from flight_log.bag import SCENARIO_MEDIA_TYPE, read_metadata_records
from flight_log.named_vectors import decoder, tables
from flight_log.playback import read_playback
from flight_log.repair import repair
from flight_log.rosbag2_metadata import (
    FileContents,
    TopicCount,
    bag_metadata_yaml,
    read_bag_metadata,
)
from flight_log.stored_messages import PARAMETER_EVENT, PARAMETER_EVENTS, parameter_changes
from flight_log.tape_reader import read_run
from flight_log.vehicle_log import read_vehicle_log
from flight_view.control import Control
from flight_view.flight import Flight
from flight_view.request_values import RefusedError
from flight_view.server import ADDRESS, Server, answer
from rise_di_controller.controller import Controller
from rise_di_controller.rise_di_config import RiseDiConfig

MAX_SENTENCE_LENGTH = 2000
"""Characters of an error sentence, however long the input is."""

Target = Callable[[bytes, Path], None]
"""Reads the input; the folder is for its files."""


def rejected(call: Callable[[], object]) -> bool:
    """Return whether the call raises ParameterError, which must have one sentence."""
    try:
        call()
    except ParameterError as error:
        message = str(error)
        if (
            not message.strip()
            or len(message.splitlines()) != 1
            or len(message) > MAX_SENTENCE_LENGTH
        ):
            raise AssertionError(
                f"no sentence: {message[:MAX_SENTENCE_LENGTH]!r} of {len(message)} characters"
            ) from error
        return True
    return False


def mcap(data: bytes, folder: Path) -> None:
    """Read a log as a flight, as messages and as a replay, and then repair it.

    The repaired log must not be damaged.
    """
    run = write_run(folder, data)
    file = run / "run_0.mcap"
    rejected(lambda: read_run(file))
    rejected(lambda: read_playback(file))
    rejected(lambda: _watch(file))
    rejected(lambda: _replay(file))
    if not rejected(lambda: repair(run)) and any(
        repaired.damaged for repaired in repair(run).files
    ):
        raise AssertionError("the repaired log is damaged")


def _watch(file: Path) -> None:
    """Read what the live page gets from a log."""
    flight = Flight(file)
    with np.errstate(all="ignore"):
        flight.update()
        answer(flight, {})


def metadata(data: bytes, folder: Path) -> None:
    """Read metadata.yaml of a bag, and a file of metadata for a bag."""
    run = write_run(folder, _PLAIN)
    (run / "metadata.yaml").write_bytes(data)
    rejected(lambda: read_bag_metadata(run))
    rejected(lambda: read_metadata_records(run / "metadata.yaml"))
    rejected(lambda: read_run(run))
    rejected(lambda: repair(run))


def scenario(data: bytes, folder: Path) -> None:
    """Read a scenario file, up to the controller and the simulator."""
    path = folder / "scenario.yaml"
    path.write_bytes(data)

    def fly() -> None:
        scenario = load_scenario(path)
        with np.errstate(all="ignore"):  # divergence is tested elsewhere
            Controller(scenario.controller)
            if not scenario.aircraft.is_jsbsim:  # which loads a model in a process of its own
                Simulator(scenario.aircraft).sample(0, np.zeros(len(scenario.controller.inputs)))

    rejected(fly)


NAMED = ("q", "V", "p", "r", "elevator", "thrust", "aileron", "rudder")
OUTSIDE = re.compile(r'/\*.*?\*/|"(?:[^"\\\n]|\\.)*"', re.DOTALL)  # comments and strings of C
NUMBER = re.compile(r"-?\b(0x)?[0-9a-f]+(\.[0-9a-f]*)?(p[+-]?\d+)?F?\b")


def export(data: bytes, folder: Path) -> None:
    """Put names of channels, one per line, in the place of NAMED in an airframe and its scenario.

    They are used up to the C code and its FMU. Outside of strings and comments, the code has the
    same tokens as with NAMED. The names reach the code from the files, and also when the check of
    the files is bypassed.
    """
    lines = data.decode("utf-8", "replace").split("\n")
    names = dict(zip(NAMED, lines, strict=False))
    gust = find_scenario("osprey_gust")
    frame = folder / "frame.yaml"
    frame.write_text(
        dump_yaml(_renamed(yaml.safe_load((AIRFRAMES / "osprey.yaml").read_text()), names))
    )
    sections = _renamed(yaml.safe_load(gust.path.read_text()), names)
    sections["/**/aircraft"]["ros__parameters"]["airframe"] = str(frame)
    path = folder / "scenario.yaml"
    path.write_text(dump_yaml(sections))
    rejected(lambda: _check_code(exportable(load_scenario(path).controller)))
    channels = {
        key: tuple(names.get(name, name) for name in getattr(gust.controller, key))
        for key in ("outputs", "inputs")
    }
    _check_code(exportable(gust.controller.model_copy(update=channels)))


def _renamed(tree: Any, names: Mapping[str, str]) -> Any:
    """Return a tree of YAML with other names, as keys and as values."""
    if isinstance(tree, dict):
        return {names.get(key, key): _renamed(value, names) for key, value in tree.items()}
    return (
        [_renamed(value, names) for value in tree]
        if isinstance(tree, list)
        else names.get(tree, tree)
    )


def _check_code(controller: RiseDiConfig) -> None:
    """Check that the code has the tokens of the shipped scenario's, except for the numbers.

    The FMU must have the variables of the channels.
    """
    text = header(controller, "fuzz", float32=False)
    assert "??" not in text  # a trigraph of C
    assert text.isascii()
    assert _tokens(text) == _tokens(
        header(exportable(find_scenario("osprey_gust").controller), "fuzz", float32=False)
    )
    units = Units(("1",) * len(controller.outputs), ("1",) * len(controller.effectors))
    unit = ElementTree.fromstring(model_description(controller, "fuzz", units))
    kinds = Counter(variable.get("causality") for variable in unit.iter("ScalarVariable"))
    assert kinds["parameter"] == len(TUNABLE) * len(controller.outputs)
    assert kinds["input"] == 2 * len(controller.outputs) + 3
    assert kinds["output"] == len(controller.effectors) + 1


def _tokens(text: str) -> list[str]:
    return NUMBER.sub("0", OUTSIDE.sub(" @ ", text)).split()


def airframe(data: bytes, folder: Path) -> None:
    """Read an airframe file, up to its matrices."""
    path = folder / "airframe.yaml"
    path.write_bytes(data)

    def matrices() -> None:
        frame = load_airframe(str(path))
        with np.errstate(all="ignore"):
            frame.matrix_c() @ frame.matrix_b()
        frame.matrix_a(), frame.matrix_gravity(), frame.products()

    rejected(matrices)


def channel_map(data: bytes, folder: Path) -> None:
    """Read a channel map, up to its bridge."""
    path = folder / "map.yaml"
    path.write_bytes(data)

    def bridge() -> None:
        new_bridge = Bridge(load_map(str(path)), dry_run=False)
        new_bridge.engage(0), new_bridge.raw(), new_bridge.raw_u()

    rejected(bridge)


def message(data: bytes, folder: Path) -> None:
    """Read the payload of a message as a log's reader does, alone and between valid ones."""
    for messages in ([data], [_SAMPLE, data, _SAMPLE]):
        decode = decoder(JOINT_STATE)
        assert decode is not None
        for table in tables(messages):
            decode(table)
    run = write_run(
        folder, log([("/y", JOINT_STATE, data), (PARAMETER_EVENTS, PARAMETER_EVENT, data)])
    )
    rejected(lambda: read_run(run))
    rejected(lambda: read_playback(run))
    rejected(lambda: parameter_changes(run, "/controller", RiseDiConfig.model_fields))


def route(data: bytes, folder: Path) -> None:
    """Read a route or fence file with each reader."""
    for ending in ENDINGS:
        path = folder / f"route{ending}"
        path.write_bytes(data)
        rejected(lambda path=path: read_route_file(path, Origin(47.4, 8.5), 30.0, 5.0))  # type: ignore[misc]  # bound in the loop
        rejected(lambda path=path: read_fence_file(path, Origin(47.4, 8.5), 30.0))  # type: ignore[misc]  # likewise


def vehicle_log(data: bytes, folder: Path) -> None:
    """Read the log of an autopilot.

    It is decoded here, while `rise-di import` decodes it in an isolated process.
    """
    path = folder / "vehicle.log"
    path.write_bytes(data)
    rejected(lambda: read_vehicle_log(path))
    # pymavlink leaves a damaged file open: Python warns here, and not in the middle of another test
    gc.collect()


def targets(data: bytes, folder: Path) -> None:
    """Give guidance poses, y and targets as 64 bit numbers.

    What a step commands must be finite and within its slew limits. After a time without steps
    beyond the age limit of u_m, guidance starts again at what is measured, and no limit applies
    across it.
    """
    guidance = Guidance(_guided())
    params = _guided().params()
    now_ns = 0
    before = None
    before_ns = 0
    values = [
        value
        for (value,) in struct.iter_unpack("<d", data[: len(data) // 8 * 8])
        if math.isfinite(value)
    ]
    while len(values) > GUIDED_NUMBERS:
        part = values[:GUIDED_NUMBERS]
        values = values[GUIDED_NUMBERS:]
        now_ns += params.period_ns
        with suppress(ChannelError):
            guidance.take_pose(StampedVector(now_ns, np.array(part[: len(POSE)])), now_ns)
            guidance.take_y(StampedVector(now_ns, np.array(part[len(POSE) :][:4])), now_ns)
        with suppress(ChannelError):
            guidance.take_target({MODES[int(abs(part[-2]) % len(MODES))]: part[-1]})
        if (output := guidance.step(now_ns, now_ns)) is None:
            continue
        assert np.isfinite(output.u_m).all(), output.u_m
        if before is not None and now_ns - before_ns <= params.max_age_ns:
            V = params.outputs.index("V")
            steps = np.delete(np.abs(output.u_m - before)[:4], V)
            assert (
                steps
                <= np.delete(params.slew, V) * (now_ns - before_ns) / 1e9 * (1.0 + 1e-9) + 1e-12
            ).all(), steps
        before = output.u_m
        before_ns = now_ns


def control(data: bytes, folder: Path) -> None:
    """Send the body of a request that commands a flight from its page."""
    loop, _, desk, _ = _page()
    try:
        request = json.loads(data)
    except (ValueError, RecursionError):
        return
    sentence = "no refusal"
    try:
        json.dumps(loop.run_until_complete(desk.answer(request, KEY, "")))
    except RefusedError as error:
        sentence = error.sentence
    assert sentence.strip()
    assert len(sentence) < MAX_SENTENCE_LENGTH


def page(data: bytes, folder: Path) -> None:
    """Send bytes to the server of the page.

    It must log no exception, and answer the next browser.
    """
    loop, server, _, failed = _page()
    loop.run_until_complete(_exchange(server, data.replace(b"PORT", str(server.port).encode())))
    assert not failed, failed.pop()


async def _exchange(server: Server, data: bytes) -> None:
    reader, writer = await asyncio.open_connection(ADDRESS, server.port)
    writer.write(data)
    with suppress(TimeoutError, ConnectionError):
        # the answer to a whole request takes 2 ms
        await asyncio.wait_for(reader.read(1 << 16), 0.02)
    writer.close()
    with suppress(ConnectionError):
        await writer.wait_closed()


KEY, TOKEN = "ABCD-EFGH", "a-token"
GUIDED_NUMBERS = len(POSE) + 6
# an orbit takes three together
MODES = [name for name in MODE_TARGETS if name not in {"north", "east", "radius"}]


@lru_cache(maxsize=1)
def _guided() -> GuidanceConfig:
    guidance = find_scenario("osprey_route").guidance
    assert guidance is not None
    return guidance


@lru_cache(maxsize=1)
def _page() -> tuple[asyncio.AbstractEventLoop, Server, Control, list[str]]:
    """Return a server with control of nodes in memory, its event loop, and its exceptions.

    These are the exceptions that it has logged.
    """
    folder = Path(tempfile.mkdtemp(prefix="fuzz"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    run = write_run(folder, log(_flight()))
    scenario = find_scenario("osprey_servo")
    loop = asyncio.new_event_loop()
    times = count()
    flight = Flight(run)
    flight.update()
    nodes = NodesInMemory(scenario, "aircraft", "controller", "guidance", dry_run=True)
    # each request has its allowance, and a new lease
    desk = Control(flight, nodes, KEY, now=lambda: 10.0 * next(times))
    failed: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: failed.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("tornado.application").addHandler(handler)

    async def start() -> Server:
        server = Server([flight], TOKEN, desk)
        server.listen(0)
        return server

    return loop, loop.run_until_complete(start()), desk, failed


TARGETS: Mapping[str, Target] = {
    "mcap": mcap,
    "metadata": metadata,
    "scenario": scenario,
    "airframe": airframe,
    "export": export,
    "map": channel_map,
    "message": message,
    "route": route,
    "vehicle_log": vehicle_log,
    "targets": targets,
    "control": control,
    "page": page,
}


def write_run(folder: Path, content: bytes) -> Path:
    """Return the folder of a run that has only this log."""
    run = folder / "run"
    run.mkdir(exist_ok=True)
    for file in run.iterdir():
        file.unlink()
    (run / "run_0.mcap").write_bytes(content)
    return run


def _replay(file: Path) -> None:
    recorded = read_run(file)
    if recorded.scenario is not None:
        with np.errstate(all="ignore"):
            replay(recorded)


def log(
    messages: Sequence[tuple[str, str, bytes]],
    packed: CompressionType = CompressionType.NONE,
    attached: Mapping[str, bytes] = {},
    *,
    checked: bool = False,
    chunked: bool = True,
    indexed: bool = True,
) -> bytes:
    """Return an MCAP file of (topic, type, payload), 1 ms apart.

    By default it has no checksums, because they would reveal a changed byte.
    """
    stream = BytesIO()
    index = IndexType.ALL if indexed else IndexType.NONE
    writer = Writer(
        stream,
        1024,
        packed,
        index,
        use_chunking=chunked,
        enable_crcs=checked,
        enable_data_crcs=checked,
    )
    writer.start(profile="ros2", library="fuzz")
    channels: dict[str, int] = {}
    for name, content in attached.items():
        writer.add_attachment(0, 0, name, SCENARIO_MEDIA_TYPE, content)
    for k, (topic, kind, data) in enumerate(messages):
        if topic not in channels:
            schema = writer.register_schema(kind, "ros2msg", b"std_msgs/Header header\n")
            channels[topic] = writer.register_channel(
                topic, "cdr", schema, {"offered_qos_profiles": "- depth: 1\n"}
            )
        writer.add_message(channels[topic], 1_000_000 * k, data, 1_000_000 * k, k)
    writer.add_metadata("rise_di_lost", {"/y": "1"})
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


_EVENT = parameter_event("/controller", {"k_g": 2.5}, stamp_ns=5)
_SAMPLE = vector(1_000_000, ("q", "V"), (0.5, -1.0), "/aircraft#1")
_PLAIN = log(
    [("/y", JOINT_STATE, vector(2_000_000 * k, ("q", "V"), (0.1 * k, -k), "a")) for k in range(8)]
)
FLIGHT = {
    "/y": ("q", "V"),
    "/y_m": ("q", "V"),
    "/u": ("elevator", "thrust"),
    "/truth": ("t", "x.q"),
}


def _flight() -> list[tuple[str, str, bytes]]:
    messages = [
        (topic, JOINT_STATE, vector(10_000_000 * k, names, (0.01 * k, 0.1 * k), "/n"))
        for k in range(6)
        for topic, names in FLIGHT.items()
    ]
    return [*messages, (PARAMETER_EVENTS, PARAMETER_EVENT, _EVENT)]


def _mcaps() -> list[bytes]:
    flight = _flight()
    file = {"osprey.yaml": b"/**/flight:\n  ros__parameters: {duration: 1.0}\n"}
    content = log(flight, attached=file)
    return [
        content,
        content[: len(content) // 2],
        log(flight, CompressionType.ZSTD, checked=True),
        log(flight, CompressionType.LZ4),
        log(flight, chunked=False),
        log(flight, indexed=False),
        _PLAIN,
    ]


def _metadata() -> list[bytes]:
    count = TopicCount("/y", JOINT_STATE, "RIHS01_0", "- depth: 1\n", 8)
    return [
        bag_metadata_yaml([FileContents("run_0.mcap", 0, 7_000_000, (count,))]).encode(),
        b"rise_di_flight: {start: a, command: b}\n",
    ]


def _files(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(folder.glob("*.yaml"))]


_ROUTES = [
    (
        b"route: [[0, 0, 120], [500.5, -2, 130, 25.0], {latitude: 47.4, longitude: 8.5, altitude: "
        b"500, V: 25}]\n"
    ),
    b'{"type": "LineString", "coordinates": [[8.5, 47.4, 500], [8.51, 47.4, 510.5]]}',
    (
        b'{"features": [{"properties": {"V": 25}, "geometry": {"type": "Point", "coordinates": '
        b"[8.5, 47.4, 500]}}]}"
    ),
    b"<kml><Point><altitudeMode>absolute</altitudeMode><coordinates>8.5,47.4,500</coordinates></Point></kml>",
    (
        b'{"fileType": "Plan", "geoFence": {"polygons": [{"polygon": [[47.4, 8.5], [47.41, 8.5], '
        b"[47.4, 8.51]]}]}}"
    ),
]

HOSTILE_NAME = (
    'q*/ __attribute__((constructor)) static void f(void) {} /*\nV", '
    '"\np\\\nr??/\n<e>&"\'\nx y\n\u00e9\n*/'
)

_HEAD = b"GET / HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\nX-Page-Token: a-token\r\n\r\n"
_REQUESTS = [
    _HEAD,
    _HEAD.replace(b"/ ", b"/data/0?epoch=0.0&y=3&state=ended ", 1),
    _HEAD.replace(b"GET / ", b"POST /control ").replace(
        b"\r\n\r\n",
        b"\r\nOrigin: http://127.0.0.1:PORT\r\nContent-Type: application/json\r\nX-Control-Key: "
        b"ABCD-EFGH\r\n"
        b'Content-Length: 14\r\n\r\n{"do":"state"}',
    ),
]
_BODIES = [
    {"do": "state"},
    {"do": "gains", "values": {"k_g": 2.0}, "digest": "0"},
    {"do": "check", "values": {"k_g": 2.0, "beta": [1.0, 2.0, 3.0, 4.0]}},
    {
        "do": "fault",
        "values": {"actuators.faults": ["elevator stuck 2"], "sensors.dropout": 0.1},
    },
    {"do": "gust", "axis": "vertical", "speed": 10.0, "length": 15.0},
    {"do": "target", "values": {"heading": 1.0, "altitude": 100.0}},
    {"do": "route", "points": [[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]]},
    {"do": "engage", "map": "px4"},
]


def _numbers() -> list[bytes]:
    level = [0.1, 0.0, 1.0, 0.0, 0.0, 100.0, 25.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0]
    return [
        struct.pack(f"<{4 * GUIDED_NUMBERS}d", *[*level, float(k), 1.0] * 4)
        for k in range(len(MODES))
    ]


def _vehicle_logs() -> list[bytes]:
    """Return a log of each kind, with a rate gyro alone."""
    stamps = range(0, 400_000, 20_000)
    rates = [(stamp, (0.1, -0.2, 0.3)) for stamp in stamps]
    packets = [
        (stamp, mavlink.MAVLink_attitude_message(stamp // 1000, *[0.1] * 6)) for stamp in stamps
    ]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / name for name in ("a.bin", "a.ulg", "a.tlog")]
        write_dataflash(
            paths[0],
            {"IMU": (("GyrX", "GyrY", "GyrZ"), rates)},
            {"RC1_MIN": 1100.0},
            "ArduPlane V4.6.0 (1f2e3d4c)",
        )
        write_ulog(
            paths[1],
            {"vehicle_angular_velocity": ("float[3] xyz", rates)},
            {"FW_AIRSPD_TRIM": 15.0},
        )
        write_tlog(paths[2], packets)
        return [path.read_bytes() for path in paths]


SEEDS: Mapping[str, Callable[[], list[bytes]]] = {
    "mcap": _mcaps,
    "metadata": _metadata,
    "scenario": lambda: _files(LIBRARY),
    "airframe": lambda: _files(AIRFRAMES),
    "export": lambda: ["\n".join(NAMED).encode(), HOSTILE_NAME.encode()],
    "map": lambda: [path.read_bytes() for path in MAP_FILES.values()],
    "message": lambda: [_SAMPLE, _EVENT, vector(1, (), ())],
    "route": lambda: _ROUTES,
    "vehicle_log": _vehicle_logs,
    "targets": _numbers,
    "control": lambda: [json.dumps(body).encode() for body in _BODIES],
    "page": lambda: _REQUESTS,
}

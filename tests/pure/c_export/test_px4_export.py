# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di export --px4`: what the module decides, in a host build without PX4.

Its C++ is compiled with a stub of PX4's headers.
"""

import ctypes
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import yaml
from pytest import approx
from tests.conftest import REPOSITORY, refusing

from c_export.autopilots import AXES, SAMPLES, SHELLS, write_module
from c_export.constants import exportable
from c_export.events import flight_recordings
from c_export.proof import FLAGS, PARAMETERS, build, write_code
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_cli.export import Export
from flight_design.identification.module_log import STATUS, module_flight
from flight_log.vehicle_tables import MessageTable, VehicleLog
from rise_di_controller.internals import Saturation
from rise_di_controller.params import ControllerConfig

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="no gcc on this machine, which compiles the exported code"
)
MODULE = SHELLS["px4"].place
EXAMPLE = REPOSITORY / "examples" / "px4_airplane"
RATES = EXAMPLE / "rates.yaml"
OBSERVER = EXAMPLE / "rates_observer.yaml"
PERIOD_US = 4000
MEASURING = 252  # cycles until the rate of the samples is known, 1 s and the first
DWELL = 250  # cycles without a fault before a return, 1 s
WARNINGS = ("-Wshadow", "-Wfloat-equal", "-Wdouble-promotion")  # of PX4
(
    FLIES,
    OFF,
    NOT_ARMED,
    NO_RATES,
    LANDED,
    STALE_RATES,
    STALE_SETPOINT,
    NO_NUMBER,
    REFUSED,
    FAILSAFE,
    DIVERGED,
    _,
    SLOW,
    SILENT,
    WRONG_AGE,
    WRONG_ERROR,
    WRONG_HOLD,
    WAITS,
) = range(18)


STAMPS = ("setpoint", "spare")
VECTORS = ("rates", "setpoint", "setpoint_thrust", "spare", "spare_thrust")


class Cycle(ctypes.Structure):
    """rise_di_cycle."""

    _fields_ = (
        *((f"{name}_us", ctypes.c_uint64) for name in ("now", "rates", "filter", *STAMPS)),
        *((name, ctypes.c_bool) for name in ("enabled", "armed", "has_rates", "landed")),
        *((name, 3 * ctypes.c_float) for name in VECTORS),
        *((name, ctypes.c_float) for name in ("airspeed", "max_age", "max_error", "hold")),
    )


WRAPPER = """
#include "rise_di_rates.c"
unsigned long host_bytes(void) { return sizeof(rise_di_rates); }
int host_run(rise_di_rates *rates, const rise_di_cycle *cycle, float *torque, double *values) {
    (void)rise_di_rates_run(rates, cycle);
    for (int k = 0; k < 3; k++) {
        torque[k] = rates->torque[k];
        values[k] = (double)rates->y_m[k];
        values[3 + k] = (double)rates->controller.u[k];
        values[6 + k] = (double)rates->controller.y[k];
        values[9 + k] = (double)rates->controller.y_m[k];
        values[12 + k] = (double)rates->controller.law.e[k];
        values[15 + k] = (double)rates->u_end[k];
    }
    values[18] = (double)rates->y_m_offset;
    values[19] = (double)rates->number;
    values[20] = (double)rates->y_us;
    return (int)rates->refusal;
}
"""


class Shell:
    """The decisions of the module, with a clock of its own and one cycle per period."""

    def __init__(self, library: Path) -> None:
        self._library = ctypes.CDLL(str(library))
        self._library.host_bytes.restype = ctypes.c_ulong
        self._memory = ctypes.create_string_buffer(self._library.host_bytes())
        self._library.rise_di_rates_start(self._memory)
        self.now_us = 1_000_000
        self.period_us = PERIOD_US
        self.torque = np.zeros(3, dtype=np.float32)
        self.values = np.zeros(21)  # y_m, u; then what rise_di_status has
        self.spare = (0.1, -0.2, 0.05)
        self.fly(MEASURING, enabled=False)

    def run(self, **changes: object) -> int:
        """Run a cycle in which RISE-DI has all it needs, except for `changes`.

        Return the refusal.
        """
        self.now_us += self.period_us
        stamps = dict.fromkeys(("rates_us", "setpoint_us", "spare_us"), self.now_us)
        switches = dict.fromkeys(("enabled", "armed", "has_rates"), True)
        cycle = Cycle(
            now_us=self.now_us,
            **stamps,
            **switches,
            max_age=0.02,
            max_error=3.0,
            hold=0.5,
            airspeed=11.5,
        )
        cycle.spare = (3 * ctypes.c_float)(*self.spare)
        for name, value in changes.items():
            setattr(
                cycle, name, (3 * ctypes.c_float)(*value) if isinstance(value, tuple) else value
            )
        pointers = (ctypes.c_void_p(array.ctypes.data) for array in (self.torque, self.values))
        return int(self._library.host_run(self._memory, ctypes.byref(cycle), *pointers))

    def fly(self, cycles: int, **changes: object) -> list[int]:
        """Return the refusals of some cycles."""
        return [self.run(**changes) for _ in range(cycles)]


@pytest.fixture(scope="module", params=[OBSERVER, RATES], ids=["double", "float"])
def folder(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """Return the module with an observer and limits of u_o in double, or without one in float."""
    folder = tmp_path_factory.mktemp("px4")
    write_module("px4", find_scenario(str(request.param)), folder, float32=request.param == RATES)
    return folder


@pytest.fixture(scope="module")
def library(folder: Path) -> Path:
    module = folder / MODULE
    (module / "host.c").write_text(WRAPPER)
    command = [
        "gcc",
        *FLAGS,
        *WARNINGS,
        "-Wconversion",
        "-fPIC",
        "-shared",
        "-o",
        "host.so",
        "host.c",
        "rise_di.c",
    ]
    build(command, module)
    (module / "host.c").unlink()
    return module / "host.so"


@pytest.fixture
def shell(library: Path) -> Shell:
    return Shell(library)


def test_spare_flies_until_all_is_ready(shell: Shell) -> None:
    """The torque of the spare passes through in the same cycle, to the bit."""
    for changes, refusal in (
        ({"enabled": False}, OFF),
        ({"armed": False}, NOT_ARMED),
        ({"has_rates": False}, NO_RATES),
        ({"landed": True}, LANDED),
        ({"setpoint_us": 1}, STALE_SETPOINT),
        ({"rates_us": 1}, STALE_RATES),
        ({"rates": (0.0, float("nan"), 0.0)}, NO_NUMBER),
        ({"setpoint": (float("inf"), 0.0, 0.0)}, NO_NUMBER),
    ):
        assert shell.fly(3, **changes) == [refusal] * 3
        assert (shell.torque == np.array(shell.spare, dtype=np.float32)).all()
    assert shell.fly(DWELL) == [WAITS] * (DWELL - 1) + [FLIES]


def test_takes_over_from_the_torque_of_the_spare(shell: Shell) -> None:
    shell.fly(500, enabled=False)
    assert shell.run() == FLIES
    assert shell.torque == approx(shell.spare, abs=0.02)
    # u in rad, q p r
    assert shell.values[3:6] == approx(0.261799 * shell.torque[[1, 0, 2]], rel=1e-6)


@pytest.mark.parametrize(
    "changes, refusal, latches",
    [
        ({"armed": False}, NOT_ARMED, False),
        ({"has_rates": False}, NO_RATES, False),
        ({"landed": True}, LANDED, False),
        ({"rates_us": 1_000_001}, STALE_RATES, False),
        ({"setpoint_us": 1_000_001}, STALE_SETPOINT, False),
        ({"rates": (float("nan"), 0.0, 0.0)}, NO_NUMBER, False),
        ({"rates": (0.0, 3.5, 0.0)}, DIVERGED, True),
    ],
)
def test_falls_back_in_the_same_cycle(
    shell: Shell, changes: dict[str, object], refusal: int, latches: bool
) -> None:
    """The difference then fades. A fault stays until RISE-DI is switched off."""
    shell.fly(100, enabled=False)
    assert set(shell.fly(50, setpoint=(0.3, 0.2, 0.1))) == {FLIES}
    before = shell.torque.copy()
    assert shell.run(**changes) == refusal
    assert shell.torque == approx(before, abs=1e-6)  # no jump
    assert np.abs(before - shell.spare).max() > 0.02
    shell.fly(1000, armed=False)
    assert shell.torque == approx(shell.spare, abs=1e-4)
    assert shell.run() == (refusal if latches else FLIES)  # a second has passed
    shell.run(enabled=False)
    assert shell.run() == FLIES


def test_samples_that_stop_are_told_by_their_age(shell: Shell) -> None:
    """The cycles continue without samples.

    The spare flies when the samples are older than the limit of 0.02 s.
    """
    shell.fly(20)
    stamp_us = shell.now_us
    refusals = shell.fly(10, rates_us=stamp_us)
    assert refusals == [FLIES] * 5 + [STALE_RATES] * 5


def test_y_is_of_the_instant_before_the_filters_of_the_rates(shell: Shell) -> None:
    """The delay of the filters is taken into account when y is compared with y_m.

    So the rates themselves follow the reference, and not what the filters leave of them.
    """
    shell.fly(20, filter_us=5600)
    assert shell.values[20] == shell.now_us - 5600


def test_reference_follows_the_setpoint(shell: Shell) -> None:
    """y_m is the one in Python at the instants of the periods, for any faster rates.

    After a pause it starts again.
    """
    shell.fly(300, setpoint=(0.3, -0.2, 0.1), rates=(0.3, -0.2, 0.1), enabled=False)
    assert shell.values[:3] == approx([-0.2, 0.3, 0.1], abs=1e-3)  # q, p, r
    shell.now_us += 2_000_000
    shell.run(setpoint=(0.3, -0.2, 0.1), enabled=False)
    shell.run(setpoint=(0.3, -0.2, 0.1), enabled=False)
    assert 0.0 < np.abs(shell.values[:3]).max() < 0.05


def test_torque_follows_the_dynamic_pressure(library: Path) -> None:
    """At twice the airspeed, the same error gives a quarter of the torque.

    Without an airspeed there is no scale.
    """
    rise = {}
    for airspeed in (8.0, 11.5, 16.0, float("nan"), 0.0):
        shell = Shell(library)
        shell.spare = (0.0, 0.0, 0.0)
        shell.fly(500, enabled=False, airspeed=airspeed)
        shell.fly(10, setpoint=(0.1, 0.0, 0.0), airspeed=airspeed)
        rise[airspeed] = float(shell.torque[0])
    unscaled = rise.pop(0.0)
    for airspeed, torque in rise.items():
        ratio = 1.0 if np.isnan(airspeed) else 11.5 / airspeed
        assert torque == approx(unscaled * ratio**2, rel=1e-4)
    assert unscaled > 0.0


def test_limits_are_those_of_the_torque(library: Path) -> None:
    """In slow flight, a torque of 1 is reached at a smaller u.

    The law stops there and does not wind up.
    """
    shell = Shell(library)
    shell.fly(400, setpoint=(5.0, 0.0, 0.0), airspeed=8.0, max_error=30.0)
    assert shell.torque[0] == 1.0
    assert shell.values[4] == approx(0.261799 * (8.0 / 11.5) ** 2, rel=1e-6)


def test_compiles_beside_a_stub_of_px4(folder: Path, tmp_path: Path) -> None:
    module = folder / MODULE
    source = (module / "RiseDiControl.cpp").read_text()
    for header in re.findall(r"#include <(.*)>", source):
        (tmp_path / header).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / header).write_text('#include "px4.h"\n')
    if shutil.which("g++") is None:
        pytest.skip("no g++ on this machine")
    flags = ["-std=gnu++14", "-Wall", "-Wextra", "-Werror", "-Wno-unused-parameter", *WARNINGS]
    stub = REPOSITORY / "tests" / "px4"
    build(
        [
            "g++",
            *flags,
            f"-I{tmp_path}",
            f"-I{stub}",
            "-c",
            "-o",
            str(tmp_path / "o"),
            "RiseDiControl.cpp",
        ],
        module,
    )


def test_parameters_and_topics_are_those_of_the_source(folder: Path) -> None:
    module = folder / MODULE
    source = (module / "RiseDiControl.cpp").read_text()
    yaml = (module / "module.yaml").read_text()
    names = set(re.findall(r"px4::params::(RDI_\w+)", source))
    assert names == set(re.findall(r"^        (RDI_\w+):", yaml, re.MULTILINE))
    assert all(len(name) <= 16 for name in names)
    message = (folder / "msg" / "RiseDiStatus.msg").read_text()
    fields = re.findall(r"^(?:uint|float)\S+ ([a-z_]+)", message, re.MULTILINE)
    assert set(re.findall(r"\tstatus\.(\w+)", source)) == set(fields)


def test_bounds_of_the_parameters_are_those_that_the_module_keeps(folder: Path) -> None:
    module = folder / MODULE
    header = (module / "rise_di_rates.h").read_text("utf-8")
    group = yaml.safe_load((module / "module.yaml").read_text("utf-8"))["parameters"][0]
    for name, words in (("RDI_MAX_AGE", "MAX_AGE"), ("RDI_MAX_ERR", "MAX_ERROR")):
        bounds = re.findall(rf"RISE_DI_{words}_(?:LEAST|LARGEST) ([\d.]+)f", header)
        definition = group["definitions"][name]
        assert [float(bound) for bound in bounds] == [definition["min"], definition["max"]]


def quadrotor(folder: Path, **changes: str) -> Scenario:
    """Return rates of a multicopter: the airplane's, with torques about the axes as inputs."""
    inputs = {"elevator": "pitch", "aileron": "roll", "rudder": "yaw"} | changes
    airframe = "name: quad\nsource: made up\nstates: {q: rad/s, p: rad/s, r: rad/s}\ninputs:\n"
    for name, effect in zip(inputs.values(), ("nose up", "roll right", "nose right"), strict=True):
        airframe += f"  {name}: {{unit: '1', positive: {effect}}}\n"
    airframe += "outputs: [q, p, r]\nA: [[-1, 0, 0], [0, -1, 0], [0, 0, -1]]\n"
    airframe += "B: [[110, 0, 0], [0, 110, 0], [0, 0, 12]]\n"
    (folder / "quad.yaml").write_text(airframe)
    text = RATES.read_text("utf-8")
    text = re.sub(r"    feedforward:.*?(?=/\*\*/recorder)", "", text, flags=re.DOTALL)
    text = re.sub(r"airframe: \S+", f"airframe: {folder / 'quad.yaml'}", text)
    for name, replacement in inputs.items():
        text = text.replace(name, replacement)
    (folder / "scenario.yaml").write_text(text)
    return find_scenario(str(folder / "scenario.yaml"))


def test_spare_is_that_of_the_vehicle(tmp_path: Path) -> None:
    """A multicopter has no trim speed and torques as inputs. Its spare is mc_rate_control."""
    words = {"fixed": ("fw_rate_control", "virtual_fw"), "quad": ("mc_rate_control", "virtual_mc")}
    scenarios = {"fixed": find_scenario(str(RATES)), "quad": quadrotor(tmp_path)}
    for (name, expected), absent in zip(words.items(), reversed(words.values()), strict=True):
        target = tmp_path / name
        write_module("px4", scenarios[name], target, float32=False)
        start = f"{expected[0]} stop\n{expected[0]} start vtol\nrise_di_control start\n"
        assert (target / "extras.txt").read_text() == start
        topics = (target / "logger_topics.txt").read_text().splitlines()
        # at every sample: what the replay and `tune` need
        assert {"rise_di_status", "vehicle_angular_velocity", "vehicle_torque_setpoint"} < {*topics}
        text = "".join(path.read_text() for path in target.rglob("*") if path.is_file())
        for word in expected:
            assert word in text
        for word in absent:
            assert word not in text


def test_vehicle_that_is_neither_is_refused(tmp_path: Path) -> None:
    mixed = quadrotor(tmp_path, rudder="rudder")
    with refusing("aircraft.airframe: found 0 m/s with the inputs pitch, roll, rudder, expected"):
        write_module("px4", mixed, tmp_path / "px4", float32=False)
    with refusing(r"expected a trim speed with surfaces as inputs \(fixed wing\)$"):
        write_module("ardupilot", quadrotor(tmp_path), tmp_path / "plane", float32=False)


def test_flight_needs_no_more_samples_than_the_module_keeps(folder: Path) -> None:
    """The u of the flight is the same as with the 100 samples of the stack."""
    assert f"RISE_DI_SAMPLES {SAMPLES} " in (folder / MODULE / PARAMETERS).read_text("utf-8")
    flight = find_scenario(str(RATES), 4.0)
    sets = [exportable(flight.controller)]
    few, many = (next(flight_recordings(flight, sets, size)) for size in (SAMPLES, 100))
    assert few.reals.tobytes() == many.reals.tobytes()
    with refusing("samples: found 3, expected 4 or more"):
        write_code(sets[0], "rates", folder / "few", float32=False, samples=3)


def test_refuses_what_no_rate_controller_is(tmp_path: Path) -> None:
    def refused(scenario: Scenario, words: str) -> None:
        with refusing(words):
            write_module("px4", scenario, tmp_path, float32=False)

    rates = find_scenario(str(RATES))
    refused(
        find_scenario("osprey_servo"),
        r"^controller\.outputs: found q, p, r, V, expected some of p, q, r",
    )
    refused(
        rates.vary(aircraft={"actuators": {"upper": []}}),
        r"^aircraft\.actuators\.upper: found no end stop of elevator",
    )
    with pytest.raises(typer.BadParameter, match="--c FOLDER, --px4 FOLDER or"):
        Export(scenario="osprey_servo").execute()
    assert set(AXES) == set("pqr")


def flown_table(shell: Shell, controller: ControllerConfig) -> MessageTable:
    """Return rise_di_status of a flight.

    The rates come at twice the rate of the law, with jitter, slow and fast, and with a hand-back of
    0.2 s.
    """
    rng = np.random.default_rng(7)
    shell.period_us = PERIOD_US // 2
    shell.fly(2 * MEASURING, enabled=False)
    rows: list[dict[str, Any]] = []
    for k in range(2400):
        shell.now_us += int(rng.integers(-300, 300))
        t = 0.002 * k
        speed = 10.0 + 0.5 * np.sin(t) if k % 50 == 0 else rows[-1]["airspeed"] if rows else 11.5
        setpoint = tuple(0.3 * np.sin(3.0 * t + np.arange(3.0)))
        rates = tuple(0.8 * np.array(setpoint) + 0.05 * rng.normal(size=3))
        rates = tuple(2.0 + rate for rate in rates) if 900 < k < 1200 else rates  # into the limits
        enabled = not 1500 <= k < 1600
        refusal = shell.run(
            setpoint=setpoint,
            rates=rates,
            airspeed=speed,
            enabled=enabled,
            max_error=30.0,
            filter_us=5600,
        )
        rows.append({"refusal": refusal, "airspeed": speed, "now": shell.now_us})
        rows[-1]["values"] = shell.values.copy()
    values = np.array([row["values"] for row in rows])
    now_us = np.array([row["now"] for row in rows])
    places = {"y": 6, "y_m": 9, "e": 12, "u": 3, "u_end": 15}
    fields = {f"{name}[{i}]": values[:, k + i] for name, k in places.items() for i in range(3)}
    fields |= {"y_m_offset": values[:, 18], "number": values[:, 19]}
    fields |= {
        "timestamp_sample": values[:, 20],
        "refusal": np.array([row["refusal"] for row in rows]),
    }
    fields |= {"parameters": np.full(len(rows), float(controller.digest()))}
    return MessageTable(1000 * now_us, fields)


def test_log_of_the_module_replays_to_the_bit(shell: Shell, folder: Path) -> None:
    """Python computes the u of each tick from rise_di_status alone.

    It takes y, y_m and the limits from it. After a gap in the log, it begins again with the next
    engagement.
    """
    controller = find_scenario(str(OBSERVER)).controller
    table = flown_table(shell, controller)
    log = VehicleLog("a ULog", {STATUS: table}, {}, None)
    if "RISE_DI_FLOAT32 1" in (folder / MODULE / PARAMETERS).read_text("utf-8"):
        with refusing("found u of --float32"):
            module_flight(log, controller)
        return
    flight = module_flight(log, controller)
    ticks = len(flight.tape["internals"].stamp_ns)
    assert 1000 < ticks < 1200  # of 2400 cycles the law steps in every other one
    assert flight.equal == ticks
    assert flight.lost == 0
    limits = flight.tape["internals"].group("limited").values
    assert (limits == Saturation.MAGNITUDE).sum() > 100
    assert len(flight.changes) > 20  # of the airspeed
    replayed = replay(flight.tape, controller, changes=[change.values for change in flight.changes])
    assert replayed.is_equal()
    assert replayed.checked.sum() == ticks - 2  # the engagements
    keep = np.ones(len(table.stamp_ns), dtype=bool)
    keep[700:710] = False
    fields = {name: values[keep] for name, values in table.fields.items()}
    log = VehicleLog("a ULog", {STATUS: MessageTable(table.stamp_ns[keep], fields)}, {}, None)
    part = module_flight(log, controller)
    assert part.lost > 90  # of the 100 up to the engagement
    assert part.equal == len(part.tape["internals"].stamp_ns)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"parameters": 5.0}, "found 000000000005, expected"),
        ({"u_end[2]": None}, r"found no u_end\[2\], expected"),
        ({"refusal": 1.0}, "found no tick of RISE-DI, expected a flight with RDI_EN 1"),
    ],
)
def test_log_of_another_module_is_refused(
    shell: Shell, changes: dict[str, float | None], words: str
) -> None:
    controller = find_scenario(str(OBSERVER)).controller
    table = flown_table(shell, controller)
    fields = dict(table.fields)
    for name, value in changes.items():
        if value is None:
            del fields[name]
        else:
            fields[name] = np.full(len(table.stamp_ns), value)
    log = VehicleLog("a ULog", {STATUS: MessageTable(table.stamp_ns, fields)}, {}, None)
    with refusing(words):
        module_flight(log, controller)

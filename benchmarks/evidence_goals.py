# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What benchmarks/evidence.py measures: the command and the goals of each measurement, and the
sections of the page.
"""

CAMPAIGN = "rise-di campaign --uncertainty 0.3 --seed 7 --set runs=FOLDER --json"
COMPARE = (
    "rise-di compare osprey_servo --tuning gust,gust_turbulence,delay --json FILE --aircraft 200"
)
RANDOM_FAULTS = "python -m benchmarks.random_faults --json FILE --count"
LONG_FLIGHT = "python -m benchmarks.long_flight --json FILE"
ATTACKS = ("flight_ros/test_security.py", "flight_bringup/test_policy.py")
SPEED = {
    "law": 10,
    "receiver": 10,
    "node": 10,
    "latency": 10,
    "ticks": 60,
    "flight": 10,
    "start": 10,
    "import": 10,
}
SPEED |= {"lockstep": 30, "recorder": 30}  # s a figure

COMMANDS = {
    f"speed-{group}": f"python -m benchmarks.speed --only {group} --seconds {seconds} --json FILE"
    for group, seconds in SPEED.items()
} | {
    "faults": "python -m benchmarks.faults --times 10 --json FILE",
    "random-faults": f"{RANDOM_FAULTS} 20 --lockstep 2",
    "security": "pytest -q "
    f"{' '.join(f'tests/{folder}/{file}' for folder in ('ros', 'nodes') for file in ATTACKS)}",
    "fuzz": "pytest -q -n auto tests/fuzz",
    "fuzz-coverage": "python -m benchmarks.fuzz all --seconds 30",
    "campaign": "python -m benchmarks.campaign --json FILE",
    "campaign-fleet": f"{CAMPAIGN} osprey_servo --aircraft 10000",
    "campaign-missions": f"{CAMPAIGN} osprey_route --aircraft 5000",
    "compare": COMPARE,
    "compare-self_tuner": f"{COMPARE} --laws self_tuner",
    "view": "python -m benchmarks.view --json FILE",
    "replay": "python -m benchmarks.replays",
    "long-faults": f"{RANDOM_FAULTS} 1000 --lockstep 100",
    "long-fuzz": "python -m benchmarks.fuzz all --seconds 600",
    "long-lockstep": f"{LONG_FLIGHT} --observer --one-process --rate 100 --minutes 360",
    "long-real-time": f"{LONG_FLIGHT} --observer --real-time",
    "long-jsbsim": f"{LONG_FLIGHT} --one-process",
}
"""By name. FILE stands for the file of the result; without FILE, the result is the output."""

LONG = {"long-faults", "long-fuzz", "long-lockstep", "long-real-time", "long-jsbsim"}
"""Half an hour and more each: measured by name alone."""

FUZZED, DRAWN = {"status": "<= 0"}, {"draws that fail": "<= 0"}
LOGGED = {
    "growth": "<= 0.02",
    "^lost": "<= 0",
    "differing": "<= 0",
    "written": "<= 10",
    "opened: .*figures.*": "<= 3",
}
COUNTED = {"missing samples: .*": "<= 0"}
GOALS = {
    "faults": {
        "(exec|ready)_to_traffic: worst": "<= 0.5",
        "recorder killed under a live page.*: page: worst": "<= 1.5",
        ": page: worst": "<= 2",
        "last_bank_deg: worst": "<= 5",
        "bank_deg: worst": "<= 45",
        "passed": ">= 10",
    },
    "random-faults": DRAWN,
    "long-faults": DRAWN,
    "security": {"failed|error": "<= 0"},
    "fuzz": {"failed|error": "<= 0"},
    "fuzz-coverage": FUZZED,
    "long-fuzz": FUZZED,
    "long-lockstep": LOGGED | COUNTED,
    "long-jsbsim": LOGGED | COUNTED,
    "long-real-time": LOGGED | {"excluding host delays.*": "<= 0"},
    "campaign": {
        "flown": ">= 150000",
        "memory_growth": "<= 1.1",
        "integration: .*": "<= 0.01",
        "on a GPU": "<= 10",
    },
    "view": {
        "live: processor": "<= 0.03",
        "live: memory": "<= 80",
        "to the screen: p50": "<= 0.12",
        "to the screen: p99": "<= 0.25",
        "recovered after": "<= 1",
        "opened: (first samples|whole log)": "<= 3",
        "flights: more [^:]*: (?!missed).*": "<= 0.1",
        "flights: probability [^:]*: missed.*": ">= 0.05",
    },
    "replay": {"differing": "<= 0"},
}
"""By measurement: patterns of the end of a figure's name, SI. The groups of `speed` have goals of
their own."""

ROUTE_AIRCRAFT = ("osprey_servo", "c172p", "737", "f16", "c182", "A320", "F4N")
SECTIONS = {
    "Faults": {
        "faults": "faults injected into a flight over DDS",
        "random-faults": "random faults, also two at a time and in lockstep",
        "long-faults": "a thousand random faults",
    },
    "Speed": {
        "speed-law": "one step of the law",
        "speed-receiver": "a refused message compared with a right one",
        "speed-node": "the controller's tick compared with an echo's callback",
        "speed-latency": "from y sent to u received, over DDS",
        "speed-ticks": "lateness of ticks",
        "speed-flight": "CPU and memory of each process of a flight",
        "speed-start": "from start to first u",
        "speed-import": "processor time of `import rise_di` and of `rise-di --help`",
        "speed-lockstep": "lockstep flights",
        "speed-recorder": "the recorder at 1 kHz on six topics",
    },
    "Security": {
        "security": "who can receive y and command u",
        "fuzz": "external input, fuzzed by hypothesis",
        "fuzz-coverage": "readers, coverage-guided fuzzing",
        "long-fuzz": "the same readers, ten minutes each",
    },
    "Long flights and replay": {
        "long-lockstep": "six hours in lockstep",
        "long-real-time": "one hour in real time",
        "long-jsbsim": "one hour of an aircraft of JSBSim in lockstep",
        "replay": "every scenario flown and replayed",
    },
    "Campaigns and other laws": {
        "campaign": "speed and accuracy of campaigns",
        "campaign-fleet": "uncertain aircraft flown by the same law",
        "campaign-missions": "uncertain aircraft on a route",
        "cluster": "a campaign on a cluster of dask with faults",
        "compare": "other laws on the same aircraft and course",
        "compare-self_tuner": "the self-tuner on the same course",
        "margins": "the cost of a phase margin under five laws",
        "effectors": "each effector lost at a random time",
    },
    "Learning in the air": {
        "learning": "uncertain aircraft that learn, in every air and with damage"
    },
    "Live view": {"view": "the page beside a flight, and with a log of one hour"},
    "Guidance": {
        f"guidance-{name}": f"holds and paths, {name}"
        for name in ("osprey_servo", "c172p", "737", "f16")
    }
    | {"guidance-route": "another route, other aircraft"}
    | {f"guidance-grid-{name}": f"off the design point, {name}" for name in ("c172p", "737", "f16")}
    | {"guidance-rates": "errors of rates with guidance over those without"}
    | {"guidance-laws": "the path law beside L1, with and without the lead of the curvature"}
    | {f"guidance-routes-{name}": f"hard routes, {name}" for name in ROUTE_AIRCRAFT}
    | {
        f"guidance-fence-{name}": f"fences in wind, {name}"
        for name in ("osprey", "c172p", "f16", "737")
    },
    "Real autopilots": {
        "autopilots-arduplane": "ArduPlane, servos of 0.03 s, identified gains",
        "autopilots-slow_servos": "the same with default servos of 0.14 s",
        "autopilots-px4": "PX4's airplane, identified gains",
        "autopilots-guided": "ArduPlane under guidance",
        "autopilots-probe": "ArduPlane over MAVLink: stuck surfaces, false alarms of the probe",
        "autopilots-observer": "ArduPlane with an identified observer, in turbulence",
        "autopilots-engagements": "engagements without a jump",
        "autopilots-signs": "signs, in wind of 5 m/s",
        "autopilots-pose": "rates and pose over the autopilot's own log",
        "autopilots-own_log": "ArduPlane 15 % faster, over DDS and MAVLink, by its own logs",
        "autopilots-releases": "tests, and the times of a release",
    },
}

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulated aircraft, validated once.

Their methods convert them to the arrays of the equations.
"""

from collections.abc import Sequence
from itertools import product
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from aircraft_sim import uncertainty
from aircraft_sim.airframes.airframe import (
    EULER_STATES,
    Airframe,
    Unit,
    euler_kinematics,
    load_airframe,
)
from aircraft_sim.airframes.airspeed import over_airspeed
from aircraft_sim.atmosphere.disturbance import AXES, ROTARY, Bias, Gusts, Sines
from aircraft_sim.atmosphere.turbulence import Turbulence, dryden, filters
from aircraft_sim.atmosphere.wind_field import RelativeWind
from aircraft_sim.jsbsim.jsbsim_aircraft import (
    INPUTS,
    OUTPUTS,
    PREFIX,
    FlightCondition,
    WindModel,
    named_properties,
    require_aircraft,
)
from aircraft_sim.plant import effector_faults
from aircraft_sim.plant.actuators import Actuators
from aircraft_sim.plant.dynamics import Aircraft, Coupling
from aircraft_sim.plant.plant import Drift, PlantParams
from aircraft_sim.pose import Start, every
from aircraft_sim.sections import (
    ActuatorConfig,
    BiasConfig,
    DriftConfig,
    Gust,
    MicroburstConfig,
    PoseConfig,
    SensorConfig,
    ShearConfig,
    SineConfig,
    StartConfig,
    TurbulenceConfig,
    UncertaintyConfig,
    by_state,
    require_one_wind,
    wind_field_of,
)
from aircraft_sim.sensors import Sensors
from aircraft_sim.vanes import VaneSensorsConfig
from flight_core import parameters
from flight_core.channels import POSE, vertical
from flight_core.fields import Field
from flight_core.parameters import (
    NodeConfig,
    NonNegative,
    Numbers,
    ParameterError,
    Positive,
    Rate,
    RateOrZero,
    require,
)
from flight_core.rates import divide, nanoseconds, period_ns, seconds
from flight_core.vectors import FloatArray

SHORTEST_STEP = 1e-5  # s; with this step, simulating a second of flight takes about 5 s


class AircraftChannels(NamedTuple):
    """Outputs and inputs of an aircraft, whatever its kind."""

    outputs: dict[str, Unit]  # in the order of y
    inputs: dict[str, Unit]  # in the order of u, with the units for display (topics are in SI)
    positive: dict[str, str]  # effect of a positive value of each input, such as "nose down"
    speed: float  # trim speed V0, m/s


class AircraftConfig(NodeConfig):
    """Parameters of the node of the simulated aircraft."""

    airframe: str = Field(description="name, path of a file, jsbsim:NAME or jsbsim:PATH")
    speed: Positive | None = Field(
        default=None, description="true airspeed of the trim, m/s; only for JSBSim"
    )
    altitude: NonNegative | None = Field(
        default=None, description="altitude of the trim above sea level, m; only for JSBSim"
    )
    commands: dict[str, str] = Field(
        default={},
        description="for JSBSim, by input: properties with their values at the command 1; "
        "`rudder: none` for a model without rudder",
    )
    rate: Rate = Field(description="rate of y and u, Hz")
    step: Annotated[float, Field(gt=0, ge=SHORTEST_STEP, le=1)] = Field(
        description="integration step, s; a whole fraction of 1 / rate"
    )
    start_time: float = Field(
        default=0.0,
        ge=-1,
        le=1e10,
        description="system time of t = 0, s since the epoch; 0: at once; -1: by topic `start`",
    )
    start: StartConfig = Field(default=StartConfig(), description="where the aircraft is at t = 0")
    gusts: dict[str, Gust] = Field(
        default={}, description="gusts by the axis of the wind: longitudinal, lateral, vertical"
    )
    turbulence: TurbulenceConfig | None = Field(
        default=None, description="turbulence along all axes of the airframe's gusts"
    )
    bias: dict[str, BiasConfig] = Field(default={}, description="biases on x_dot by state")
    sines: dict[str, SineConfig] = Field(default={}, description="sines on x_dot by state")
    inertial_coupling: float = Field(
        default=0.0, ge=0, le=1, description="factor on the airframe's inertial coupling"
    )
    kinematics: Literal["linear", "euler", "thrust"] = Field(
        default="linear",
        description="how the attitude follows from the rates: linear by A, by Euler's equations "
        "with the loss of lift in a bank, or as in a multicopter",
    )
    wind: Annotated[Numbers, Field(min_length=2, max_length=2)] = Field(
        default=(0.0, 0.0), description="steady wind, m/s, towards which the air moves: north, east"
    )
    shear: ShearConfig | None = Field(default=None, description="steady wind by height")
    microburst: MicroburstConfig | None = Field(default=None, description="a microburst, if any")
    uncertainty: UncertaintyConfig = Field(
        default=UncertaintyConfig(), description="how the aircraft deviates from the airframe file"
    )
    drift: DriftConfig | None = Field(
        default=None, description="how A and B change in flight, for example by ice"
    )
    over_airspeed: str | None = Field(
        default=None,
        description="name of the thrust input; A, B and the trim then follow the airspeed",
    )
    actuators: ActuatorConfig = Field(
        default=ActuatorConfig(), description="actuators; ideal if left out"
    )
    sensors: SensorConfig = Field(default=SensorConfig(), description="sensors; ideal if left out")
    vanes: VaneSensorsConfig = Field(
        default=VaneSensorsConfig(), description="vanes besides the outputs; none if left out"
    )
    pose: PoseConfig = Field(
        default=PoseConfig(), description="how the pose is measured; exactly if left out"
    )

    control_rate: RateOrZero = Field(
        default=0.0, description="the controller's rate in lockstep, Hz"
    )
    duration: float = Field(
        default=0.0,
        ge=0,
        le=1e6,
        description="end of a lockstep flight, s of flight time; 0: never",
    )
    recorded: bool = Field(default=False, description="in lockstep, wait for the recorder")

    max_age: float = Field(default=0.2, gt=0, le=1e6, description="age at which u times out, s")
    hold: float = Field(default=0.5, ge=0, le=1e6, description="how long the failsafe holds u, s")
    ramp: float = Field(
        default=2.0, ge=0, le=1e6, description="how long the failsafe then ramps u to trim, s"
    )

    @classmethod
    def tunable(cls) -> frozenset[str]:
        """Return the parameters that may change in flight, because faults can begin and end.

        They are the faults of effectors and sensors, the gusts, and the start of a drift.
        """
        gusts = {f"gusts.{axis}.{key}" for axis, key in product(AXES, Gust.model_fields)}
        sensors = {f"sensors.{key}" for key in ("bias", "noise", "dropout")} | {
            "vanes.frozen_at",
            "vanes.dropout",
        }
        return frozenset(gusts | sensors | {"actuators.faults", "drift.start"})

    def _check(self) -> None:
        period = period_ns(self.rate, "rate")
        divide(period, self.step_ns, "step", "1 / rate")
        if self.lockstep:
            require(
                self.control_rate > 0, "control_rate", "0 Hz", "the controller's rate in lockstep"
            )
            divides = period_ns(self.control_rate, "control_rate") % period == 0
            require(
                divides,
                "control_rate",
                f"{self.control_rate:g} Hz",
                f"a whole fraction of rate ({self.rate:g} Hz)",
            )
        if self.is_jsbsim:
            self._check_jsbsim()
        else:
            self._check_airframe()
        require_one_wind(self.wind, self.shear, self.microburst)
        channels = self.channels()
        for axis, gust in self.gusts.items():
            least = (
                f"at least {2.0 * gust.length / channels.speed:.6g} s, which the gust takes "
                f"at {channels.speed:g} m/s"
            )
            require(
                gust.every * channels.speed >= 2.0 * gust.length,
                f"gusts.{axis}.every",
                f"{gust.every:g} s",
                least,
            )
        for key, values in self.actuators.model_dump(exclude={"delay", "faults"}).items():
            if values:
                parameters.require_length(f"actuators.{key}", values, list(channels.inputs))
        owner = self.airframe if self.is_jsbsim else f"the airframe {self.airframe}"
        effector_faults.require_possible(
            self.actuators.read_faults(),
            self._stops(),
            list(channels.inputs),
            self._no_thrust(),
            owner,
        )
        for key in ("bias", "drift", "noise", "quantisation"):
            if values := getattr(self.sensors, key):
                parameters.require_length(f"sensors.{key}", values, list(channels.outputs))
        for key in ("bias", "drift", "noise"):
            unknown = [name for name in getattr(self.pose, key) if name not in POSE]
            require(not unknown, f"pose.{key}", ", ".join(unknown), f"some of {', '.join(POSE)}")
        if self.pose.rate is not None:
            divide(period_ns(self.pose.rate, "pose.rate"), period, "rate", "1 / pose.rate")
        for name in ("actuators", "sensors", "pose"):
            delay = getattr(self, name).delay
            multiple = f"a whole multiple of 1 / rate ({seconds(period):g} s)"
            require(nanoseconds(delay) % period == 0, f"{name}.delay", f"{delay:g} s", multiple)

    def _check_airframe(self) -> None:
        for key in ("speed", "altitude"):
            value = getattr(self, key)
            require(
                value is None, key, value, f"none: the airframe {self.airframe} has a fixed trim"
            )
        require(
            not self.commands,
            "commands",
            "a value",
            f"none: {self.airframe} is no aircraft of JSBSim",
        )
        airframe = load_airframe(self.airframe)
        for name in self.gusts:
            airframe.gust_direction(name)
        for key, configs in (("bias", self.bias), ("sines", self.sines)):
            for name in configs:
                states = ", ".join(airframe.states)
                require(
                    name in airframe.states,
                    f"{key}.{name}",
                    f"{name!r}",
                    f"a state of {airframe.name}: {states}",
                )
        has_none = f"the airframe {airframe.name} has no"
        possible = bool(airframe.inertial_coupling) or self.inertial_coupling == 0.0
        require(
            possible,
            "inertial_coupling",
            f"{self.inertial_coupling:g}",
            f"0: {has_none} inertial_coupling",
        )
        state_names: tuple[str, ...] = ("alpha", *EULER_STATES)
        if self.kinematics == "thrust":
            state_names = ("p", "q", "r", vertical([*airframe.states]) or "vertical_speed")
        missing = [name for name in state_names if name not in airframe.states]
        has_states = self.kinematics == "linear" or not missing
        require(
            has_states,
            "kinematics",
            f"{self.kinematics!r}",
            f"linear: {has_none} state {', '.join(missing)}",
        )
        require(
            bool(airframe.gusts) or self.turbulence is None,
            "turbulence",
            "a section",
            f"none: {has_none} gusts",
        )
        if self.has_rotary_gusts:
            require(
                airframe.span is not None, "turbulence.rotary", "true", f"false: {has_none} span"
            )
        if self.over_airspeed is not None:
            self._check_over_airspeed(airframe, self.over_airspeed)
        self.vanes.require_fit(airframe)

    def _check_over_airspeed(self, airframe: Airframe, thrust: str) -> None:
        over_airspeed(airframe, thrust)
        require(
            self.kinematics == "linear",
            "over_airspeed",
            "kinematics euler beside it",
            "linear kinematics",
        )
        require(
            self.drift is None,
            "over_airspeed",
            "a drift beside it",
            "none: a drift is defined at the trim speed",
        )

    def _stops(self) -> dict[str, Sequence[float]]:
        """Return the lists of the lower and upper end stops of the actuators, by key."""
        return {end: getattr(self.actuators, end) for end in effector_faults.ENDS}

    def _no_thrust(self) -> FloatArray:
        """Return the value of each input at which it gives no thrust, as deviation from trim, SI.

        An unknown value is nan. For JSBSim's throttle the value is -1 until the model knows its
        trim.
        """
        if self.is_jsbsim:
            inputs = self.flight_condition().inputs()
            return np.array([-float(INPUTS[name].is_per_engine) for name in inputs])
        return load_airframe(self.airframe).no_thrust()

    def _check_jsbsim(self) -> None:
        require_aircraft(self.airframe)
        for key, unit in (
            ("speed", "true airspeed to trim at, m/s"),
            ("altitude", "altitude to trim at, m"),
        ):
            require(getattr(self, key) is not None, key, "none", f"the {unit}")
        for name in self.gusts:
            require(
                name in AXES,
                f"gusts.{name}",
                f"{name!r}",
                f"an axis of the wind: {', '.join(AXES)}",
            )
        uncertain = (
            self.uncertainty.A > 0.0 or self.uncertainty.B > 0.0 or bool(self.uncertainty.entries)
        )
        for key, value in (
            ("bias", self.bias),
            ("sines", self.sines),
            ("inertial_coupling", self.inertial_coupling),
            ("kinematics", self.kinematics != "linear"),
            ("uncertainty", uncertain),
            ("drift", self.drift),
            ("over_airspeed", self.over_airspeed),
        ):
            require(not value, key, "a value", f"none: {self.airframe} has no matrices to change")
        takes_winds = "false: JSBSim takes winds, and no rates at which the air turns"
        require(not self.has_rotary_gusts, "turbulence.rotary", "true", takes_winds)

    @property
    def is_jsbsim(self) -> bool:
        """Whether JSBSim flies the aircraft."""
        return self.airframe.startswith(PREFIX)

    @property
    def step_ns(self) -> int:
        """Integration step in ns."""
        return nanoseconds(self.step)

    def channels(self) -> AircraftChannels:
        """Return outputs and inputs with units, the effects of the inputs, and the trim speed."""
        vanes: dict[str, Unit] = dict.fromkeys(self.vanes.channels, "rad")
        if self.is_jsbsim:
            condition = self.flight_condition()
            positive = {name: INPUTS[name].positive for name in condition.inputs()}
            return AircraftChannels(
                {**OUTPUTS, **vanes}, dict.fromkeys(positive, "1"), positive, condition.speed
            )
        airframe = load_airframe(self.airframe)
        inputs = {name: channel.unit for name, channel in airframe.inputs.items()}
        positive = {name: channel.positive for name, channel in airframe.inputs.items()}
        return AircraftChannels(
            airframe.units_of_outputs() | vanes, inputs, positive, airframe.speed
        )

    @property
    def has_rotary_gusts(self) -> bool:
        """Whether rotary gusts act, which means that the air turns."""
        return self.turbulence is not None and self.turbulence.rotary

    def nominal_airframe(self) -> Airframe:
        """Return the named airframe, with the axes of rotary gusts if there are rotary gusts."""
        airframe = load_airframe(self.airframe)
        return airframe.with_rotary_gusts() if self.has_rotary_gusts else airframe

    def sampled_airframe(self) -> Airframe:
        """Return the airframe at the start: the named one, or a sample of `uncertainty`."""
        section = self.uncertainty
        return uncertainty.sample_airframe(
            self.nominal_airframe(),
            part_A=section.A,
            part_B=section.B,
            seed=section.seed,
            number=section.number,
            wind=section.wind,
            spread=section.spread(),
        )

    def drifted_airframe(self) -> Airframe:
        """Return the airframe after its drift; without a drift, the airframe at the start."""
        airframe = self.sampled_airframe()
        section = self.drift
        if section is None:
            return airframe
        return uncertainty.sample_airframe(
            airframe,
            part_A=section.A,
            part_B=section.B,
            seed=section.seed,
            number=section.number,
            wind=self.uncertainty.wind,
        )

    def drift_factors(self) -> Drift | None:
        """Return the drift as factors on the matrices of equation (1), or None without a drift."""
        if self.drift is None:
            return None
        matrices = (
            (a.matrix_a(), a.matrix_b(), a.matrix_gusts())
            for a in (self.sampled_airframe(), self.drifted_airframe())
        )
        factors = [
            np.divide(after, before, out=np.ones_like(before), where=before != 0.0)
            for before, after in zip(*matrices, strict=True)
        ]
        return Drift(self.drift.start, self.drift.duration, *factors)

    def load(self) -> tuple[Airframe, Aircraft]:
        """Return the airframe in flight, and the arrays of equation (1) with the disturbances.

        The disturbances act along the axes of the airframe's gusts.
        """
        airframe = self.sampled_airframe()
        gain, first, second = airframe.products()
        biases = {name: bias for name, bias in self.bias.items() if bias.value != 0.0}
        sines = {name: sine for name, sine in self.sines.items() if sine.amplitude != 0.0}
        return airframe, Aircraft(
            A=airframe.matrix_a(),
            B=airframe.matrix_b(),
            C=airframe.matrix_c(),
            gravity=airframe.matrix_gravity(),
            gust_direction=airframe.matrix_gusts(),
            gusts=self.gust_arrays(list(airframe.gusts)),
            speed=np.array(airframe.speed),
            coupling=Coupling(self.inertial_coupling * gain, first, second)
            if self.inertial_coupling > 0.0
            else None,
            bias=Bias(*by_state(biases, Bias._fields, airframe.states)) if biases else None,
            sines=Sines(*by_state(sines, Sines._fields, airframe.states)) if sines else None,
            kinematics=euler_kinematics(airframe) if self.kinematics == "euler" else None,
        )

    def plant(self) -> PlantParams:
        """Return the plant as arrays: equation (1), actuators, turbulence and drift."""
        airframe, aircraft = self.load()
        span = airframe.span if self.has_rotary_gusts else None
        turbulence = self._turbulence(airframe.speed, list(airframe.gusts), span)
        over = None if self.over_airspeed is None else over_airspeed(airframe, self.over_airspeed)
        return PlantParams(
            aircraft=aircraft,
            actuators=self.actuator_model(),
            step_ns=self.step_ns,
            turbulence=turbulence,
            drift=self.drift_factors(),
            over_airspeed=over,
        )

    def actuator_model(self) -> Actuators:
        """Return the actuators as arrays."""
        section = self.actuators
        columns: dict[str, Any] = {
            key: _array(values, key in {"lag", "dead_zone"})
            for key, values in section.model_dump(exclude={"delay", "faults"}).items()
        }
        inputs = list(self.channels().inputs)
        columns |= effector_faults.arrays(section.read_faults(), self._stops(), inputs)
        fails = "lost_at" in columns or "weak_at" in columns
        needs_no_thrust = fails and not self.is_jsbsim  # the model of JSBSim has its own trim
        return Actuators(**columns, no_thrust=self._no_thrust() if needs_no_thrust else None)

    def flight_condition(self) -> FlightCondition:
        """Return the aircraft of JSBSim with its flight condition.

        Raises ParameterError for a linear aircraft.
        """
        if self.speed is None or self.altitude is None:
            raise ParameterError(
                f"airframe: found {self.airframe!r}, expected {PREFIX}NAME with a speed and an "
                "altitude"
            )
        properties = named_properties(self.commands, "commands")
        return FlightCondition(
            name=require_aircraft(self.airframe),
            speed=self.speed,
            altitude=self.altitude,
            step_ns=self.step_ns,
            named=properties,
        )

    def wind_model(self) -> WindModel:
        """Return the sources of wind for an aircraft of JSBSim, along every axis."""
        turbulence = self._turbulence(self.flight_condition().speed, AXES, None)
        return WindModel(self.gust_arrays(AXES), turbulence, self.relative_wind())

    def ground(self) -> float | None:
        """Return the altitude of the ground, m, as in `pose`, or None if no section states it."""
        section = self.microburst if self.shear is None else self.shear
        return None if section is None else section.ground

    def relative_wind(self) -> RelativeWind | None:
        """Return the wind that varies with the position, or None if it is the same everywhere."""
        field = wind_field_of(self.wind, self.shear, self.microburst)
        start = Start(**self.start.model_dump())
        return None if field is None else RelativeWind(field, start, self.altitude or 0.0)

    def gust_arrays(self, axes: Sequence[str]) -> Gusts:
        """Return the gusts along the given axes as arrays."""
        gusts = [self.gusts.get(axis, STILL_AIR) for axis in axes]
        start = np.array([gust.start for gust in gusts])
        speed = np.array([gust.speed for gust in gusts])
        length = np.array([gust.length for gust in gusts])
        every = np.array([gust.every for gust in gusts])
        return Gusts(start, speed, length, every if np.isfinite(every).any() else None)

    def _turbulence(
        self, speed: float, axes: Sequence[str], span: float | None
    ) -> Turbulence | None:
        section = self.turbulence
        # The turbulence is off, or its intensity is 0.
        if section is None or not (section.wind or section.sigma):
            return None
        # An intensity is None at an altitude where it has no effect.
        spectrum = dryden(section.altitude, section.wind or 0.0, section.sigma or 0.0)
        every = (*AXES, *ROTARY)
        places = [every.index(axis) for axis in axes]
        return filters(spectrum, speed, self.step, places, section.seed, span)

    def sensor_arrays(self) -> Sensors:
        """Return the sensors as arrays."""
        sensors = self.sensors
        drift = _array(sensors.drift, zero_is_none=True)
        return Sensors(
            noise=np.array(sensors.noise)
            if sensors.noise
            else np.zeros(len(self.channels().outputs)),
            delay_ns=nanoseconds(sensors.delay),
            dropout=sensors.dropout,
            seed=sensors.seed,
            bias=_array(sensors.bias, zero_is_none=True),
            drift=None if drift is None else drift * np.sqrt(1.0 / self.rate),
            quantum=_array(sensors.quantisation, zero_is_none=True),
        )

    def pose_every(self) -> int:
        """Return the period of pose, as a multiple of the aircraft's period."""
        rate = self.pose.rate
        if rate is None:
            return every(self.rate)
        return divide(period_ns(rate, "pose.rate"), period_ns(self.rate, "rate"), "rate", "")

    def pose_sensors(self) -> Sensors | None:
        """Return the errors of pose, in the order of `channels.POSE`, without the errors of y."""
        pose = self.pose
        if not (
            pose.delay
            or any(pose.bias.values())
            or any(pose.drift.values())
            or any(pose.noise.values())
        ):
            return None
        bias = np.array([pose.bias.get(name, 0.0) for name in POSE])
        drift = np.array([pose.drift.get(name, 0.0) for name in POSE])
        noise = np.array([pose.noise.get(name, 0.0) for name in POSE])
        walk = drift * np.sqrt(self.pose_every() / self.rate) if drift.any() else None
        return Sensors(
            noise=noise,
            delay_ns=nanoseconds(pose.delay),
            dropout=0.0,
            seed=pose.seed + 2**64,
            bias=bias,
            drift=walk,
        )


STILL_AIR = Gust(start=0.0, speed=0.0, length=1.0)


def _array(values: Sequence[float], zero_is_none: bool) -> FloatArray | None:
    """Return values as an array, or None if there are none, or if all are 0 and `zero_is_none`."""
    if not values or (zero_is_none and not any(values)):
        return None
    return np.array(values, dtype=np.float64)

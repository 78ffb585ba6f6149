# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The fields that the section `controller` of a scenario has under any control law.

The arrays of guard, feedforward and observer are built from these fields.
"""

import json
from hashlib import blake2b
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np

from flight_core.fields import Field
from flight_core.parameters import (
    Names,
    NodeConfig,
    NonNegative,
    NonNegatives,
    Numbers,
    Positives,
    Rate,
    RateOrZero,
    Signs,
    flatten,
)
from flight_core.rates import nanoseconds, period_ns
from flight_core.vectors import FloatArray
from rise_di_controller import internals
from rise_di_controller.extensions.feedforward import (
    Nominal,
)
from rise_di_controller.extensions.model_sections import (
    AllocationConfig,
    FeedforwardConfig,
    ObserverConfig,
)
from rise_di_controller.extensions.observer import (
    ObserverParams,
    with_observer,
)
from rise_di_controller.guard import samples
from rise_di_controller.guard.guard import GuardParams
from rise_di_controller.guard.probe import Probe, ProbeConfig
from rise_di_controller.law.control_law import ControlLaw, TunedLaw
from rise_di_controller.law.saturation import Limits

OF_NODE = frozenset({"lockstep", "y_rate", "autostart", "start_active"})
"""Parameters that concern only the node, on which the law and its guard do not depend."""


class ControllerSection(NodeConfig):
    """The fields of the section `controller`, and the arrays that are built from the fields.

    `params.ControllerConfig` checks the fields. Each law has a subclass of `ControllerConfig` with
    its parameters.
    """

    needs: ClassVar[str] = ""
    """What the law must measure in addition to y and y_m, in words. The controller refuses a law
    that needs such a measurement."""

    rate: Rate = Field(description="rate of the law, Hz")
    y_rate: RateOrZero = Field(default=0.0, description="rate of y in lockstep, Hz")
    law: str = Field(default="rise_di", description="the law, by its registered name")
    outputs: Names = Field(
        description="channels of y; RISE-DI gives the last one the smallest gain (22)"
    )
    inputs: Names = Field(
        description="channels of u, each paired with an output; with an allocation, channels of v"
    )
    D: Signs = Field(description="diagonal of D (11), +1 or -1")
    input_scale: Positives = Field(
        description="change of u that changes y_dot by one: 1 / abs(Omega_ii)"
    )
    lag: NonNegatives = Field(description="time constants of the actuators, s; 0 for none")
    # The default is for topics on one host. At a tick, a y of 500 Hz is at most 2 ms old, and u
    # then waits 1 ms for the aircraft.
    delay: NonNegative = Field(
        default=0.003,
        description="delay from y to the actuators beside sampling, s; default: topics on one host",
    )
    y_max: Positives | None = Field(
        default=None,
        description="largest abs(y) and abs(y_m); none: p, q, r 2000 deg/s, V 340 m/s, else 1e6",
    )
    # The default is ten ticks at 100 Hz. A busy host stalls for a shorter time than this, and a
    # command takes longer than this to rise.
    max_age: Annotated[float, Field(gt=0, le=1e6)] = Field(
        default=0.1, description="age above which y or y_m is stale, s"
    )
    # A short loss of y costs no command, and an aircraft is seldom upset within half a second.
    hold: Annotated[float, Field(ge=0, le=1e6)] = Field(
        default=0.5, description="how long the failsafe holds u, s"
    )
    # This is slow compared with the modes of an aircraft, so the return to trim excites none of
    # them.
    ramp: Annotated[float, Field(ge=0, le=1e6)] = Field(
        default=2.0, description="how long the failsafe then takes to bring u to trim, s"
    )
    lower: Numbers | None = Field(default=None, description="lower limits of u, from trim")
    upper: Numbers | None = Field(default=None, description="upper limits of u, from trim")
    slew: Positives | None = Field(default=None, description="limits of abs(u_dot), units of u / s")
    on_deactivate: Literal["trim", "hold"] = Field(
        default="trim", description="u after deactivation: ramped to trim or held"
    )
    autostart: bool = Field(default=True, description="whether the node configures itself at start")
    start_active: bool = Field(
        default=True,
        description="whether it also activates itself; if not, u stays at trim",
    )
    allocation: AllocationConfig | None = Field(
        default=None, description="extension that distributes the inputs of the law over effectors"
    )
    feedforward: FeedforwardConfig | None = Field(
        default=None,
        description="extension that adds the input with which a nominal model follows y_m",
    )
    observer: ObserverConfig | None = Field(
        default=None,
        description="extension that corrects the trim by estimates of wind and model error",
    )
    probe: ProbeConfig | None = Field(
        default=None,
        description="extension that adds a small sine to each input, to find a stuck surface",
    )

    def _model_states(self) -> tuple[str, ...]:
        return () if self.feedforward is None else self.feedforward.states

    @property
    def vanes(self) -> tuple[str, ...]:
        """Channels of y that only the observer uses."""
        if self.observer is None or self.observer.vanes is None:
            return ()
        return self.observer.vanes.channels

    @property
    def measured(self) -> tuple[str, ...]:
        """Channels of y that the controller takes: the outputs, then the vanes."""
        return (*self.outputs, *self.vanes)

    def without_vanes(self) -> Self:
        """Return the parameters without vanes, so that the observer uses y alone."""
        if self.observer is None or not self.vanes:
            return self
        return self.model_copy(
            update={"observer": self.observer.model_copy(update={"vanes": None})}
        )

    def control_law(self) -> ControlLaw:
        """Return the law."""
        raise NotImplementedError

    def law_params(self) -> Any:
        """Return the law's parameters as arrays."""
        raise NotImplementedError

    def summary(self) -> str:
        """Describe the law and its settings in a sentence for the log."""
        return f"law {self.law}"

    def tuned_law(self) -> TunedLaw:
        """Return the law with its parameters, extended by the observer if there is one."""
        law = self.control_law()
        params = self.law_params()
        nominal = self.nominal()
        if self.observer is None or nominal is None:
            return TunedLaw(law, params)
        limits_of_u = self._limits()
        part = self.observer.part
        rate = part / self.observer.within * (limits_of_u.upper - limits_of_u.lower) / 2.0
        limits = Limits(part * limits_of_u.lower, part * limits_of_u.upper, rate)
        fade_rate = 1.0 / self.observer.fade if self.observer.fade else np.inf
        Phi, Gamma, H, L, F = self.observer.matrices(nominal)
        section = self.observer.vanes
        vanes = None
        if section is not None:
            vanes = section.params(self.outputs, self._model_states(), len(Phi))
        observed = ObserverParams(
            law=params,
            Phi=Phi,
            Gamma=Gamma,
            H=H,
            L=L,
            F=F,
            limits=limits,
            fade_rate=np.float64(fade_rate),
            vanes=vanes,
        )
        return TunedLaw(
            with_observer(law) if section is None else with_observer(law, vanes=True), observed
        )

    def models(self) -> tuple[Any, ...]:
        """Return the sections with a model. Only these sections may be replaced by a learner."""
        return self.feedforward, self.observer

    def logged_groups(self, law: ControlLaw | None = None) -> dict[str, tuple[str, ...]]:
        """Group the channels of `internals`, and list the names in each group.

        Args:
            law: The law of `tuned_law`. If None, it is computed.

        Returns:
            Names of the channels by group.
        """
        estimates = () if self.observer is None else self.observer.states
        effectors = () if self.allocation is None else self.allocation.effectors
        return internals.groups(
            law or self.tuned_law().control_law,
            self.outputs,
            self.inputs,
            estimates,
            effectors,
            self.vanes,
        )

    @property
    def effectors(self) -> tuple[str, ...]:
        """Channels of the published u.

        They are the effectors of an allocation, or the inputs of the law if there is no allocation.
        """
        return self.inputs if self.allocation is None else self.allocation.effectors

    def effector_limits(self) -> Limits:
        """Return the limits of the published u, in the order of `effectors`."""
        guard = self.guard()
        return guard.limits if guard.allocation is None else guard.allocation.limits

    def given_up(self) -> FloatArray:
        """Return 1 for each output that no longer uses its learned model, else 0, shape (m,).

        A learned model that made its output diverge or oscillate is not used again until the
        engagement ends. The array is empty if the controller does not learn.
        """
        return np.zeros(0)

    def history_ticks(self) -> int:
        """Return how many past ticks are kept, over which a new observer runs to get its estimates.

        It is 0 unless models are learned in flight.
        """
        return 0

    def nominal(self) -> Nominal | None:
        """Return the arrays of the feedforward, or None if there is none."""
        if self.feedforward is None:
            return None
        return self.feedforward.nominal(self.outputs, self.inputs, self.D)

    def _flown_nominal(self) -> Nominal | None:
        """Return the nominal model with which the feedforward follows y_m, or None.

        If `observer.part` is 0, neither feedforward nor observer acts on u yet. A learner needs the
        states of the model nevertheless. So with a learner this method returns the model in a form
        that has no effect on u, and without a learner it returns None.
        """
        nominal = self.nominal()
        if nominal is None or self.observer is None or self.observer.part > 0.0:
            return nominal
        return nominal._replace(acts=np.zeros(len(self.inputs))) if self.history_ticks() else None

    def digest(self) -> int:
        """Compute a hash of the parameters of law and guard, from 0 to 2^48 - 1.

        The BLAKE2b hash of names and values changes with any bit of any gain. A float64 represents
        the result exactly. Parameters that concern only the node are left out.
        """
        content = self.model_dump(exclude=OF_NODE)
        # Older versions had only RISE-DI, and the digests in their logs do not include its name.
        if content["law"] == "rise_di":
            del content["law"]
        return int.from_bytes(
            blake2b(json.dumps(sorted(flatten(content))).encode(), digest_size=6).digest(), "big"
        )

    def probe_gain(self) -> FloatArray:
        """Compute the gain abs(y_i / u_i) at the frequency of the sine on each input, shape (m,).

        An input without a sine has the gain 0. The gain is computed from C (j omega I - A -
        gravity)^-1 B if there is a nominal model, and otherwise from 1 / (input_scale omega). The
        lag of the actuator is included.
        """
        gain = np.zeros(len(self.outputs))
        if self.probe is None:
            return gain
        nominal = self.nominal()
        for i, harmonic in enumerate(self.probe.harmonics(self.outputs, self.input_scale).tolist()):
            omega = 2.0 * np.pi * harmonic / self.probe.window
            if omega == 0.0:
                continue
            response = 1.0 / (self.input_scale[i] * omega)
            if nominal is not None:
                dynamics = 1j * omega * np.eye(len(nominal.A)) - nominal.A - nominal.gravity
                response = abs(nominal.C[i] @ np.linalg.solve(dynamics, nominal.B[:, i]))
            gain[i] = response / abs(1.0 + 1j * omega * self.lag[i])
        return gain

    def _probe(self) -> Probe | None:
        """Build the probe from the section `probe`, or return None without this section.

        The section states by how much each output may move. `probe_gain` converts that to the
        amplitudes of the sines in u.
        """
        if self.probe is None:
            return None
        gain = self.probe_gain()
        probed = gain > 0.0
        amplitude = self.probe.amplitudes(self.outputs) / np.where(probed, gain, 1.0)
        window_ns = nanoseconds(self.probe.window)
        return Probe(
            probed * amplitude, self.probe.harmonics(self.outputs, self.input_scale), window_ns
        )

    def _limits(self) -> Limits:
        """Return the limits of u, which are infinite if none is given."""
        unlimited = (np.inf,) * len(self.inputs)
        return Limits(
            -np.array(unlimited) if self.lower is None else np.array(self.lower),
            np.array(self.upper or unlimited),
            np.array(self.slew or unlimited),
        )

    def _authority(self) -> FloatArray:
        """Compute the y_dot that each input gives its output at its limit, (m,), units of y / s."""
        limits = self._limits()
        full = np.minimum(np.maximum(-limits.lower, limits.upper), samples.UNLIMITED)
        return np.asarray(full / np.array(self.input_scale))

    def guard(self) -> GuardParams:
        """Return the parameters of the guard: times, limits, and the nominal model."""
        return GuardParams(
            period_ns=period_ns(self.rate, "rate"),
            max_age_ns=nanoseconds(self.max_age),
            hold_ns=nanoseconds(self.hold),
            ramp_ns=nanoseconds(self.ramp),
            deactivation_holds=self.on_deactivate == "hold",
            limits=self._limits(),
            samples=samples.sample_limits(
                self.outputs, self._authority(), self.y_max, period_ns(self.rate, "rate")
            ),
            history=self.history_ticks(),
            allocation=None if self.allocation is None else self.allocation.arrays(self.inputs),
            nominal=self._flown_nominal(),
            vanes=tuple(self._model_states().index(name) for name in self.vanes),
            probe=self._probe(),
        )

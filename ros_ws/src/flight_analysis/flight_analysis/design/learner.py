# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning in the air: A and B from the last seconds of a flight, checked, and the observer and feedforward of that model.

The identification is that of a log (`model_identification.identify`), about a rough airframe. A model that fails a check is
refused with a sentence. The controller refuses parameters that fail its own checks at load.
"""

from collections import deque
from collections.abc import Callable

import numpy as np

from aircraft_sim.airframe import Airframe
from flight_analysis.closed_loop.learning import Proposal
from flight_analysis.design.gain_selection import ChannelPairing
from flight_analysis.design.innovation_filters import TRANSIENT, Actuation, Recording
from flight_analysis.design.model_identification import PRIOR, Identification, identify
from flight_core.parameters import ParameterError, require
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray
from rise_di_controller.rise_di import RiseDiConfig

MAX_WHITENESS = 3.0  # 1 for white innovations, with a deviation of 0.3: a model with more leaves out what the aircraft does
AT_BOUND = 1  # entries at their bound: the right model may have one that hardly shows, wrong ones have two to six
SHORTEST = 20.0 * TRANSIENT  # s, of a record: two held-out seconds of the six that `identify` needs at least

Design = Callable[[RiseDiConfig, Airframe], RiseDiConfig]
"""The controller with the feedforward and the observer of a model. Raises ParameterError."""


class Learner:
    """The record of y and u over a window, and proposals from it."""

    def __init__(self, controller: RiseDiConfig, airframe: Airframe, design: Design, delay: float = 0.0) -> None:
        """`airframe` is the rough model, the prior; `delay` that of the loop, s, beyond sampling and lags.

        Raises ParameterError for a controller that does not learn.
        """
        settings = controller.learn
        require(settings is not None, "controller.learn", "no such section", "one: a window and times of identifications")
        assert settings is not None  # noqa: S101 - for the type checker
        self._controller, self._airframe, self._design = controller, airframe, design
        self._period = 1.0 / controller.rate
        lag = dict(zip(controller.inputs, controller.lag, strict=True))
        self._actuation = Actuation(np.array([lag[name] for name in airframe.inputs]), delay)
        self._record: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._window_ns = nanoseconds(settings.window)
        self.identification: Identification | None = None  # the last one
        self._has_model = False

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray) -> None:
        """Record y and u, after its limits, of a tick, (m,), in the law's order."""
        if not self._record or stamp_ns > self._record[-1][0]:
            self._record.append((stamp_ns, y, u))
        while stamp_ns - self._record[0][0] >= self._window_ns:
            self._record.popleft()

    def recording(self) -> Recording:
        """The record in equal periods, in the airframe's order; y of a lost tick is NaN, u is held."""
        stamp_ns = np.array([row[0] for row in self._record])
        place = np.round((stamp_ns - stamp_ns[0]) * 1e-9 / self._period).astype(int)
        place, kept = np.unique(place, return_index=True)
        y, u = (np.array([row[column] for row in self._record])[kept] for column in (1, 2))
        t = seconds(int(stamp_ns[0])) + self._period * np.arange(place[-1] + 1)
        whole = np.full((len(t), y.shape[1]), np.nan)
        whole[place] = y
        held = u[np.searchsorted(place, np.arange(len(t)), side="right") - 1]
        of_y, of_u = self._controller.outputs, self._controller.inputs
        y, u = (
            np.stack([values[:, own.index(name)] for name in names], axis=1)
            for values, own, names in ((whole, of_y, self._airframe.outputs), (held, of_u, tuple(self._airframe.inputs)))
        )
        return Recording(self._period, t, y, u)

    def propose(self) -> Proposal:
        """Parameters with the observer and the feedforward of the identified model, or the sentence of a refusal.

        Before the first model, a rough airframe that explains the flight as it is, with white innovations, is taken itself.
        """
        if len(self._record) < SHORTEST / self._period:
            return Proposal(None, f"record: found {len(self._record) * self._period:.3g} s, expected {SHORTEST:g} s")
        channels = ChannelPairing(self._controller.outputs, self._controller.inputs)
        found = self.identification = identify(self.recording(), self._airframe, self._actuation, channels, at_bound=AT_BOUND)
        rough = not self._has_model and found.before.whiteness.max() <= MAX_WHITENESS and explains(found)
        refusal = "" if rough else found.refusal or not_white(found)
        if refusal:
            return Proposal(None, refusal)
        try:
            model = self._airframe if rough else found.airframe
            designed = self._design(self._controller.model_copy(update={"learn": None}), model)
            values = designed.model_dump() | {"learn": self._controller.model_dump()["learn"]}
            proposed = RiseDiConfig.validate_mapping(values, "proposal")
        except ParameterError as error:
            return Proposal(None, str(error))
        self._has_model = True
        return Proposal(proposed, f"the airframe {self._airframe.name} as it is" if rough else sentence(found))


def explains(found: Identification) -> bool:
    """Whether the nominal airframe predicts the held-out samples as well as the identified model."""
    return bool(found.after.log_likelihood <= found.before.log_likelihood)


def not_white(found: Identification) -> str:
    """The output with the least white innovations, if above MAX_WHITENESS."""
    worst = int(np.argmax(found.after.whiteness))
    white = float(found.after.whiteness[worst])
    if white <= MAX_WHITENESS:
        return ""
    name = found.airframe.outputs[worst]
    return f"innovations of {name}: found a whiteness of {white:.3g}, expected at most {MAX_WHITENESS:g}, 1 being white"


def sentence(found: Identification) -> str:
    """The effects of inputs on outputs that the flight shows, relative to the rough airframe, with deviations."""
    effects = (entry for entry in found.entries if entry.matrix == "B" and entry.row in found.airframe.outputs)
    known = (entry for entry in effects if entry.deviation < PRIOR / 2.0)
    return ", ".join(f"{entry.name} {100 * entry.error:+.0f} +- {100 * entry.deviation:.0f} %" for entry in known)

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read a flight of the controller that was exported into PX4, from the ULog topic rise_di_status.

The ticks become the signal `internals`, and a replay computes them again.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from flight_analysis.closed_loop.replay_ticks import vary
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS, seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray, StampedVector
from flight_log.vehicle_tables import MessageTable, VehicleLog
from rise_di_controller import internals
from rise_di_controller.guard import guard, retuning
from rise_di_controller.params import ControllerConfig

STATUS = "rise_di_status"
MICROSECONDS = 1000  # ns
CHANNELS = ("y", "y_m", "e", "u", "u_end")
EXPECTED = "a ULog of the module of `rise-di export --px4`, with rise_di_status in its topics"


class ModuleChange(NamedTuple):
    """Parameters of the controller that changed in flight before a tick."""

    stamp_ns: int
    values: Mapping[str, Any]


class ModuleFlight(NamedTuple):
    """What a controller exported into PX4 logged at its ticks: y, y_m, u and `internals`.

    `equal` is the number of ticks whose u has the same bits when Python computes it. `lost` is the
    number of ticks after a gap of the log, which Python cannot compute.
    """

    tape: Tape
    changes: tuple[ModuleChange, ...]
    equal: int
    lost: int


def module_flight(log: VehicleLog, controller: ControllerConfig) -> ModuleFlight:
    """Compute the ticks of a controller that was exported into PX4 again in Python.

    A stretch is the ticks from an engagement to the first gap or to the next engagement. Python
    starts each stretch with the u of its first tick in the log. In the signal `internals`, e and u
    come from the log, and the states of the law come from Python. At low airspeed the largest
    torque, 1, may limit u more than the parameters do. Such limits of u are treated as changed
    parameters. Raises ParameterError if the log has no ticks, or if the flight had other parameters
    than `controller`. It is also raised if the export computes in single precision, or if the law
    refuses a tick.
    """
    require(STATUS in log.tables, "the log", f"no {STATUS}", EXPECTED)
    table = log.tables[STATUS]
    ticks = _Ticks(table, controller)
    indices = ticks.flown()
    require(len(indices) > 0, "the log", "no tick of RISE-DI", "a flight with RDI_EN 1")
    return ticks.computed(indices)


class _Ticks:
    """The rows of the topic rise_di_status."""

    def __init__(self, table: MessageTable, controller: ControllerConfig) -> None:
        m = len(controller.outputs)
        names = [f"{channel}[{i}]" for channel in CHANNELS for i in range(m)]
        names += ["timestamp_sample", "parameters", "number", "refusal", "y_m_offset"]
        missing = ", ".join(name for name in names if name not in table.fields)
        require(not missing, STATUS, f"no {missing}", "the message of this version of the export")
        require(
            f"y[{m}]" not in table.fields,
            STATUS,
            f"more than {m} channels",
            f"the channels of the scenario: {', '.join(controller.outputs)}",
        )
        digests = np.unique(table.fields["parameters"])
        same = len(digests) == 1 and digests[0] == controller.digest()
        require(
            same,
            f"{STATUS}.parameters",
            ", ".join(f"{digest:012x}" for digest in digests.astype(np.int64)),
            f"{controller.digest():012x}, the digest of the exported scenario",
        )
        self._controller = controller
        self._now_ns = table.stamp_ns
        self._stamp_ns = MICROSECONDS * table.fields["timestamp_sample"].astype(np.int64)
        self._number = table.fields["number"].astype(np.int64)
        flies = table.fields["refusal"] == 0.0
        self._ticked = flies & (np.diff(self._stamp_ns, prepend=-1) != 0) & (self._number > 0)
        self._offset_ns = np.round(table.fields["y_m_offset"] * NANOSECONDS).astype(np.int64)
        self._values: dict[str, FloatArray] = {
            channel: np.column_stack([table.fields[f"{channel}[{i}]"] for i in range(m)])
            for channel in CHANNELS
        }
        u = self._values["u"][flies]
        is_float = bool((u == u.astype(np.float32)).all() and u.any())
        require(
            not is_float, STATUS, "u of --float32", "a module in double: Python computes in double"
        )

    def flown(self) -> list[list[int]]:
        """Return the rows of the ticks, one list for each stretch.

        A stretch begins at an engagement, and ends at a gap or at the next engagement.
        """
        stretches: list[list[int]] = []
        last: int | None = None  # number of the previous tick; None if the stretch has ended
        for k in np.flatnonzero(self._ticked).tolist():
            number = int(self._number[k])
            if number == 1:
                stretches.append([k])
                last = number
            elif last is not None and number == last + 1:
                stretches[-1].append(k)
                last = number
            else:
                last = None
        return stretches

    def computed(self, stretches: list[list[int]]) -> ModuleFlight:
        """Return the ticks with the states that Python computes."""
        controller = self._controller
        law = controller.tuned_law()
        limits = controller.guard()
        digest = controller.digest()
        changes: list[ModuleChange] = []
        rows: list[FloatArray] = []
        equal = 0
        number = 1  # the first tick of a stretch cannot be checked, and leaves a gap in the numbers
        for stretch in stretches:
            state = guard.initial_state(len(controller.inputs), None)
            state = state._replace(u=self._values["u"][stretch[0]].copy())
            number += 1
            for k in stretch:
                # If the limits of a row differ from those of the previous row, the parameters
                # changed.
                change = self._limits(k)
                if any(getattr(controller, key) != value for key, value in change.items()):
                    controller = vary(controller, change)
                    changes.append(ModuleChange(int(self._stamp_ns[k]), change))
                    new_law = controller.tuned_law()
                    new_limits = controller.guard()
                    state = retuning.retune_state(state, law, new_law, (limits, new_limits))
                    law = new_law
                    limits = new_limits
                    digest = controller.digest()
                # Compute the tick from the logged y and y_m, and compare it with the logged u.
                stamp_ns = int(self._stamp_ns[k])
                y_m = [StampedVector(stamp_ns, self._values["y_m"][k])]
                if self._offset_ns[k] > 0:
                    y_m.append(y_m[0]._replace(stamp_ns=stamp_ns + int(self._offset_ns[k])))
                sample = StampedVector(stamp_ns, self._values["y"][k])
                now_ns = int(self._now_ns[k])
                state, inputs = guard.tick(state, now_ns, sample, y_m, limits, law, True)
                if inputs is None:
                    raise ParameterError(
                        f"{STATUS}: found a tick in row {k} that the law refuses, "
                        "expected the samples and the stamps of a flight of the export"
                    )
                u = self._values["u"][k]
                equal += state.u.tobytes() == u.tobytes()
                age = seconds(now_ns - stamp_ns)
                logged = state._replace(u=u)
                rows.append(
                    internals.values(logged, inputs, limits, 0.0, age, number, digest, np.zeros(0))
                )
                number += 1
        return self._flight(stretches, rows, changes, equal)

    def _limits(self, k: int) -> dict[str, tuple[float, ...]]:
        """Return the limits of u in the tick k.

        For each input, the narrower limits are taken: the limits in the scenario, or a torque
        of 1.
        """
        end = self._values["u_end"][k]
        exported = self._controller.guard().limits
        return {
            "lower": tuple(np.maximum(exported.lower, -end).tolist()),
            "upper": tuple(np.minimum(exported.upper, end).tolist()),
        }

    def _flight(
        self,
        stretches: list[list[int]],
        rows: list[FloatArray],
        changes: list[ModuleChange],
        equal: int,
    ) -> ModuleFlight:
        controller = self._controller
        order = np.concatenate([np.array(stretch) for stretch in stretches])
        stamps = self._stamp_ns[order]
        groups = {"y": controller.outputs, "y_m": controller.outputs, "u": controller.inputs}
        signals = {
            name: Signal(stamps, channels, self._values[name][order])
            for name, channels in groups.items()
        }
        names = internals.names(controller.logged_groups())
        values = np.array(rows)
        values[:, [names.index(f"e.{name}") for name in controller.outputs]] = self._values["e"][
            order
        ]
        signals["internals"] = Signal(stamps, names, values)
        lost = int(self._ticked.sum()) - len(order)
        return ModuleFlight(Tape(signals, int(stamps[0])), tuple(changes), equal, lost)

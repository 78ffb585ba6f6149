# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Print what `rise-di tune` makes of logs that lack something, beside the truth, as CSV.

The logs are of linear airplanes with known A and B: that of examples/px4_airplane with other
inertias, and that of examples/arduplane with other effects. In a bank gravity moves the sideslip. A
rate controller of PX4's form flies doublets of each rate for a minute.

    python -m benchmarks.tune_logs > docs/evidence/tables/export-logs.csv
"""

import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.excitation import gust_warning, own_shares
from flight_design.identification.innovation_filters import Actuation, FlightData, coarser
from flight_design.identification.model_quality import NoBetter
from flight_design.identification.rates_log import SPARSE, scaled_torques
from flight_design.identification.rates_model import banking, identify_rates

ROOT = Path(__file__).parents[1]
STEP = 5e-4  # step of the simulation, s
APART = 3.0  # time from one doublet to the next, s
LENGTH = 72.0  # duration of a flight, s
SEED = 7
HEADINGS = (
    "log",
    "entry",
    "true change (%)",
    "found (%)",
    "stated deviation (%)",
    "deviations off (1)",
    "verdict",
)


class Case(NamedTuple):
    """A log, and what it lacks."""

    name: str
    still: str = ""  # output that the autopilot does not control
    silent: str = ""  # output without doublets
    every: int = 1  # periods from one logged u to the next
    lost: float = 0.0  # share of the samples of y that the log lacks
    hole: float = 0.0  # duration of a gap in y, s
    colour: float = 0.0  # noise of y: e_k = colour e_(k-1) + white noise
    late: float = 0.0  # delay of u that `rise-di tune` does not know, s
    gusts: float = 0.0  # m/s rms
    climb: float = 0.0  # trim of the elevator in the first third, which has no doublets, rad
    # effects of each surface on roll, pitch and yaw by PX4's CA_SV_CSk_TRQ; empty: each axis has a
    # surface of its own
    surfaces: tuple[tuple[float, float, float], ...] = ()
    plane: str = "px4_airplane"  # a key of PLANES


CASES = (
    Case("nothing is missing"),
    Case("yaw is not controlled", still="r"),
    Case("no doublets of roll", silent="p"),
    Case("the torque each 20 ms", every=5),
    Case("a tenth of y and 8 s are lost", lost=0.1, hole=8.0),
    Case("coloured noise", colour=0.5),
    Case("u acts 2 ms later", late=0.002),
    Case("gusts of 0.5 m/s", gusts=0.5),
    Case("gusts, coloured noise, u 2 ms later", gusts=0.5, colour=0.5, late=0.002),
    Case("a climb before the doublets", climb=0.04),
    Case("two ailerons", surfaces=((-0.5, 0, 0), (0.5, 0, 0), (0, 1, 0), (0, 0, 1))),
    Case("two ailerons at 1", surfaces=((-1, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))),
    Case("elevons and a rudder", surfaces=((-0.5, 0.5, 0), (0.5, 0.5, 0), (0, 0, 1))),
    Case(
        "ailerons and a V-tail",
        surfaces=((-0.5, 0, 0), (0.5, 0, 0), (0, 0.5, 0.5), (0, 0.5, -0.5)),
    ),
    Case("another airframe", plane="heavy"),
    Case("a quadrotor", plane="px4_quadrotor"),
    Case("ArduPlane, servos at 25 Hz", every=8, plane="arduplane"),
)


class Plane(NamedTuple):
    """An airplane and its autopilot, channels in the airframe's order."""

    period: float  # period of the autopilot and of the log, s
    size: tuple[float, ...]  # size of a doublet by channel, rad/s
    noise: tuple[float, ...]  # standard deviation of the noise of y by channel, rad/s
    gains: tuple[tuple[float, ...], ...]  # FF, P and I of the autopilot, each by channel
    end: float  # u at the torque 1, rad
    changes: Mapping[str, float]  # true over nominal row of A and B, by output
    lag: float  # lag of the actuators, s
    folder: str  # folder of its scenario in examples/


PLANES: dict[str, Plane] = {
    "px4_airplane": Plane(
        period=0.004,
        size=(0.3, 0.6, 0.2),
        noise=(0.05, 0.1, 0.02),
        gains=((0.331, 0.206, 0.259), (0.086, 0.05, 0.4155), (1.19, 2.95, 10.0)),
        end=0.261799,
        changes={"q": 1.0 / 0.9, "p": 1.0 / 1.3, "r": 1.0 / 1.5},
        lag=0.0,
        folder="px4_airplane",
    ),
    "arduplane": Plane(
        period=0.005,
        size=(0.3, 0.6),
        noise=(0.01, 0.01),
        gains=((0.25, 0.2), (0.3, 0.2), (0.5, 0.5)),
        end=0.5,
        changes={"q": 0.9, "p": 0.85},
        lag=0.03,
        folder="arduplane",
    ),
    "px4_quadrotor": Plane(
        period=0.004,
        size=(0.6, 0.6, 0.4),
        noise=(0.02, 0.02, 0.02),
        gains=((0.0, 0.0, 0.0), (0.15, 0.15, 0.2), (0.2, 0.2, 0.1)),
        end=1.0,
        changes={"q": 0.8, "p": 0.75, "r": 1.3},
        lag=0.02,
        folder="px4_quadrotor",
    ),
}
PLANES["heavy"] = PLANES["px4_airplane"]._replace(changes=dict.fromkeys("qpr", 0.3))


def nominal_of(plane: Plane) -> Airframe:
    """Return the airframe of the rates that the scenario of a plane has."""
    folder = ROOT / "examples" / plane.folder
    if plane.folder != "px4_quadrotor":
        return load_airframe(str(folder / "rates_airframe.yaml"))
    whole = load_airframe(str(folder / "airframe.yaml"))
    rows = [whole.index(name) for name in ("q", "p", "r")]
    columns = [list(whole.inputs).index(name) for name in ("pitch", "roll", "yaw")]
    return whole.model_copy(
        update={
            "states": {name: whole.states[name] for name in ("q", "p", "r")},
            "inputs": {name: whole.inputs[name] for name in ("pitch", "roll", "yaw")},
            "outputs": ("q", "p", "r"),
            "A": whole.matrix_a()[np.ix_(rows, rows)].tolist(),
            "B": whole.matrix_b()[np.ix_(rows, columns)].tolist(),
        }
    )


def true_model(nominal: Airframe, plane: Plane) -> tuple[FloatArray, FloatArray]:
    """Return A and B of the aircraft that flies, a fixed wing with the bank angle as last state."""
    banked = banking(nominal)
    A, B = banked.matrix_a(), banked.matrix_b()
    for name, factor in plane.changes.items():
        A[nominal.index(name)] *= factor
        B[nominal.index(name)] *= factor
    return A, B


class Allocation(NamedTuple):
    """How PX4 turns the torques of the axes into servos, and what the servos do.

    Torques and servos are shares of their end stops.
    """

    servos: FloatArray  # servos for the torques of the axes, (surfaces, m)
    on_axes: FloatArray  # effect of the servos on the axes, (m, surfaces)


def allocated(case: Case, outputs: Sequence[str]) -> Allocation:
    """Return the allocation of a case: PX4's pseudo-inverse, and the effects of the surfaces.

    An axis is at its end stop if all its surfaces are at theirs.
    """
    if not case.surfaces:
        return Allocation(np.eye(len(outputs)), np.eye(len(outputs)))
    effects = np.array(case.surfaces).T[["pqr".index(name) for name in outputs]]
    return Allocation(np.linalg.pinv(effects), effects / np.abs(effects).sum(axis=1)[:, None])


def flown(case: Case, nominal: Airframe, plane: Plane) -> FlightData:
    """Fly a case, and return what its log has."""
    rng = np.random.default_rng(SEED)
    A, B = true_model(nominal, plane)
    banked = banking(nominal)
    C = banked.matrix_c()
    n, m = B.shape
    outputs = list(nominal.outputs)
    both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * STEP)
    count, steps = int(LENGTH / plane.period), round(plane.period / STEP)
    FF, P, gain = (np.array(row) for row in plane.gains)
    controlled = np.array([name != case.still for name in outputs], dtype=float)
    axes = [i for i, name in enumerate(outputs) if name not in (case.still, case.silent)]
    allocation = allocated(case, outputs)
    follows = 1.0 - np.exp(-STEP / plane.lag) if plane.lag else 1.0
    line = [np.zeros(m)] * round(case.late / STEP)
    G = len(nominal.gusts)
    x, integral, noise, position = np.zeros(n), np.zeros(m), np.zeros(m), np.zeros(m)
    air = np.zeros(G)
    y, u = np.zeros((count, m)), np.zeros((count, m))
    for k in range(count):
        number, phase = divmod(k * plane.period, APART)
        setpoint = np.zeros(m)
        is_climbing = bool(case.climb) and k < count // 3
        axis = axes[int(number) % len(axes)]
        setpoint[axis] = plane.size[axis] * ((phase < 0.5) - float(0.5 <= phase < 1.0))
        if is_climbing:
            setpoint = np.zeros(m)
        noise = case.colour * noise + np.sqrt(1.0 - case.colour**2) * rng.normal(size=m)
        y[k] = C @ x + np.array(plane.noise) * noise
        error = setpoint - y[k]
        integral = np.clip(integral + gain * error * plane.period, -0.4, 0.4)
        torque = controlled * np.clip(FF * setpoint + P * error + integral, -1.0, 1.0)
        u[k] = plane.end * torque
        acting = plane.end * allocation.on_axes @ np.clip(allocation.servos @ torque, -1.0, 1.0)
        if is_climbing:
            acting[outputs.index("q")] -= case.climb
        for _ in range(steps):
            line.append(acting)
            air = air - air * STEP / 0.5 + case.gusts * np.sqrt(4.0 * STEP) * rng.normal(size=G)
            position = position + follows * (line.pop(0) - position)
            x = both[:n, :n] @ x + both[:n, n:] @ position + STEP * banked.matrix_gusts() @ air
    return logged(case, plane, y, u, rng)


def logged(
    case: Case, plane: Plane, y: FloatArray, u: FloatArray, rng: np.random.Generator
) -> FlightData:
    """Return what a log keeps of y and u.

    If u is logged rarely, the u between two samples is taken as linear.
    """
    is_lost = rng.random(len(y)) < case.lost
    begin = len(y) // 2
    is_lost[begin : begin + round(case.hole / plane.period)] = True
    y = np.where(is_lost[:, None], np.nan, y)
    t = np.arange(len(y), dtype=np.float64) * plane.period
    if case.every == 1:
        return coarser(FlightData(plane.period, t, y, u), max(1, round(0.008 / plane.period)))
    rare = FlightData(
        case.every * plane.period, t[:: case.every], y[:: case.every], u[:: case.every]
    )
    following = np.vstack([rare.u[1:], rare.u[-1:]])
    return rare._replace(u=(rare.u + following) / 2.0)


def rows(case: Case) -> list[list[str]]:
    """Return the rows of a case: one for each entry, or one for a log that is refused at once."""
    plane = PLANES[case.plane]
    nominal = nominal_of(plane)
    recorded = flown(case, nominal, plane)
    pairing = ChannelPairing(nominal.outputs, tuple(nominal.inputs))
    period = case.every * plane.period
    if case.plane != "arduplane" and case.every > SPARSE:
        sentence = f"refused: torque: found a sample each {1e3 * period:.0f} ms, expected each one"
        return [[case.name, "", "", "", "", "", sentence]]
    still = [each for each in own_shares(recorded, nominal, pairing) if each.is_still]
    if still:
        return [[case.name, "", "", "", "", "", f"refused: {each.sentence}"] for each in still]
    timing = period / np.sqrt(12.0) / (2.0 if case.every > 1 else 1.0)
    actuation = Actuation(np.full(len(nominal.inputs), plane.lag), 0.0)
    found = identify_rates(recorded, nominal, actuation, pairing, timing=timing)
    parameters = {"CA_SV_CS_COUNT": float(len(case.surfaces))}
    for k, effects in enumerate(case.surfaces):
        for letter, effect in zip("RPY", effects, strict=True):
            parameters[f"CA_SV_CS{k}_TRQ_{letter}"] = effect
    warnings = "".join(f"; warning: {sentence}" for sentence in scaled_torques(parameters))
    A, B = true_model(nominal, plane)
    allocation = allocated(case, nominal.outputs)
    B = B @ allocation.on_axes @ allocation.servos  # effects of the torques of the log
    inputs = list(nominal.inputs)
    lines = []
    for part in found.parts:
        refusal = part.refusal
        kept = (
            "kept nominal" if part.after.log_likelihood <= part.before.log_likelihood else "taken"
        )
        kept += ", with a warning of gusts" if gust_warning(part) else ""
        is_refused = refusal is not None and not isinstance(refusal, NoBetter)
        for entry in part.entries:
            row = nominal.index(entry.row)
            is_A = entry.matrix == "A"
            value = (
                A[row, nominal.index(entry.column)] if is_A else B[row, inputs.index(entry.column)]
            )
            if not entry.nominal:
                continue
            true = float(value / entry.nominal - 1.0)
            off = abs(entry.error - true) / entry.deviation
            figures = (100 * true, 100 * entry.error, 100 * entry.deviation, off)
            verdict = (f"refused: {refusal}" if is_refused else kept) + warnings
            lines.append([case.name, entry.name, *(f"{figure:.1f}" for figure in figures), verdict])
    return lines


def main() -> None:
    """Print the table."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(HEADINGS)
    for case in CASES:
        writer.writerows(rows(case))
        sys.stdout.flush()


if __name__ == "__main__":
    main()

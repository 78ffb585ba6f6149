# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The counterexample to Theorem 1 as a rule for gains.

Plots docs/images/counterexample.png, and prints the table of the theory page.

python -m benchmarks.counterexample    # half a minute
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks.tables import plain, save_picture
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from flight_core.vectors import FloatArray

IMAGE = Path(__file__).resolve().parents[1] / "docs" / "images" / "counterexample.png"
K, LAMBDA, BOUND = 10.0, 1.0, 1.0  # 1/s, 1/s, bound of abs(f_dot)
SLOPE = 100.0 * K  # slope of f_dot over e_dot, 1/s: it is above K, so that e = 0 repels
BETAS = (2.0, 20.0, 100.0, 1000.0)
DURATION = 1.5  # s, of the flights in the figure
FLIGHTS = ((2.0, 1.0), (20.0, 1.0), (200.0, 1.0), (2.0, 0.0))  # beta, and whether f acts
COLOURS = ("#1f6f8b", "#c8553d", "#5a8f29", "#888888")


class Cycle(NamedTuple):
    """The half period with e > 0 of the limit cycle of a beta.

    In the other half period e and e_dot have the opposite sign.
    """

    beta: float
    t: FloatArray  # (N,) s, from one crossing of e = 0 to the next
    e: FloatArray  # (N,)
    e_dot: FloatArray  # (N,)

    @property
    def f_dot(self) -> FloatArray:
        """The derivative of f: BOUND sat(SLOPE e_dot / BOUND), shape (N,)."""
        return np.clip(SLOPE * self.e_dot, -BOUND, BOUND)

    @property
    def gamma_2(self) -> float:
        """The smallest gamma_2 of (40) on this flight, 1/s.

        It is the ratio of the integrals of abs(e_dot) and abs(e).
        """
        return float(np.trapezoid(np.abs(self.e_dot), self.t) / np.trapezoid(self.e, self.t))

    @property
    def multipliers(self) -> FloatArray:
        """The two factors by which a small deviation d of e grows over half a period, (2,).

        The deviation does not change f, which is a function of time. Between the crossings of e = 0
        it obeys d_ddot + K d_dot + K LAMBDA d = 0. At a crossing d_dot jumps by -2 beta d /
        abs(e_dot). The factors are the moduli of the eigenvalues, in rising order.
        """
        between = expm(np.array([[0.0, 1.0], [-K * LAMBDA, -K]]) * self.t[-1])
        crossing = np.array([[1.0, 0.0], [-2.0 * self.beta / abs(self.e_dot[-1]), 1.0]])
        return np.sort(np.abs(np.linalg.eigvals(crossing @ between)))


def formula(beta: float) -> float:
    """Compute the largest abs(e) of the limit cycle, which a large beta and SLOPE approach.

    It is 9 BOUND^2 / (8 K^2 beta).
    """
    return 9.0 * BOUND**2 / (8.0 * K**2 * beta)


def half_period(speed: float, beta: float, acts: float = 1.0) -> Any:
    """Solve e_ddot + K e_dot + K LAMBDA e + beta sgn(e) = f_dot over half a period.

    The solution goes from e = 0, e_dot = speed to the next crossing of e = 0. f_dot is BOUND
    sat(SLOPE e_dot / BOUND); with acts = 0 it is 0. By symmetry the half period with e < 0 has the
    opposite sign.
    """

    def w_dot(_: float, w: FloatArray) -> list[float]:
        f_dot = acts * min(max(SLOPE * w[1], -BOUND), BOUND)
        return [w[1], f_dot - K * w[1] - K * LAMBDA * w[0] - beta]

    def crossing(_: float, w: FloatArray) -> float:
        return float(w[0])

    crossing.terminal, crossing.direction = True, -1.0  # type: ignore[attr-defined]
    scale = speed / beta  # time until the peak if nothing damped e, s
    return solve_ivp(
        w_dot,
        (0.0, 100.0 * scale),
        np.array([0.0, speed]),
        "DOP853",
        events=crossing,
        dense_output=True,
        first_step=scale / 20.0,
        max_step=scale / 5.0,
        rtol=1e-9,
        atol=1e-9 * scale * speed,
    )


def limit_cycle(beta: float) -> Cycle:
    """Find the limit cycle: half a period ends with minus the e_dot with which it begins.

    The cycle exists for beta > BOUND and SLOPE > K.
    """
    energy_balance = 1.5 * BOUND / K
    speed = brentq(
        lambda v: float(-half_period(v, beta).y[1, -1] - v),
        0.3 * energy_balance,
        3.0 * energy_balance,
        xtol=1e-10,
    )
    solved = half_period(speed, beta)
    t = np.linspace(0.0, solved.t[-1], 4001)
    return Cycle(beta, t, *solved.sol(t))


def peaks(beta: float, acts: float) -> tuple[FloatArray, FloatArray]:
    """Return times, s, and sizes of the peaks of abs(e) of a flight from e = 0, e_dot = 1.

    `acts` says whether f acts, as for `half_period`.
    """
    t, speed, times, sizes = 0.0, 1.0, [], []
    while t < DURATION:
        solved = half_period(speed, beta, acts)
        times.append(t + solved.t[-1] / 2.0)
        sizes.append(float(np.max(solved.sol(np.linspace(0.0, solved.t[-1], 50))[0])))
        t, speed = t + solved.t[-1], float(-solved.y[1, -1])
    return np.array(times), np.array(sizes)


def plot(cycles: list[Cycle]) -> Figure:
    """Plot the peaks of abs(e) over time, with and without f, and their limit over beta.

    The panel of the limit also has the curve of `formula`.
    """
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    over_time, over_beta = figure.subplots(1, 2)
    for (beta, acts), colour in zip(FLIGHTS, COLOURS, strict=True):
        t, e = peaks(beta, acts)
        label = f"beta = {beta:g}" + ("" if acts else ", f = 0")
        over_time.semilogy(
            t, e, color=colour, linewidth=1.4, linestyle="-" if acts else "--", label=label
        )
    betas = np.array([cycle.beta for cycle in cycles])
    over_beta.loglog(
        betas,
        [formula(beta) for beta in betas],
        color="black",
        linewidth=1.0,
        label="9 d²/(8 K² beta)",
    )
    over_beta.loglog(
        betas, [np.max(cycle.e) for cycle in cycles], "o", color=COLOURS[1], label="simulated"
    )
    plain(over_time, "peaks of |e| over t in s")
    plain(over_beta, "limit of |e| over beta")
    for axis in (over_time, over_beta):
        axis.legend(frameon=False, fontsize=9)
    return figure


def main() -> None:
    """Find the limit cycles, write the plot and print the figures that the theory page states."""
    cycles = [limit_cycle(beta) for beta in BETAS]
    save_picture(plot(cycles), IMAGE, colours=48)
    for cycle in cycles:
        required = BOUND * (1.0 + cycle.gamma_2 / LAMBDA)
        slow, fast = cycle.multipliers
        print(
            f"beta {cycle.beta:g}: limit of |e| {np.max(cycle.e):.4g}, formula "
            f"{formula(cycle.beta):.4g}, (29) asks for"
            f" beta >= {required:.0f}, half a period {cycle.t[-1]:.3g} s, multipliers "
            f"{slow:.3f}, {fast:.3f}"
        )


if __name__ == "__main__":
    main()

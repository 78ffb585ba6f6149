# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Plot docs/images/lyapunov.png: V1, V2, e and r of the small example.

One beta meets (29), (30) and one does not.

python -m benchmarks.lyapunov
"""

from pathlib import Path

import numpy as np
from benchmarks.tables import plain, save_picture
from matplotlib.figure import Figure

from flight_design.gains.lyapunov import Evidence, evidence, example, fly_known_plant, lemma_2

IMAGE = Path(__file__).resolve().parents[1] / "docs" / "images" / "lyapunov.png"
DT, DURATION = 0.01, 60.0  # s
TOO_SMALL = 0.05
COLOURS = ("#1f6f8b", "#c8553d")


def flights() -> dict[str, Evidence]:
    """Fly the same flight with beta and with 0.05 beta.

    Both have the constant zeta_b of Lemma 2 for the first.
    """
    case = example(DT, DURATION)
    evidence_by_beta = {}
    zeta_b = 0.0
    for factor in (1.0, TOO_SMALL):
        params = case.params._replace(beta=factor * case.params.beta)
        flight = fly_known_plant(case.plant, case.y_m, DT, params, case.x_0)
        zeta_b = zeta_b or lemma_2(case.plant, evidence(case.plant, flight, params), params)
        evidence_by_beta[f"beta = ({', '.join(f'{b:g}' for b in params.beta)})"] = evidence(
            case.plant, flight, params, zeta_b
        )
    return evidence_by_beta


def plot(evidence_by_beta: dict[str, Evidence]) -> Figure:
    """Plot four panels over time, with a line for each gain set.

    V1 and the norms of e and r are on log scales, V2 is on a linear one.
    """
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    for (name, signals), colour in zip(evidence_by_beta.items(), COLOURS, strict=True):
        lines = (
            signals.V1,
            signals.V2,
            np.linalg.norm(signals.e, axis=1),
            np.linalg.norm(signals.r, axis=1),
        )
        for axis, line in zip(axes.flat, lines, strict=True):
            axis.plot(signals.t, line, color=colour, linewidth=1.2, label=name)
    for axis, title in zip(
        axes.flat, ("V1 (31)", "V2 = V1 + P (48)", "|e| (3)", "|r| (4)"), strict=True
    ):
        plain(axis, title)
        if not title.startswith("V2"):
            axis.set_yscale("log")
    axes[0, 1].axhline(0.0, color="black", linewidth=0.8)
    for axis in axes[1]:
        axis.set_xlabel("t in s")
    axes[0, 1].legend(frameon=False, fontsize=9)
    return figure


def main() -> None:
    """Fly both gain sets, write the plot and print the figures that the theory page states."""
    evidence_by_beta = flights()
    IMAGE.parent.mkdir(parents=True, exist_ok=True)
    save_picture(plot(evidence_by_beta), IMAGE, colours=16)
    for name, signals in evidence_by_beta.items():
        late = signals.t > 20.0
        e, r = (np.max(np.linalg.norm(signal[late], axis=1)) for signal in (signals.e, signals.r))
        V2 = signals.V2
        P = signals.P
        print(
            f"{name}: V2 {V2[0]:.2f} -> {V2[-1]:.2f}, P >= {P.min():.2f}, past 20 s |e| "
            f"{e:.2g}, |r| {r:.2g}"
        )


if __name__ == "__main__":
    main()

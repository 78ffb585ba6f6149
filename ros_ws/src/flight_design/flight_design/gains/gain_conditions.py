# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: N802 - K, U, Phi and N_d are the paper's names
"""Compute gains of the law by two procedures, and the conditions on gains.

The two procedures are Theorem 1 and the engineering procedure.

The theorem's conditions are sufficient, not necessary, and they contain no actuator.
`theorem_gains` meets them all, but behind servos the loop with its gains is unstable.
`engineering_gains` starts from the lag of the loop. For given gains, `check_theorem` evaluates the
theorem's conditions, and `check_rules` the rules of the engineering procedure. `check_loop`
evaluates what the linear margins of the loop do not cover. `rise_di_controller.law.linear_loop` has
the linear loop and its delay margin.

The crossover lag product of a channel is its bandwidth times the lag of its loop, in rad. This is
the phase in rad that the lag costs at the crossover. A loop that integrates then has a phase margin
of 90 degrees minus this phase. If you take the lag as a pure delay, the gain margin of the loop is
(pi / 2) / product: 2.5 at 0.63, 2.0 at 0.8.

All quantities are in the law's channel order and its scaled inputs v (u = input_scale v), with
which abs(Omega_ii) is about 1.
"""

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from flight_core.parameters import require
from flight_core.vectors import FloatArray
from rise_di_controller.law import law
from rise_di_controller.law.decomposition import decompose
from rise_di_controller.law.law import MIN_GAIN, LawParams, Sign
from rise_di_controller.law.linear_loop import LoopTiming

MIN_K = 1.5
"""1/s, lower bound of K, since (22) requires K > 1. A slower channel gets this K and a smaller
input scale, which is the same loop."""

# factor by which k_g exceeds its bound rho^2 / (4 min(Lambda, 1)). With it, step 2 leaves a third
# of the decay to step 3.
K_G_MARGIN = 1.5
# fraction of the whole decay that step 3 uses; less than the third that is left
MAX_STEP_3_FRACTION = 0.3

MAX_CROSSOVER_LAG_PRODUCT = 0.8
"""rad, bandwidth times the lag of the loop: 46 degrees of phase at the crossover. On the `osprey`
0.63 (36 degrees) leaves a delay margin of 45 ms, and 0.91 (52 degrees) leaves 30 ms, which is less
than the lag of the loop itself."""

MAX_LAMBDA_TO_BANDWIDTH = 0.5
"""Upper bound of Lambda_i / bandwidth. At 0.5 the integral costs atan(0.5) = 27 degrees of phase at
the crossover."""

MAX_BETA_TO_RATE_LIMIT = 0.7
"""Upper bound of beta_i divided by the rate limit of the actuator. At a ratio of 1 the `osprey`'s
yaw rate had a limit cycle, and at 2/3 it had none."""

BOUND_TOLERANCE = 1e-5  # relative tolerance of a bound, because files hold gains with six digits


class GainSet(NamedTuple):
    """The gains of (20)-(22) for m channels."""

    k_g: float  # 1/s
    k_d: FloatArray  # (m - 1,) 1/s
    Lambda: FloatArray  # (m,) 1/s
    beta: FloatArray  # (m,) units of y / s^2

    @property
    def K(self) -> FloatArray:
        """Diagonal of K, equation (22), shape (m,), 1/s."""
        return np.asarray(law.gain(np.array(self.k_g), self.k_d))


class Bounds(NamedTuple):
    """Bounds on the unknown aircraft that Theorem 1 takes as given."""

    # (m, m) upper bounds of abs(U_ij) for j > i; the other entries are zero. In the paper they are
    # zeta_U of (27), and zeta_Psi of (30) if it is given two indices.
    U: FloatArray
    N_d: FloatArray  # (m,) zeta_Nd,i of (19), units of y / s^2
    rho: float  # of (19), 1/s
    # (m,) of Lemma 1, 1/s, which must be assumed, because no bound of it is known
    gamma_2: FloatArray


class Relation(StrEnum):
    """How the value of a condition must lie to its bound."""

    AT_LEAST = "at least"
    AT_MOST = "at most"
    ABOVE = "above"


class GainCondition(NamedTuple):
    """A condition on a gain set: a value and its bound, in a relation."""

    name: str
    channel: int | None  # index of the channel; None for a condition on all channels together
    value: float
    bound: float
    relation: Relation = Relation.AT_LEAST
    is_estimate: bool = False  # whether it depends on gamma_2, an assumption

    @property
    def is_met(self) -> bool:
        """Whether the gain set meets the condition."""
        if self.relation is Relation.ABOVE:
            return self.value > self.bound
        slack = BOUND_TOLERANCE * abs(self.bound)
        if self.relation is Relation.AT_MOST:
            return self.value <= self.bound + slack
        return self.value >= self.bound - slack

    @property
    def margin(self) -> float:
        """Factor by which the gain set meets the condition.

        The factor is below 1 if the condition fails, and 0 if no gain can meet the condition. It is
        NaN for a lower bound of 0.
        """
        if self.relation is not Relation.AT_MOST:
            return self.value / self.bound if self.bound > 0.0 else math.nan
        if self.bound <= 0.0:
            return 0.0
        return self.bound / self.value if self.value > 0.0 else math.inf

    def sentence(self, channels: Sequence[str]) -> str:
        """Write the condition as in "beta (30) of q: found 15, expected at least 29.1".

        `channels` are the names of the outputs y.
        """
        where = self.name if self.channel is None else f"{self.name} of {channels[self.channel]}"
        return f"{where}: found {self.value:.4g}, expected {self.relation} {self.bound:.4g}"


def failing(conditions: Sequence[GainCondition]) -> tuple[GainCondition, ...]:
    """Return the conditions that the gain set does not meet."""
    return tuple(condition for condition in conditions if not condition.is_met)


# Theorem 1


def bound_U(Omegas: FloatArray) -> FloatArray:
    """Return the largest abs(U_ij) for j > i over samples of Omega, shape (m, m).

    `Omegas` has shape (N, m, m). The other entries of the result are 0. U comes from the
    decomposition Omega = S D U (11). The result also bounds the off-diagonal entries of D U D,
    because these have the same magnitudes. Raises DecompositionError if a sample has no such
    decomposition.
    """
    return np.asarray(np.max([np.triu(np.abs(decompose(Omega).U), 1) for Omega in Omegas], axis=0))


def rho(Omega: FloatArray, CAC: FloatArray, Lambda: FloatArray) -> float:
    """Bound norm(N~) / norm(z) of (19), 1/s.

        rho = largest singular value of [I - G Lambda, G],  G = M (C A C^+ + Lambda),  M = S^-1

    Here N~ = G (r - Lambda e) + e. The reference term of (18) is not in this N~, because it is
    taken as a part of N_d. Omega and CAC = C A C^+ have shape (m, m), Lambda has (m,). Raises
    DecompositionError if Omega has no decomposition S D U. Source: (16)-(19) of Tanyer,
    Tatlicioglu, Zergeroglu, with the correction of docs/theory.md.
    """
    G = np.linalg.solve(decompose(Omega).S, CAC + np.diag(Lambda))
    return float(np.linalg.norm(np.hstack([np.eye(len(G)) - G * Lambda, G]), 2))


def least_beta(Lambda: FloatArray, bounds: Bounds) -> FloatArray:
    """Compute the smallest beta of step 1 of Theorem 1, shape (m,), from the last channel up.

        beta_i = (zeta_Nd,i + sum_(j>i) zeta_U,ij beta_j) (1 + gamma_2,i / Lambda_i)

    Source: (29), (30), with the bound zeta_U,ij of two indices that Lemma 2 requires
    (docs/theory.md).
    """
    beta = np.zeros(len(Lambda))
    for i in reversed(range(len(Lambda))):
        beta[i] = (bounds.N_d[i] + bounds.U[i] @ beta) * (1.0 + bounds.gamma_2[i] / Lambda[i])
    return beta


def zeta_Phi(i: int, K: FloatArray, U: FloatArray) -> float:
    """Bound abs(Phi_i) / norm(z), (25)-(27), 1/s.

    The bound is the norm over j > i of zeta_U,ij k_j. K has shape (m,), U (m, m).
    """
    return float(np.linalg.norm(U[i, i + 1 :] * K[i + 1 :]))


def theorem_gains(bounds: Bounds, Lambda: FloatArray) -> GainSet:
    """Compute gains that meet (22), (29), (30) and steps 2 and 3 of Theorem 1 for given bounds.

    The shapes are the shapes in `Bounds` and `GainSet`. `least` is the decay rate of e and r. N~
    uses up a part of this decay in step 2, and Phi uses up another part in step 3:

        least = min(Lambda, 1)
        k_g   = 1.5 rho^2 / (4 least)                                     step 2
        k_d,i = zeta_Phi,i^2 / (4 part), part = 0.3 least / (m - 1)       step 3, i = m-1 .. 1
        beta  = `least_beta`                                              step 1

    so that rho^2 / (4 k_g) + sum zeta_Phi,i^2 / (4 k_d,i) <= (2/3 + 0.3) least. The factors 1.5 and
    0.3 are choices of this project, because the paper only says "small". bounds.rho must belong to
    the same Lambda.
    """
    m = len(Lambda)
    least = min(float(Lambda.min()), 1.0)
    k_g = max(K_G_MARGIN * bounds.rho**2 / (4.0 * least), MIN_GAIN)
    k_d = np.zeros(m - 1)
    for i in reversed(range(m - 1)):
        part = MAX_STEP_3_FRACTION * least / (m - 1)
        k_d[i] = max(
            zeta_Phi(i, np.asarray(law.gain(np.array(k_g), k_d)), bounds.U) ** 2 / (4.0 * part),
            MIN_GAIN,
        )
    return GainSet(k_g, k_d, Lambda, np.maximum(least_beta(Lambda, bounds), MIN_GAIN))


def check_theorem(gains: GainSet, bounds: Bounds) -> tuple[GainCondition, ...]:
    """Evaluate the conditions of Theorem 1 on a gain set.

    The conditions are (29), (30) from the last channel up, and then the conditions of steps 2 and
    3:

        beta_i >= (zeta_Nd,i + sum_(j>i) zeta_U,ij beta_j) (1 + gamma_2,i / Lambda_i)
        k_g >= rho^2 / (4 min(Lambda, 1))
        sum_i zeta_Phi,i^2 / (4 k_d,i) <= min(Lambda, 1) - rho^2 / (4 k_g)

    In the first condition, beta_j is the value in the gain set. The last condition names the
    channel with the largest term. Equation (22) needs no condition, because the gain set states k_g
    and k_d. Raises ParameterError if a gain is not positive.
    """
    for key in GainSet._fields:
        require(
            bool(np.all(np.asarray(getattr(gains, key)) > 0.0)),
            key,
            getattr(gains, key),
            "values above 0",
        )
    m = len(gains.Lambda)
    smallest = (bounds.N_d + bounds.U @ gains.beta) * (1.0 + bounds.gamma_2 / gains.Lambda)
    conditions = [
        GainCondition(
            "beta (29)" if i == m - 1 else "beta (30)",
            i,
            float(gains.beta[i]),
            float(smallest[i]),
            is_estimate=True,
        )
        for i in reversed(range(m))
    ]
    least = min(float(gains.Lambda.min()), 1.0)
    conditions.append(GainCondition("k_g, step 2", None, gains.k_g, bounds.rho**2 / (4.0 * least)))
    terms = np.array(
        [zeta_Phi(i, gains.K, bounds.U) ** 2 / (4.0 * gains.k_d[i]) for i in range(m - 1)]
    )
    if m > 1:
        remaining = least - bounds.rho**2 / (4.0 * gains.k_g)
        largest = int(np.argmax(terms))
        conditions.append(
            GainCondition("k_d, step 3", largest, float(terms.sum()), remaining, Relation.AT_MOST)
        )
    return tuple(conditions)


# The engineering procedure


def bandwidths(loop: LoopTiming, crossover_lag_product: FloatArray) -> FloatArray:
    """Compute the bandwidths of the channels, shape (m,), rad/s.

    Bandwidth i is crossover_lag_product_i / (lag_i + 1.5 period + delay). A product of 0.63 rad
    costs 36 degrees of phase at the crossover, which leaves a phase margin of 90 - 36 = 54 degrees.
    Source: this project.
    """
    return np.asarray(crossover_lag_product / loop.total)


def split_gain(K: FloatArray) -> tuple[float, FloatArray]:
    """Split K = 1 + k_g + (k_d, 0), shape (m,), 1/s, into k_g and k_d of (22).

    k_d is at least 0.01, because (22) requires it to be positive. Raises ParameterError if the last
    K is not the smallest, or is not above 1, because (22) gives no such K.
    """
    require(
        float(K[-1]) <= float(K.min()),
        "K",
        K.tolist(),
        "the smallest in the last channel, as (22) has it",
    )
    require(float(K[-1]) > 1.0, f"K[{len(K) - 1}]", float(K[-1]), "above 1 1/s, as (22) has it")
    return float(K[-1]) - 1.0, np.maximum(K[:-1] - K[-1], MIN_GAIN)


def engineering_gains(
    bandwidth: FloatArray,
    slew: FloatArray,
    factor: float,
    rate_limit: FloatArray,
    slower: FloatArray | float = 1.0,
) -> tuple[GainSet, FloatArray]:
    """Compute gains from the bandwidths (rad/s) of a loop with lag; all arguments have shape (m,).

    Returns the gains, and response_i, which is abs(Omega_ii) in scaled inputs. response_i is less
    than 1 in a channel that is too slow for (22), and 1 in all others.

        K_m = max(bandwidth_m, 1.5),  K_i = max(bandwidth_i, K_m),  response_i = bandwidth_i / K_i
        Lambda_i = bandwidth_i / (4 slower_i)
        beta_i = min(factor slew_i, 0.7 rate_limit_i) / response_i

    The bandwidth of channel i is then K_i response_i. `slew` is the largest rate of the ideal
    control, and `rate_limit` is the rate limit of the actuator (infinite without a limit). Both are
    rates of inputs that are scaled to unit response, so their units are the units of y / s^2.
    Raises ParameterError for a factor below 1. Source: this project. The formula of beta follows
    from N_d = -D U v*_dot at e = 0, see `N_d`.
    """
    require(factor >= 1.0, "factor", factor, "at least 1: beta above the slew of the ideal control")
    K = np.maximum(bandwidth, max(MIN_K, float(bandwidth[-1])))
    response = bandwidth / K
    k_g, k_d = split_gain(K)
    beta = np.maximum(
        np.minimum(factor * slew, MAX_BETA_TO_RATE_LIMIT * rate_limit) / response, MIN_GAIN
    )
    return GainSet(k_g, k_d, bandwidth / (4.0 * slower), beta), response


def N_d(Omega: FloatArray, v_dot: FloatArray) -> FloatArray:
    """Compute N_d of (17) along the ideal control v*, at e = 0: -D U v*_dot.

    The result has the shape of v_dot, (..., m), and units of y / s^2. The formula follows from
    Omega v*_dot = y_m_ddot - C (A x_dot + f_dot) and N_d = M (C A x_dot + C f_dot - y_m_ddot) with
    M Omega = D U. Omega, (m, m), is the response of y_dot to the inputs v. Raises
    DecompositionError if Omega has no decomposition S D U.
    """
    factors = decompose(Omega)
    return np.asarray(-v_dot @ (factors.D[:, None] * factors.U).T)


def check_rules(
    params: LawParams, loop: LoopTiming, response: FloatArray, slew: FloatArray
) -> tuple[GainCondition, ...]:
    """Evaluate the rules of the engineering procedure on a gain set, channel by channel.

        lag product:      K_i response_i total_i <= 0.8
            rad: the lag costs at most 46 degrees of phase
        Lambda below K:   Lambda_i <= 0.5 K_i response_i
        beta above slew:  beta_i >= slew_i
        softening:        eps_i K_i / beta_i >= total_i      only for the softened sign

    total_i is the total lag of the loop, s. beta_i and slew_i are shown in inputs that are scaled
    to unit response. The search for gains begins at gains that meet these rules. The rules only
    estimate the margins of the loop, so a loop may break a rule if its margins suffice.

    response_i is the nominal abs(Omega_ii) in the scaled inputs of the law. slew is the largest
    rate of the ideal control in the same inputs, units of y / s^2. All arrays have shape (m,).
    """
    bandwidth = params.K * response
    most = np.full(len(loop.total), MAX_CROSSOVER_LAG_PRODUCT)
    # show beta in the same inputs for every gain set
    rules = (
        *_by_channel("lag product", bandwidth * loop.total, most, Relation.AT_MOST),
        *_by_channel(
            "Lambda below K", params.Lambda, MAX_LAMBDA_TO_BANDWIDTH * bandwidth, Relation.AT_MOST
        ),
        *_by_channel("beta above slew", params.beta * response, slew * response, Relation.AT_LEAST),
    )
    if params.sign is not Sign.SOFT:
        return rules
    width = params.eps * params.K / params.beta
    return (*rules, *_by_channel("softening", width, loop.total, Relation.AT_LEAST))


def check_loop(
    params: LawParams,
    loop: LoopTiming,
    response: FloatArray,
    largest: FloatArray,
    rate_limit: FloatArray,
) -> tuple[GainCondition, ...]:
    """Evaluate the conditions that the linear margins of a loop do not cover, channel by channel.

        beta below rate:  beta_i <= 0.7 rate_limit_i
        implicit: lag:    lag_i + delay <= period / 2        only for the implicit sign
        implicit: omega:  omega_i >= largest_i               only for the implicit sign

    If the first condition fails, beta may cause a limit cycle. For this condition, beta and the
    rate limit are converted to inputs of unit response. If one of the other conditions fails, the
    implicit sign chatters. response_i is the nominal abs(Omega_ii) in the inputs of the law, and
    `largest` is an upper bound of abs(Omega_ii). rate_limit is in the same inputs, in units of y /
    s^2, and infinite without a limit. All arrays have shape (m,).
    """
    fastest = MAX_BETA_TO_RATE_LIMIT * rate_limit * response
    conditions = _by_channel("beta below rate", params.beta * response, fastest, Relation.AT_MOST)
    if params.sign is not Sign.IMPLICIT:
        return conditions
    half = np.full(len(loop.total), loop.period / 2.0)
    return (
        *conditions,
        *_by_channel("implicit: lag", loop.lag + loop.delay, half, Relation.AT_MOST),
        *_by_channel("implicit: omega", params.omega, largest, Relation.AT_LEAST),
    )


def _by_channel(
    name: str, values: FloatArray, bounds: FloatArray, relation: Relation
) -> tuple[GainCondition, ...]:
    """Return a condition for each channel whose bound is finite."""
    return tuple(
        GainCondition(
            name=name, channel=i, value=float(value), bound=float(bound), relation=relation
        )
        for i, (value, bound) in enumerate(zip(values, bounds, strict=True))
        if math.isfinite(bound)
    )

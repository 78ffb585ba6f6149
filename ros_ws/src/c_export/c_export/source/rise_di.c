/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The RISE-DI controller in C99. rise_di.h says what is called when. Functions and order of operations are those of the Python
 * modules law, saturation, allocation, observer, schedule, feedforward, guard and controller of rise_di_controller, of
 * reference_model and of flight_core.arithmetic.
 */
#include "rise_di.h"

#include <float.h>

#if FLT_EVAL_METHOD != 0
#error "float and double operations need their own precision: -msse2 -mfpmath=sse on 32-bit x86"
#endif
/* gcc defines a macro for each of these flags. clang defines few of them, so rise_di_start computes a test as well. */
#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__)
#error "-ffast-math, -funsafe-math-optimizations and -fassociative-math change the order of operations: -fno-fast-math"
#endif
#ifdef __RECIPROCAL_MATH__
#error "-freciprocal-math changes divisions: add -fno-reciprocal-math"
#endif
#if defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ != 0)
#error "-ffinite-math-only takes NaN for a number: add -fno-finite-math-only"
#endif
#ifdef __NO_SIGNED_ZEROS__
#error "-fno-signed-zeros changes the sign of 0: add -fsigned-zeros"
#endif
#ifdef __NO_TRAPPING_MATH__
#error "-fno-trapping-math is not proved: add -ftrapping-math"
#endif

#if !RISE_DI_FLOAT32
/* Fails under -fsingle-precision-constant, where constants lose digits. */
typedef char rise_di_constants_are_double[(sizeof(1.0) == sizeof(double)) ? 1 : -1];
#endif

#define ZERO ((rise_di_real)0)
#define ONE ((rise_di_real)1)
#define TWO ((rise_di_real)2)
#define SIX ((rise_di_real)6)
#define LEAST_DIVISOR ((rise_di_real)FLT_MIN) /* a quotient by less could overflow */
#define NANOSECONDS ((rise_di_real)1000000000)

#if RISE_DI_FLOAT32
#define ROUNDING ((rise_di_real)12582912) /* 1.5 2^23 */
#define REAL_MAX ((rise_di_real)FLT_MAX)
#else
#define ROUNDING ((rise_di_real)6755399441055744) /* 1.5 2^52 */
#define REAL_MAX ((rise_di_real)DBL_MAX)
#endif

static rise_di_real lesser(rise_di_real a, rise_di_real b) { return (a < b) ? a : b; }

static rise_di_real greater(rise_di_real a, rise_di_real b) { return (a > b) ? a : b; }

/* The value within two bounds; NaN stays NaN, as in Python. */
static rise_di_real clipped(rise_di_real value, rise_di_real low, rise_di_real high) {
    const rise_di_real raised = (value <= low) ? low : value;
    return (raised >= high) ? high : raised;
}

static bool is_equal(rise_di_real a, rise_di_real b) { return (a <= b) && (a >= b); }

static rise_di_real magnitude(rise_di_real a) { return (a < ZERO) ? -a : a; }

static rise_di_real seconds(uint64_t time_ns) { return (rise_di_real)time_ns / NANOSECONDS; }

/* The time from a stamp to a later one, without overflow for any two stamps. It is 0 if `later_ns` is not later. */
static uint64_t elapsed_ns(int64_t later_ns, int64_t earlier_ns) {
    return (later_ns > earlier_ns) ? ((uint64_t)later_ns - (uint64_t)earlier_ns) : (uint64_t)0;
}

static void copy(const rise_di_real *from, rise_di_real *to, int32_t count) {
    for (int32_t i = 0; i < count; i++) {
        to[i] = from[i];
    }
}

static void fill(rise_di_real *values, int32_t count, rise_di_real value) {
    for (int32_t i = 0; i < count; i++) {
        values[i] = value;
    }
}

/* Whether every value is finite. */
static bool is_finite(const rise_di_real *values, int32_t count) {
    bool finite = true;
    for (int32_t i = 0; i < count; i++) {
        finite = finite && (values[i] >= -REAL_MAX) && (values[i] <= REAL_MAX);
    }
    return finite;
}

/* The nearest integer, half to even, for magnitudes below 2^51 (float: 2^22). */
static rise_di_real rounded(rise_di_real a) { return (a + ROUNDING) - ROUNDING; }

#if (RISE_DI_N > 0) || (RISE_DI_S > 0) || (RISE_DI_P > 0) || (RISE_DI_R > 0)
/* result = matrix vector, summed over the columns 0, 1, ... in this order. */
static void product(const rise_di_real *matrix, int32_t rows, int32_t columns, const rise_di_real *vector, rise_di_real *result) {
    for (int32_t i = 0; i < rows; i++) {
        rise_di_real total = matrix[i * columns] * vector[0];
        for (int32_t j = 1; j < columns; j++) {
            total = total + (matrix[(i * columns) + j] * vector[j]);
        }
        result[i] = total;
    }
}

#endif

#if (RISE_DI_N > 0) || (RISE_DI_S > 0)
/* result = matrix' vector for a matrix of these rows and columns, summed over the rows 0, 1, ... in this order. */
static void product_transposed(const rise_di_real *matrix, int32_t rows, int32_t columns, const rise_di_real *vector,
                               rise_di_real *result) {
    for (int32_t i = 0; i < columns; i++) {
        rise_di_real total = matrix[i] * vector[0];
        for (int32_t j = 1; j < rows; j++) {
            total = total + (matrix[(j * columns) + i] * vector[j]);
        }
        result[i] = total;
    }
}
#endif

/* The least value that is not below `lower` and at most `reach` away from `before`. If no value is both, the one nearest to `lower`
 * that is within reach. */
static rise_di_real least(rise_di_real lower, rise_di_real before, rise_di_real reach) {
    return greater(lesser(lower, before + reach), before - reach);
}

/* The largest value that is not above `upper` and at most `reach` away from `before`, or the one nearest to `upper`. */
static rise_di_real largest(rise_di_real upper, rise_di_real before, rise_di_real reach) {
    return lesser(greater(upper, before - reach), before + reach);
}

/* u within the limits of magnitude, and of rate from `before` in dt. */
static rise_di_real saturate(rise_di_real u, rise_di_real before, rise_di_real dt, const rise_di_limits *limits, int32_t i) {
    const rise_di_real reach = limits->rate[i] * dt;
    return clipped(u, least(limits->lower[i], before, reach), largest(limits->upper[i], before, reach));
}

/* ---- the law, equations (20) to (22) ---- */

/* The input of equation (20), as a deviation from the trim. With the literal sign it uses the Pi from before the tick. */
static rise_di_real control(const rise_di_parameters *p, const rise_di_real *scale, const rise_di_law *before,
                            const rise_di_law *after, int32_t i) {
    const rise_di_real Pi = (p->sign == (int64_t)RISE_DI_LITERAL) ? before->Pi[i] : after->Pi[i];
    const rise_di_real integral = p->Lambda[i] * after->integral_e[i];
    return scale[i] * (-p->D[i] * ((p->K[i] * ((after->e[i] - after->e_0[i]) + integral)) + Pi));
}

static void engage_law(rise_di_law *law, const rise_di_real *y, const rise_di_real *y_m) {
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        law->e[i] = y[i] - y_m[i];
        law->e_0[i] = law->e[i];
        law->integral_e[i] = ZERO;
        law->Pi[i] = ZERO;
    }
}

/* A tick of the law without limits: integral of e and Pi. */
static void step_law(const rise_di_parameters *p, const rise_di_law *before, const rise_di_real *y, const rise_di_real *y_m,
                     rise_di_real dt, rise_di_law *after) {
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const rise_di_real e = y[i] - y_m[i];
        const rise_di_real increment = (dt * (e + before->e[i])) / TWO;
        rise_di_real s;
        after->integral_e[i] = before->integral_e[i] + increment;
        if (p->sign == (int64_t)RISE_DI_LITERAL) {
            if (e > ZERO) {
                s = ONE;
            } else {
                s = (e < ZERO) ? -ONE : ZERO;
            }
        } else {
            if (p->sign == (int64_t)RISE_DI_IMPLICIT) {
                const rise_di_real change = e - before->e[i];
                const rise_di_real linear = change + (p->Lambda[i] * increment);
                const rise_di_real e_hat = (e + change) - (((dt * p->omega[i]) * p->K[i]) * linear);
                s = e_hat / (((dt * dt) * p->omega[i]) * p->beta[i]);
            } else {
                s = e / p->eps[i];
            }
            s = clipped(s, -ONE, ONE);
        }
        after->Pi[i] = before->Pi[i] + ((dt * p->beta[i]) * s);
        after->e[i] = e;
        after->e_0[i] = before->e_0[i];
    }
}

/* Anti-windup of a tick. If u is beyond a limit, an increment of integral_e that moves it further out is removed, and such an
 * increment of Pi is reduced. Gives u before and after saturation. */
static void limit_law(const rise_di_parameters *p, const rise_di_real *scale, const rise_di_law *before, rise_di_real dt,
                      const rise_di_real *u_trim, const rise_di_real *u_before, const rise_di_limits *limits,
                      rise_di_law *after, rise_di_real *u_free, rise_di_real *u) {
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const rise_di_real total = u_trim[i] + control(p, scale, before, after, i);
        const rise_di_real beyond = total - saturate(total, u_before[i], dt, limits, i);
        const rise_di_real increment = after->integral_e[i] - before->integral_e[i];
        const rise_di_real increment_Pi = after->Pi[i] - before->Pi[i];
        const rise_di_real change = (((-scale[i] * p->D[i]) * p->K[i]) * p->Lambda[i]) * increment;
        const rise_di_real change_Pi = (-scale[i] * p->D[i]) * increment_Pi;
        const bool outward = (change * beyond) > ZERO;
        const bool outward_Pi = (change_Pi * beyond) > ZERO;
        const rise_di_real excess = greater(magnitude(beyond) - (outward ? magnitude(change) : ZERO), ZERO);
        if (outward) {
            after->integral_e[i] = before->integral_e[i];
        }
        if (outward_Pi) {
            const rise_di_real size = magnitude(change_Pi);
            const rise_di_real kept = greater(size - excess, ZERO) / ((size > LEAST_DIVISOR) ? size : ONE);
            after->Pi[i] = before->Pi[i] + (kept * increment_Pi);
        }
        u_free[i] = u_trim[i] + control(p, scale, before, after, i);
        u[i] = saturate(u_free[i], u_before[i], dt, limits, i);
    }
}

/* Set Pi so that u does not jump when the parameters or the scale change. */
static void retune_law(rise_di_law *law, const rise_di_parameters *old, const rise_di_real *old_scale,
                       const rise_di_parameters *next, const rise_di_real *next_scale) {
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const rise_di_real u = control(old, old_scale, law, law, i);
        const rise_di_real linear = (law->e[i] - law->e_0[i]) + (next->Lambda[i] * law->integral_e[i]);
        law->Pi[i] = ((-next->D[i] * u) / next_scale[i]) - (next->K[i] * linear);
    }
}

/* ---- schedule of input_scale over dynamic pressure ---- */

#if RISE_DI_SCHEDULE
static void target_scale(const rise_di_parameters *p, const rise_di_real *y, rise_di_real *target) {
    rise_di_real V = p->airspeed[0] * y[0];
    rise_di_real ratio;
    for (int32_t i = 1; i < RISE_DI_M; i++) {
        V = V + (p->airspeed[i] * y[i]);
    }
    V = p->speed + V;
    ratio = p->speed / clipped(V, p->V_least, p->V_largest);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        target[i] = p->airspeed[i] + ((ONE - p->airspeed[i]) * (ratio * ratio));
    }
}
#endif

static void scheduled(const rise_di_parameters *p, const rise_di_law *law, rise_di_real *scale) {
#if RISE_DI_SCHEDULE
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        scale[i] = p->input_scale[i] * law->scale[i];
    }
#else
    (void)law;
    copy(p->input_scale, scale, RISE_DI_M);
#endif
}

#if RISE_DI_SCHEDULE
static void follow_schedule(const rise_di_parameters *p, rise_di_law *law, const rise_di_real *y, rise_di_real dt) {
    rise_di_real target[RISE_DI_M];
    rise_di_real old_scale[RISE_DI_M];
    rise_di_real next_scale[RISE_DI_M];
    const rise_di_real part = lesser(dt / p->time, ONE);
    target_scale(p, y, target);
    scheduled(p, law, old_scale);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        law->scale[i] = law->scale[i] + (part * (target[i] - law->scale[i]));
    }
    scheduled(p, law, next_scale);
    retune_law(law, p, old_scale, p, next_scale);
}
#endif

/* ---- observer ---- */

#if RISE_DI_S > 0
static void predict(const rise_di_parameters *p, const rise_di_real *u, const rise_di_real *u_trim, rise_di_real *z) {
    rise_di_real moved[RISE_DI_S];
    rise_di_real driven[RISE_DI_S];
    rise_di_real input[RISE_DI_M];
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        input[i] = u[i] - u_trim[i];
    }
    product(p->Phi, RISE_DI_S, RISE_DI_S, z, moved);
    product(p->Gamma, RISE_DI_S, RISE_DI_M, input, driven);
    for (int32_t i = 0; i < RISE_DI_S; i++) {
        z[i] = moved[i] + driven[i];
    }
}

static void start_estimates(const rise_di_parameters *p, rise_di_law *law, const rise_di_real *y, const rise_di_real *y_m) {
    rise_di_real e[RISE_DI_M];
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        e[i] = y[i] - y_m[i];
    }
    product_transposed(p->H, RISE_DI_M, RISE_DI_S, e, law->z);
    fill(law->u_o, RISE_DI_M, ZERO);
    law->sigma = ZERO;
}

/* Correction of the estimates by the measured error, and the contribution u_o to the trim. */
static void correct(const rise_di_parameters *p, rise_di_law *law, const rise_di_real *y, const rise_di_real *y_m,
                    rise_di_real dt) {
    rise_di_real innovation[RISE_DI_M];
    rise_di_real correction[RISE_DI_S];
    rise_di_real feedback[RISE_DI_M];
    product(p->H, RISE_DI_M, RISE_DI_S, law->z, innovation);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        innovation[i] = (y[i] - y_m[i]) - innovation[i];
    }
    product(p->L, RISE_DI_S, RISE_DI_M, innovation, correction);
    for (int32_t i = 0; i < RISE_DI_S; i++) {
        law->z[i] = law->z[i] + correction[i];
    }
    law->sigma = lesser(law->sigma + (dt * p->fade_rate), ONE);
    product(p->F, RISE_DI_M, RISE_DI_S, law->z, feedback);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        law->u_o[i] = saturate(-law->sigma * feedback[i], law->u_o[i], dt, &p->observer_limits, i);
    }
}

static bool same_values(const rise_di_real *a, const rise_di_real *b, int32_t count) {
    bool same = true;
    for (int32_t i = 0; i < count; i++) {
        same = same && is_equal(a[i], b[i]);
    }
    return same;
}

static bool same_model(const rise_di_parameters *a, const rise_di_parameters *b) {
    return same_values(a->Phi, b->Phi, RISE_DI_S * RISE_DI_S) && same_values(a->Gamma, b->Gamma, RISE_DI_S * RISE_DI_M) &&
           same_values(a->H, b->H, RISE_DI_M * RISE_DI_S) && same_values(a->L, b->L, RISE_DI_S * RISE_DI_M) &&
           same_values(a->F, b->F, RISE_DI_M * RISE_DI_S);
}
#endif

/* ---- feedforward by inversion of the nominal model ---- */

#if RISE_DI_N > 0
/* Sine with an error below 5e-16 (float: 3e-7) for angles up to 1e6 rad (float: 100 rad). */
static rise_di_real sine(rise_di_real x) {
    static const rise_di_real coefficient[9] = RISE_DI_SINE_COEFFICIENTS;
    const rise_di_real angle = clipped(x, -RISE_DI_MAX_ANGLE, RISE_DI_MAX_ANGLE);
    const rise_di_real k = rounded(angle * RISE_DI_INVERSE_PI);
    const rise_di_real odd = k - (TWO * rounded(k / TWO));
    const rise_di_real r = (angle - (k * RISE_DI_PI_HIGH)) - (k * RISE_DI_PI_LOW);
    const rise_di_real r_squared = r * r;
    rise_di_real series = coefficient[0];
    for (int32_t i = 1; i < 9; i++) {
        series = (series * r_squared) + coefficient[i];
    }
    return (ONE - (TWO * magnitude(odd))) * (r + ((r * r_squared) * series));
}

static void sines(const rise_di_parameters *p, const rise_di_real *x, rise_di_real *values) {
    for (int32_t i = 0; i < RISE_DI_N; i++) {
        values[i] = (p->has_sine[i] > ZERO) ? sine(x[i]) : ZERO;
    }
}

/* matrix x + gravity sin(x) */
static void drift(const rise_di_parameters *p, const rise_di_real *matrix, const rise_di_real *gravity, const rise_di_real *x,
                  rise_di_real *result) {
    rise_di_real linear[RISE_DI_N];
    rise_di_real angle_sines[RISE_DI_N];
    rise_di_real pulled[RISE_DI_N];
    product(matrix, RISE_DI_N, RISE_DI_N, x, linear);
    sines(p, x, angle_sines);
    product(gravity, RISE_DI_N, RISE_DI_N, angle_sines, pulled);
    for (int32_t i = 0; i < RISE_DI_N; i++) {
        result[i] = linear[i] + pulled[i];
    }
}

/* x_dot of the nominal model under the ideal input. */
static void slope(const rise_di_parameters *p, const rise_di_real *x, const rise_di_real *forced, rise_di_real *x_dot) {
    drift(p, p->path_A, p->path_gravity, x, x_dot);
    for (int32_t i = 0; i < RISE_DI_N; i++) {
        x_dot[i] = x_dot[i] + forced[i];
    }
}

/* x_dot at x + dt k, a stage of the Runge-Kutta step. */
static void stage(const rise_di_parameters *p, const rise_di_real *x, rise_di_real dt, const rise_di_real *k,
                  const rise_di_real *forced, rise_di_real *x_dot) {
    rise_di_real at[RISE_DI_N];
    for (int32_t i = 0; i < RISE_DI_N; i++) {
        at[i] = x[i] + (dt * k[i]);
    }
    slope(p, at, forced, x_dot);
}

static void engage_feedforward(const rise_di_parameters *p, rise_di_feedforward *state, const rise_di_real *y_m) {
    product_transposed(p->C, RISE_DI_M, RISE_DI_N, y_m, state->x);
    fill(state->u, RISE_DI_M, ZERO);
    fill(state->u_0, RISE_DI_M, ZERO);
    state->dt = ZERO;
    state->ticks = ZERO;
}

/* A Runge-Kutta step of the nominal model under the ideal input. */
static void advance(const rise_di_parameters *p, const rise_di_real *forced, rise_di_real dt, rise_di_real *x) {
    rise_di_real k1[RISE_DI_N];
    rise_di_real k2[RISE_DI_N];
    rise_di_real k3[RISE_DI_N];
    rise_di_real k4[RISE_DI_N];
    slope(p, x, forced, k1);
    stage(p, x, dt / TWO, k1, forced, k2);
    stage(p, x, dt / TWO, k2, forced, k3);
    stage(p, x, dt, k3, forced, k4);
    for (int32_t i = 0; i < RISE_DI_N; i++) {
        x[i] = x[i] + ((dt / SIX) * (((k1[i] + (TWO * k2[i])) + (TWO * k3[i])) + k4[i]));
    }
}

/* Runge-Kutta steps of the nominal model along y_m, and u_ff extrapolated to the instant at which the input acts. */
static void step_feedforward(const rise_di_parameters *p, rise_di_feedforward *state, const rise_di_real *y_m, rise_di_real dt,
                             uint64_t span_ns, rise_di_real *u_ff) {
    const uint64_t longest_ns = (uint64_t)RISE_DI_LONGEST_PART * (uint64_t)p->period_ns;
    const uint64_t rest = ((span_ns % longest_ns) > 0U) ? (uint64_t)1 : (uint64_t)0;
    const uint64_t parts = (span_ns / longest_ns) + rest; /* at least 1: a span is above 0 */
    rise_di_real output[RISE_DI_M];
    rise_di_real y_m_dot[RISE_DI_M];
    rise_di_real input[RISE_DI_M];
    rise_di_real forced[RISE_DI_N];
    rise_di_real begin[RISE_DI_N];
    rise_di_real middle[RISE_DI_N];
    product(p->C, RISE_DI_M, RISE_DI_N, state->x, output);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        y_m_dot[i] = (y_m[i] - output[i]) / dt;
    }
    product(p->inverse, RISE_DI_M, RISE_DI_M, y_m_dot, input);
    product(p->B, RISE_DI_N, RISE_DI_M, input, forced);
    copy(state->x, begin, RISE_DI_N);
    for (uint64_t k = 0; k < parts; k++) {
        advance(p, forced, dt / (rise_di_real)parts, state->x);
    }
    for (int32_t i = 0; i < RISE_DI_N; i++) {
        middle[i] = (state->x[i] + begin[i]) / TWO;
    }
    drift(p, p->A, p->gravity, middle, forced);
    product(p->C, RISE_DI_M, RISE_DI_N, forced, output);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        output[i] = y_m_dot[i] - output[i];
    }
    product(p->inverse, RISE_DI_M, RISE_DI_M, output, input);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const rise_di_real ahead = dt + (TWO * p->lead[i]);
        const rise_di_real extrapolated = input[i] + ((ahead * (input[i] - state->u[i])) / (dt + state->dt));
        if (state->ticks < TWO) {
            state->u_0[i] = extrapolated;
        }
        u_ff[i] = extrapolated - state->u_0[i];
        state->u[i] = input[i];
    }
    state->dt = dt;
    state->ticks = state->ticks + ONE;
}
#endif

/* ---- the whole law: observer or schedule over the law ---- */

static void engage_all(const rise_di_parameters *p, rise_di_law *law, const rise_di_real *y, const rise_di_real *y_m) {
    (void)p;
    engage_law(law, y, y_m);
#if RISE_DI_SCHEDULE
    target_scale(p, y, law->scale);
#endif
#if RISE_DI_S > 0
    start_estimates(p, law, y, y_m);
#endif
}

/* A tick of the whole law from the state `before`. Gives u_free, and u within `limits`. If `limits` is a null pointer, u is u_free. */
static void tick_law(const rise_di_parameters *p, const rise_di_law *before, const rise_di_real *y, const rise_di_real *y_m,
                     rise_di_real dt, const rise_di_real *u_trim, const rise_di_real *u_before,
                     const rise_di_limits *limits, rise_di_law *after, rise_di_real *u_free, rise_di_real *u) {
    rise_di_law begin = *before;
    rise_di_real scale[RISE_DI_M];
    rise_di_real trim[RISE_DI_M];
    copy(u_trim, trim, RISE_DI_M);
#if RISE_DI_SCHEDULE
    follow_schedule(p, &begin, y, dt);
#endif
#if RISE_DI_S > 0
    correct(p, &begin, y, y_m, dt);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        trim[i] = u_trim[i] + begin.u_o[i];
    }
#endif
    scheduled(p, &begin, scale);
    *after = begin;
    step_law(p, &begin, y, y_m, dt, after);
    if (limits != (const rise_di_limits *)0) {
        limit_law(p, scale, &begin, dt, trim, u_before, limits, after, u_free, u);
    } else {
        for (int32_t i = 0; i < RISE_DI_M; i++) {
            u_free[i] = trim[i] + control(p, scale, &begin, after, i);
            u[i] = u_free[i];
        }
    }
#if RISE_DI_S > 0
    predict(p, u, u_trim, after->z);
#endif
}

/* ---- allocation of the inputs of the law to the effectors ---- */

#if RISE_DI_P > 0
static bool is_inside(const rise_di_real *u, const rise_di_real *low, const rise_di_real *high) {
    bool inside = true;
    for (int32_t j = 0; j < RISE_DI_P; j++) {
        inside = inside && (u[j] >= low[j]) && (u[j] <= high[j]);
    }
    return inside;
}

/* Change u without a change of its effect, until it is inside its limits or the sweeps have ended. */
static void pass_on(const rise_di_parameters *p, const rise_di_real *low, const rise_di_real *high, rise_di_real *u) {
    bool inside = false;
    for (int32_t sweep = 0; (sweep < RISE_DI_SWEEPS) && (!inside); sweep++) {
        inside = true;
        for (int32_t j = 0; j < RISE_DI_P; j++) {
            const rise_di_real own = p->exchange[(j * RISE_DI_P) + j];
            const rise_di_real excess = u[j] - clipped(u[j], low[j], high[j]);
            if ((!is_equal(excess, ZERO)) && (magnitude(own) > RISE_DI_EXCHANGE_LEAST)) {
                const rise_di_real part = (RISE_DI_RELAXATION * excess) / own;
                inside = false;
                for (int32_t i = 0; i < RISE_DI_P; i++) {
                    u[i] = u[i] - (part * p->exchange[(i * RISE_DI_P) + j]);
                }
            }
        }
    }
}

/* target = begin + part move, after pass_on. Returns whether the target is inside the limits. */
static bool moved(const rise_di_parameters *p, const rise_di_real *begin, rise_di_real part, const rise_di_real *move,
                  const rise_di_real *low, const rise_di_real *high, rise_di_real *target) {
    for (int32_t j = 0; j < RISE_DI_P; j++) {
        target[j] = begin[j] + (part * move[j]);
    }
    pass_on(p, low, high, target);
    return is_inside(target, low, high);
}

/* u = values, which are inside their limits. They are limited again because the proof of the source cannot know this. */
static void take_inside(const rise_di_real *values, const rise_di_real *low, const rise_di_real *high, rise_di_real *u) {
    for (int32_t j = 0; j < RISE_DI_P; j++) {
        const rise_di_real raised = (values[j] < low[j]) ? low[j] : values[j];
        u[j] = (raised > high[j]) ? high[j] : raised;
    }
}

/* The part of a step that has room, at most 1. */
static rise_di_real part_of(rise_di_real room, rise_di_real step) { return (step > magnitude(room)) ? (room / step) : ONE; }

/* Move u, which is inside its limits, by as much of `move` as they allow. The halvings find the largest part of the move that has a
 * target inside. From there u goes straight towards the first target that is outside, until it meets a limit. */
static void towards(const rise_di_parameters *p, const rise_di_real *move, const rise_di_real *low, const rise_di_real *high,
                    rise_di_real *u) {
    rise_di_real begin[RISE_DI_P];
    rise_di_real target[RISE_DI_P];
    rise_di_real halfway[RISE_DI_P];
    copy(u, begin, RISE_DI_P);
    if (moved(p, begin, ONE, move, low, high, target)) {
        take_inside(target, low, high, u);
    } else {
        rise_di_real part = ZERO;
        rise_di_real size = ONE;
        rise_di_real last = ONE;
        for (int32_t k = 0; k < RISE_DI_HALVINGS; k++) {
            size = size / TWO;
            if (moved(p, begin, part + size, move, low, high, halfway)) {
                take_inside(halfway, low, high, u);
                part = part + size;
            } else {
                copy(halfway, target, RISE_DI_P);
            }
        }
        for (int32_t j = 0; j < RISE_DI_P; j++) {
            const rise_di_real step = target[j] - u[j];
            if (step > LEAST_DIVISOR) {
                last = lesser(last, part_of(high[j] - u[j], step));
            } else if (step < -LEAST_DIVISOR) {
                last = lesser(last, part_of(u[j] - low[j], -step));
            } else {
                /* it stays */
            }
        }
        for (int32_t j = 0; j < RISE_DI_P; j++) {
            u[j] = clipped(u[j] + (last * (target[j] - u[j])), low[j], high[j]);
        }
    }
}

/* Move u by the effectors for each input of the law, one input after the other in the order of priority. */
static void add_by_priority(const rise_di_parameters *p, const rise_di_real *v, const rise_di_real *low,
                            const rise_di_real *high, rise_di_real *u) {
    for (int32_t k = 0; k < RISE_DI_M; k++) {
        const int32_t i = (int32_t)p->order[k];
        rise_di_real move[RISE_DI_P];
        for (int32_t j = 0; j < RISE_DI_P; j++) {
            move[j] = p->T[(j * RISE_DI_M) + i] * v[i];
        }
        towards(p, move, low, high, u);
    }
}

/* Find effectors u for the demanded v inside their limits. Afterwards v is what these effectors give. */
static void allocate(const rise_di_parameters *p, const rise_di_real *u_before, rise_di_real dt, rise_di_real *v,
                     rise_di_real *u) {
    const rise_di_stops *stops = &p->stops;
    rise_di_real low[RISE_DI_P];
    rise_di_real high[RISE_DI_P];
    for (int32_t j = 0; j < RISE_DI_P; j++) {
        const rise_di_real reach = stops->rate[j] * dt;
        low[j] = least(stops->lower[j], u_before[j], reach);
        high[j] = largest(stops->upper[j], u_before[j], reach);
    }
    product(p->T, RISE_DI_P, RISE_DI_M, v, u);
    if (!is_inside(u, low, high)) {
        pass_on(p, stops->lower, stops->upper, u);
        if (!is_inside(u, stops->lower, stops->upper)) {
            fill(u, RISE_DI_P, ZERO);
            add_by_priority(p, v, stops->lower, stops->upper, u);
        }
        if (!is_inside(u, low, high)) {
            rise_di_real target[RISE_DI_P];
            rise_di_real change[RISE_DI_P];
            rise_di_real rest[RISE_DI_P];
            rise_di_real v_change[RISE_DI_M];
            copy(u, target, RISE_DI_P);
            for (int32_t j = 0; j < RISE_DI_P; j++) {
                u[j] = clipped(u_before[j], low[j], high[j]);
                change[j] = target[j] - u[j];
            }
            product(p->effect, RISE_DI_M, RISE_DI_P, change, v_change);
            add_by_priority(p, v_change, low, high, u);
            for (int32_t j = 0; j < RISE_DI_P; j++) {
                change[j] = target[j] - u[j];
            }
            product(p->exchange, RISE_DI_P, RISE_DI_P, change, rest);
            towards(p, rest, low, high, u);
        }
        product(p->effect, RISE_DI_M, RISE_DI_P, u, v);
    }
}

/* The limits under which u_free becomes the u that the effectors give. The anti-windup of the law takes them. */
static void reached(const rise_di_real *u_free, const rise_di_real *u, rise_di_limits *limits) {
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        limits->lower[i] = (u_free[i] < u[i]) ? u[i] : -REAL_MAX;
        limits->upper[i] = (u_free[i] > u[i]) ? u[i] : REAL_MAX;
        limits->rate[i] = REAL_MAX;
    }
}
#endif

/* ---- guard ---- */

/* The sample `back` places before the newest. */
static const rise_di_sample *sample_at(const rise_di_samples *samples, int32_t back) {
    return &samples->sample[((samples->newest - back) + RISE_DI_SAMPLES) % RISE_DI_SAMPLES];
}

void rise_di_append(rise_di_samples *samples, int64_t stamp_ns, const rise_di_real value[RISE_DI_M]) {
    samples->newest = (samples->count == 0) ? 0 : ((samples->newest + 1) % RISE_DI_SAMPLES);
    samples->sample[samples->newest].stamp_ns = stamp_ns;
    samples->seen_ns = stamp_ns;
    copy(value, samples->sample[samples->newest].value, RISE_DI_M);
    if (samples->count < RISE_DI_SAMPLES) {
        samples->count = samples->count + 1;
    }
}

/* y_m at an instant: a sample, or interpolated, or extrapolated by at most a period. Returns false if none of these is possible. */
static bool align(const rise_di_parameters *p, const rise_di_samples *samples, int64_t stamp_ns, rise_di_real *value) {
    const rise_di_sample *newer = (const rise_di_sample *)0;
    const rise_di_sample *older = (const rise_di_sample *)0;
    const rise_di_sample *first = (const rise_di_sample *)0;
    const rise_di_sample *second = (const rise_di_sample *)0;
    bool possible = true;
    int32_t back = 0;
    while ((back < samples->count) && (older == (const rise_di_sample *)0)) {
        const rise_di_sample *sample = sample_at(samples, back);
        if (sample->stamp_ns <= stamp_ns) {
            older = sample;
        } else {
            newer = sample;
            back = back + 1;
        }
    }
    if (older == (const rise_di_sample *)0) {
        possible = false;
    } else if (older->stamp_ns == stamp_ns) {
        first = older;
    } else if (newer != (const rise_di_sample *)0) {
        first = older;
        second = newer;
    } else if (elapsed_ns(stamp_ns, older->stamp_ns) > (uint64_t)p->period_ns) {
        possible = false;
    } else {
        first = older;
        for (back = 1; (back < samples->count) && (second == (const rise_di_sample *)0); back++) {
            const rise_di_sample *sample = sample_at(samples, back);
            if (elapsed_ns(older->stamp_ns, sample->stamp_ns) >= (uint64_t)p->slope_ns) {
                first = sample;
                second = older;
            }
        }
    }
    if (possible && (second == (const rise_di_sample *)0)) {
        copy(first->value, value, RISE_DI_M);
    } else if (possible) {
        const uint64_t span_ns = elapsed_ns(second->stamp_ns, first->stamp_ns);
        const uint64_t passed_ns = elapsed_ns(stamp_ns, first->stamp_ns);
        /* The span is above 0, because stamps increase. */
        const rise_di_real fraction = (rise_di_real)passed_ns / (rise_di_real)((span_ns > 0U) ? span_ns : 1U);
        for (int32_t i = 0; i < RISE_DI_M; i++) {
            value[i] = first->value[i] + (fraction * (second->value[i] - first->value[i]));
        }
    } else {
        /* no reference at this instant */
    }
    return possible;
}

/* Factor of the failsafe u: 1 up to hold, then linear to 0 over ramp. */
static rise_di_real failsafe_scale(uint64_t silence_ns, uint64_t hold_ns, uint64_t ramp_ns) {
    rise_di_real scale;
    if (silence_ns <= hold_ns) {
        scale = ONE;
    } else if (silence_ns >= (hold_ns + ramp_ns)) {
        scale = ZERO;
    } else {
        scale = ONE - ((rise_di_real)(silence_ns - hold_ns) / (rise_di_real)ramp_ns);
    }
    return scale;
}

static void log_inputs(rise_di_output *output, int64_t stamp_ns, const rise_di_real *y, const rise_di_real *y_m,
                       rise_di_real offset, rise_di_real dt) {
    output->stamp_ns = stamp_ns;
    copy(y, output->y, RISE_DI_M);
    copy(y_m, output->y_m, RISE_DI_M);
    output->y_m_offset = offset;
    output->dt = dt;
}

/* A tick without fresh inputs, or of a deactivated controller. u gets the stamp `stamp_ns`. Returns whether there is a u to send. */
static bool failsafe(rise_di_controller *c, int64_t stamp_ns, int64_t now_ns, bool active, rise_di_output *output) {
    const rise_di_parameters *p = c->parameters;
    const bool was_active = c->mode != RISE_DI_INACTIVE;
    if (c->has_law) {
        rise_di_real scale = ONE;
        if ((c->mode == RISE_DI_ENGAGED) || (c->mode == RISE_DI_WAITING) || (was_active != active)) {
            c->failsafe_start_ns = now_ns;
            copy(c->u, c->u_failsafe, RISE_DI_M);
#if RISE_DI_P > 0
            copy(c->effectors, c->effectors_failsafe, RISE_DI_P);
#endif
            c->hold_ns = active ? p->hold_ns : 0;
            c->ramp_ns = p->ramp_ns;
        }
        if (active || (p->deactivation_holds == 0)) {
            scale = failsafe_scale(elapsed_ns(now_ns, c->failsafe_start_ns), (uint64_t)c->hold_ns, (uint64_t)c->ramp_ns);
        }
        if (!active) {
            c->mode = RISE_DI_INACTIVE;
        } else if (is_equal(scale, ONE)) {
            c->mode = RISE_DI_HOLD;
        } else {
            c->mode = (scale > ZERO) ? RISE_DI_RAMP : RISE_DI_TRIM;
        }
        for (int32_t i = 0; i < RISE_DI_M; i++) {
            c->u[i] = is_equal(scale, ONE) ? c->u_failsafe[i] : (scale * c->u_failsafe[i]);
            c->u_free[i] = c->u[i];
        }
#if RISE_DI_P > 0
        for (int32_t j = 0; j < RISE_DI_P; j++) {
            c->effectors[j] = is_equal(scale, ONE) ? c->effectors_failsafe[j] : (scale * c->effectors_failsafe[j]);
        }
#endif
        log_inputs(output, stamp_ns, c->y, c->y_m, ZERO, ZERO);
    } else {
        c->mode = active ? RISE_DI_WAITING : RISE_DI_INACTIVE;
    }
    return c->has_law;
}

/* Bumpless engagement: the law starts from the present u. */
static void engage(rise_di_controller *c, const rise_di_sample *y, const rise_di_real *y_m) {
    c->mode = RISE_DI_ENGAGED;
    c->has_law = true;
    engage_all(c->parameters, &c->law, y->value, y_m);
    copy(c->u, c->u_trim, RISE_DI_M);
    copy(c->u, c->u_free, RISE_DI_M);
    fill(c->u_ff, RISE_DI_M, ZERO);
#if RISE_DI_N > 0
    engage_feedforward(c->parameters, &c->feedforward, y_m);
#endif
}

/* A step of the law with a new y. Returns dt, or 0 if u or a state would not be finite. In that case the law must engage again. */
static rise_di_real step(rise_di_controller *c, const rise_di_sample *y, const rise_di_real *y_m) {
    const rise_di_parameters *p = c->parameters;
    const uint64_t span_ns = elapsed_ns(y->stamp_ns, c->y_stamp_ns);
    const rise_di_real dt = clipped(seconds(span_ns), p->dt_least, p->dt_largest);
    rise_di_law after;
    rise_di_real u_trim[RISE_DI_M];
    rise_di_real u_free[RISE_DI_M];
    rise_di_real u[RISE_DI_M];
    bool limited = false;
    bool finite;
#if RISE_DI_P > 0
    rise_di_real effectors[RISE_DI_P];
    rise_di_limits given;
    const rise_di_limits *limits = &given;
#else
    const rise_di_limits *limits = &p->limits;
#endif
#if RISE_DI_S > 0
    rise_di_law predicted = c->law;
    const rise_di_law *before = &predicted;
    const rise_di_real periods = rounded(dt / p->period);
    const int32_t missed = (int32_t)periods - 1;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        u_trim[i] = c->u_trim[i] + c->u_ff[i];
    }
    for (int32_t k = 0; k < missed; k++) {
        predict(p, c->u, u_trim, predicted.z);
    }
#else
    const rise_di_law *before = &c->law;
#endif
#if RISE_DI_N > 0
    step_feedforward(p, &c->feedforward, y_m, dt, span_ns, c->u_ff);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        u_trim[i] = c->u_trim[i] + c->u_ff[i];
    }
#else
    copy(c->u_trim, u_trim, RISE_DI_M);
#endif
    tick_law(p, before, y->value, y_m, dt, u_trim, c->u, (const rise_di_limits *)0, &after, u_free, u);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        u[i] = saturate(u_free[i], c->u[i], dt, &p->limits, i);
    }
#if RISE_DI_P > 0
    allocate(p, c->effectors, dt, u, effectors);
#endif
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        limited = limited || (!is_equal(u[i], u_free[i]));
    }
    if (limited) {
#if RISE_DI_P > 0
        reached(u_free, u, &given);
#endif
        tick_law(p, before, y->value, y_m, dt, u_trim, c->u, limits, &after, u_free, u);
#if RISE_DI_P > 0
        allocate(p, c->effectors, dt, u, effectors);
#endif
    }
    finite = is_finite(u, RISE_DI_M) && is_finite(u_free, RISE_DI_M) && is_finite(c->u_ff, RISE_DI_M) &&
             is_finite((const rise_di_real *)&after, (int32_t)(sizeof after / sizeof(rise_di_real)));
#if RISE_DI_N > 0
    finite = finite && is_finite((const rise_di_real *)&c->feedforward, (int32_t)(sizeof c->feedforward / sizeof(rise_di_real)));
#endif
#if RISE_DI_P > 0
    finite = finite && is_finite(effectors, RISE_DI_P);
#endif
    if (finite) {
#if RISE_DI_P > 0
        copy(effectors, c->effectors, RISE_DI_P);
#endif
        c->law = after;
        copy(u, c->u, RISE_DI_M);
        copy(u_free, c->u_free, RISE_DI_M);
    }
    return finite ? dt : ZERO;
}

static bool is_fresh(int64_t now_ns, int64_t stamp_ns, int64_t max_age_ns) {
    return (elapsed_ns(now_ns, stamp_ns) <= (uint64_t)max_age_ns) && (elapsed_ns(stamp_ns, now_ns) <= (uint64_t)max_age_ns);
}

/* Whether y and y_m are finite. A sample with NaN or infinity counts as none. */
static bool are_numbers(const rise_di_real *y, const rise_di_real *y_m) {
    rise_di_real sum[RISE_DI_M];
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        sum[i] = y[i] + y_m[i];
    }
    return is_finite(sum, RISE_DI_M);
}

/* Whether the last y of the law is longer ago than a step may take. This is the age limit and a period, because the last tick with a
 * fresh y can be a period before the tick of the next y. */
static bool has_gap(const rise_di_controller *c, int64_t stamp_ns) {
    const uint64_t longest_ns = (uint64_t)c->parameters->max_age_ns + (uint64_t)c->parameters->period_ns;
    return elapsed_ns(stamp_ns, c->y_stamp_ns) > longest_ns;
}

static bool any(const rise_di_real *values) {
    bool result = false;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        result = result || (!is_equal(values[i], ZERO));
    }
    return result;
}

/* The stamp of a u without a y: the stamp of the last u plus the time since then. */
static int64_t going_on(const rise_di_controller *c, int64_t now_ns) {
    return c->stamp_ns + (int64_t)elapsed_ns(now_ns, c->tick_ns);
}

bool rise_di_guard_tick(rise_di_controller *controller, int64_t now_ns, const rise_di_sample *y, const rise_di_samples *y_m,
                        bool active, rise_di_output *output) {
    rise_di_controller *c = controller;
    rise_di_real reference[RISE_DI_M];
    rise_di_real dt = ZERO;
    bool fresh = false;
    bool late = false;
    bool published = true;
    fill(reference, RISE_DI_M, ZERO);
    if ((y != (const rise_di_sample *)0) && (y_m->count > 0) && (c->parameters != (const rise_di_parameters *)0)) {
        const int64_t max_age_ns = c->parameters->max_age_ns;
        fresh = is_fresh(now_ns, y->stamp_ns, max_age_ns) && is_fresh(now_ns, sample_at(y_m, 0)->stamp_ns, max_age_ns) &&
                align(c->parameters, y_m, y->stamp_ns, reference) && are_numbers(y->value, reference);
        /* A y from before the last u is late, and the law waits for the next one. */
        late = fresh && (c->mode != RISE_DI_ENGAGED) && (y->stamp_ns < c->stamp_ns);
    }
    if (c->parameters == (const rise_di_parameters *)0) {
        published = false;
    } else if ((!active) && fresh && (!c->has_law) && (!any(c->u))) {
        c->mode = RISE_DI_INACTIVE;
        log_inputs(output, late ? c->stamp_ns : y->stamp_ns, y->value, reference, ZERO, ZERO);
    } else if ((!active) || (!fresh) || late) {
        published = failsafe(c, late ? c->stamp_ns : going_on(c, now_ns), now_ns, active, output);
    } else {
        if ((!c->has_law) || (c->mode != RISE_DI_ENGAGED) || has_gap(c, y->stamp_ns)) {
            engage(c, y, reference);
        } else if (y->stamp_ns <= c->y_stamp_ns) {
            published = false;
        } else {
            dt = step(c, y, reference);
            if (is_equal(dt, ZERO)) {
                engage(c, y, reference);
            }
        }
        if (published) {
            const int64_t newest_ns = sample_at(y_m, 0)->stamp_ns;
            const rise_di_real ahead = seconds(elapsed_ns(newest_ns, y->stamp_ns));
            const rise_di_real behind = seconds(elapsed_ns(y->stamp_ns, newest_ns));
            c->y_stamp_ns = y->stamp_ns;
            copy(y->value, c->y, RISE_DI_M);
            copy(reference, c->y_m, RISE_DI_M);
            log_inputs(output, y->stamp_ns, y->value, reference, (newest_ns < y->stamp_ns) ? -behind : ahead, dt);
        }
    }
    if (published) {
        c->stamp_ns = output->stamp_ns;
        c->tick_ns = now_ns;
    }
    return published;
}

/* ---- controller: samples and calls ---- */

#if RISE_DI_FLOAT32
typedef float plain;
typedef uint32_t plain_bits;
#define NAN_BITS ((plain_bits)0x7FC00000)
#define INFINITY_BITS ((plain_bits)0x7F800000)
#define TINY ((plain)1 / (plain)4096) /* 2^-12 */
#else
typedef double plain;
typedef uint64_t plain_bits;
#define NAN_BITS ((plain_bits)0x7FF80000 << 32)
#define INFINITY_BITS ((plain_bits)0x7FF00000 << 32)
#define TINY ((plain)1 / (plain)134217728) /* 2^-27 */
#endif

#define MILLION ((rise_di_real)1000000)
#define SINE_OF_PART ((rise_di_real)295520) /* sin(0.3), which is 295520.2 millionths */

static rise_di_real from_bits(plain_bits bits) {
    volatile plain_bits stored = bits;
    union {
        plain_bits bits;
        plain value;
    } number;
    number.bits = stored;
    return (rise_di_real)number.value;
}

/* Whether each operation is rounded once, in the order written. A compiler cannot know the values of volatile variables. */
static bool is_rounded_once(void) {
    volatile plain part = (plain)3 / (plain)10;
    volatile plain billion = (plain)1000000000;
    volatile plain near_one = (plain)1 + TINY;
    volatile plain square = (plain)1 + ((plain)2 * TINY); /* of near_one, without the rest that only a fused operation keeps */
    volatile plain minus_zero = -(plain)0;
    volatile int32_t count = 64;
    const rise_di_real factor = (rise_di_real)near_one;
    bool exact = is_equal(rounded((rise_di_real)part), ZERO) && is_equal(rounded(ONE - (rise_di_real)part), ONE) &&
                 is_equal((factor * factor) - (rise_di_real)square, ZERO) && ((ONE / ((rise_di_real)minus_zero + ZERO)) > ZERO);
    for (int32_t k = 1; k < count; k++) {
        exact = exact && is_equal(seconds((uint64_t)k), (rise_di_real)k / (rise_di_real)billion);
    }
#if RISE_DI_N > 0
    exact = exact && (magnitude((sine((rise_di_real)part) * MILLION) - SINE_OF_PART) < ONE);
#endif
    return exact;
}

/* Whether NaN and infinity are told from numbers. */
static bool is_nan_told(void) {
    const rise_di_real special[3] = {from_bits(NAN_BITS), from_bits(INFINITY_BITS), -from_bits(INFINITY_BITS)};
    bool told = (!is_equal(special[0], special[0])) && (!is_finite(special, 3));
    for (int32_t k = 0; k < 3; k++) {
        told = told && (!is_finite(&special[k], 1));
    }
    return told;
}

bool rise_di_start(rise_di_controller *controller, const rise_di_parameters *parameters) {
    const bool exact = is_rounded_once() && is_nan_told();
    controller->parameters = exact ? parameters : (const rise_di_parameters *)0;
    controller->mode = RISE_DI_WAITING;
    controller->has_law = false;
    controller->y_stamp_ns = 0;
    controller->stamp_ns = INT64_MIN; /* every y is later */
    controller->tick_ns = 0;
    controller->failsafe_start_ns = 0;
    controller->hold_ns = 0;
    controller->ramp_ns = 0;
    controller->y_samples.count = 0;
    controller->y_samples.newest = 0;
    controller->y_m_samples.count = 0;
    controller->y_m_samples.newest = 0;
    controller->agreeing = 0;
    fill(controller->u, RISE_DI_M, ZERO);
    fill(controller->u_free, RISE_DI_M, ZERO);
    fill(controller->u_trim, RISE_DI_M, ZERO);
    fill(controller->u_ff, RISE_DI_M, ZERO);
    fill(controller->u_failsafe, RISE_DI_M, ZERO);
#if RISE_DI_P > 0
    fill(controller->effectors, RISE_DI_P, ZERO);
    fill(controller->effectors_failsafe, RISE_DI_P, ZERO);
#endif
    return controller->parameters != (const rise_di_parameters *)0;
}

/* The status of a sample, without the tests that compare its values with those of earlier samples. */
static rise_di_status checked(const rise_di_controller *c, const rise_di_samples *samples, int64_t stamp_ns, int64_t now_ns,
                              const rise_di_real *value) {
    rise_di_status status = RISE_DI_TAKEN;
    if (c->parameters == (const rise_di_parameters *)0) {
        status = RISE_DI_NOT_STARTED;
    } else if (elapsed_ns(stamp_ns, now_ns) > (uint64_t)c->parameters->max_age_ns) {
        status = RISE_DI_FUTURE;
    } else if ((samples->count > 0) && (stamp_ns <= samples->seen_ns)) {
        status = RISE_DI_ORDER;
    } else if (!is_finite(value, RISE_DI_M)) {
        status = RISE_DI_NOT_FINITE;
    } else {
        for (int32_t i = 0; i < RISE_DI_M; i++) {
            if (magnitude(value[i]) > c->parameters->y_max[i]) {
                status = RISE_DI_IMPLAUSIBLE;
            }
        }
    }
    return status;
}

/* Whether a sample of y is near the sample `before`. Gives its change per period. */
static bool is_near(const rise_di_controller *c, const rise_di_sample *before, int64_t stamp_ns, const rise_di_real *value,
                    rise_di_real *change) {
    const rise_di_parameters *p = c->parameters;
    const uint64_t span_ns = elapsed_ns(stamp_ns, before->stamp_ns);
    const rise_di_real periods = greater((rise_di_real)span_ns / (rise_di_real)p->period_ns, ONE);
    bool near = true;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        change[i] = magnitude(value[i] - before->value[i]) / periods;
        near = near && (change[i] <= greater(RISE_DI_TIMES * c->change[i], p->y_reach[i]));
    }
    return near;
}

/* Begin to look for a y that stands still, with `changes` y in a row with a change. */
static void begin_stillness(rise_di_controller *c, int64_t stamp_ns, int32_t changes) {
    c->since_ns = stamp_ns;
    c->changes = changes;
    c->equal = 0;
    c->is_frozen = false;
}

/* Whether y stands still: every value as before, though it has changed with every sample before. */
static bool stands_still(rise_di_controller *c, int64_t stamp_ns, const rise_di_real *value) {
    const rise_di_sample *last = sample_at(&c->y_samples, 0);
    bool same = true;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        same = same && is_equal(value[i], last->value[i]);
    }
    if (!same) {
        const int32_t more = (c->changes < RISE_DI_MOVING) ? (c->changes + 1) : RISE_DI_MOVING;
        begin_stillness(c, stamp_ns, (c->is_frozen || (c->equal == 0)) ? more : 1);
    } else {
        const uint64_t longest_ns = (uint64_t)RISE_DI_STILL * (uint64_t)c->parameters->period_ns;
        c->equal = (c->equal < RISE_DI_STILL) ? (c->equal + 1) : RISE_DI_STILL;
        c->is_frozen = (c->equal == RISE_DI_STILL) && (elapsed_ns(stamp_ns, c->since_ns) >= longest_ns) &&
                       (c->changes == RISE_DI_MOVING);
    }
    return c->is_frozen;
}

/* Update the largest change of y by a sample that is taken. In the first second a far change does not count, and a near one counts
 * at most as y_reach, because a gyro may start with wrong values. */
static void note_change(rise_di_controller *c, int64_t stamp_ns, const rise_di_real *value, const rise_di_real *change, bool near,
                        bool first) {
    const rise_di_sample *last = sample_at(&c->y_samples, 0);
    const rise_di_real faded = ONE - lesser(seconds(elapsed_ns(stamp_ns, last->stamp_ns)) / RISE_DI_MEMORY, ONE);
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        rise_di_real seen = change[i];
        if (first) {
            seen = near ? lesser(change[i], c->parameters->y_reach[i]) : ZERO;
        } else if (c->agreeing > 0) {
            seen = magnitude(value[i] - last->value[i]);
        } else {
            /* the change in a period */
        }
        c->change[i] = greater(seen, faded * c->change[i]);
    }
}

/* The status of a y after the tests of how y changes. It is taken in the first second, if it is near the last y, and if it is the
 * last of RISE_DI_AGREEING far samples in a row that agree. In the last case y has jumped, and the law engages again. */
static rise_di_status compared(rise_di_controller *c, int64_t stamp_ns, const rise_di_real *value) {
    const bool first = elapsed_ns(stamp_ns, c->begin_ns) < (uint64_t)RISE_DI_FIRST_NS;
    rise_di_status status = RISE_DI_TAKEN;
    rise_di_real change[RISE_DI_M];
    const bool near = is_near(c, sample_at(&c->y_samples, 0), stamp_ns, value, change);
    if (near || first) {
        note_change(c, stamp_ns, value, change, near, first);
        c->agreeing = 0;
    } else {
        const bool agrees = (c->agreeing > 0) && is_near(c, &c->far, stamp_ns, value, change);
        c->agreeing = agrees ? (c->agreeing + 1) : 1;
        if (c->agreeing < RISE_DI_AGREEING) {
            c->far.stamp_ns = stamp_ns;
            copy(value, c->far.value, RISE_DI_M);
            status = RISE_DI_IMPLAUSIBLE;
        } else {
            c->agreeing = 0;
            rise_di_restart(c);
        }
    }
    return status;
}

rise_di_status rise_di_take_y(rise_di_controller *controller, int64_t stamp_ns, int64_t now_ns, const rise_di_real value[RISE_DI_M]) {
    rise_di_status status = checked(controller, &controller->y_samples, stamp_ns, now_ns, value);
    if ((status == RISE_DI_TAKEN) && (controller->y_samples.count > 0)) {
        controller->y_samples.seen_ns = stamp_ns; /* also of a lost sample, which is refused if it is sent again */
        if (stands_still(controller, stamp_ns, value)) {
            controller->agreeing = 0;
            status = RISE_DI_IMPLAUSIBLE;
        } else {
            status = compared(controller, stamp_ns, value);
        }
    } else if (status == RISE_DI_TAKEN) {
        controller->begin_ns = stamp_ns;
        controller->agreeing = 0;
        begin_stillness(controller, stamp_ns, 0);
        fill(controller->change, RISE_DI_M, ZERO);
    } else {
        /* refused */
    }
    if (status == RISE_DI_TAKEN) {
        rise_di_append(&controller->y_samples, stamp_ns, value);
    }
    return status;
}

rise_di_status rise_di_take_y_m(rise_di_controller *controller, int64_t stamp_ns, int64_t now_ns, const rise_di_real value[RISE_DI_M]) {
    const rise_di_status status = checked(controller, &controller->y_m_samples, stamp_ns, now_ns, value);
    if (status == RISE_DI_TAKEN) {
        rise_di_append(&controller->y_m_samples, stamp_ns, value);
    }
    return status;
}

bool rise_di_tick(rise_di_controller *controller, int64_t now_ns, bool active, rise_di_output *output) {
    const rise_di_samples *samples = &controller->y_samples;
    const rise_di_samples *y_m = &controller->y_m_samples;
    const rise_di_sample *y = (const rise_di_sample *)0;
    if ((controller->parameters != (const rise_di_parameters *)0) && (samples->count > 0)) {
        y = sample_at(samples, 0);
        if (y_m->count > 0) { /* the newest y up to a period after the newest y_m */
            const int64_t known_ns = sample_at(y_m, 0)->stamp_ns;
            const uint64_t period_ns = (uint64_t)controller->parameters->period_ns;
            bool paired = false;
            for (int32_t back = 0; (back < samples->count) && (!paired); back++) {
                if (elapsed_ns(sample_at(samples, back)->stamp_ns, known_ns) <= period_ns) {
                    y = sample_at(samples, back);
                    paired = true;
                }
            }
        }
    }
    return rise_di_guard_tick(controller, now_ns, y, y_m, active, output);
}

const rise_di_real *rise_di_command(const rise_di_controller *controller) {
#if RISE_DI_P > 0
    return controller->effectors;
#else
    return controller->u;
#endif
}

void rise_di_retune(rise_di_controller *controller, const rise_di_parameters *parameters) {
    rise_di_controller *c = controller;
    if ((c->parameters != (const rise_di_parameters *)0) && (parameters->digest != c->parameters->digest)) {
        if (c->has_law) {
            rise_di_real old_scale[RISE_DI_M];
            rise_di_real next_scale[RISE_DI_M];
            scheduled(c->parameters, &c->law, old_scale);
            scheduled(parameters, &c->law, next_scale);
            retune_law(&c->law, c->parameters, old_scale, parameters, next_scale);
#if RISE_DI_S > 0
            if (!same_model(c->parameters, parameters)) {
                for (int32_t i = 0; i < RISE_DI_M; i++) {
                    c->u_trim[i] = c->u_trim[i] + c->law.u_o[i];
                }
                start_estimates(parameters, &c->law, c->y, c->y_m);
            }
#endif
        }
        c->parameters = parameters;
    }
}

void rise_di_restart(rise_di_controller *controller) {
    if (controller->mode == RISE_DI_ENGAGED) {
        controller->mode = RISE_DI_WAITING;
    }
}

/* ---- reference model ---- */

#if RISE_DI_R > 0
void rise_di_reference_start(rise_di_reference *reference, const rise_di_reference_parameters *parameters) {
    reference->parameters = parameters;
    reference->number = 0;
    reference->stamp_ns = 0;
    reference->has_u_m = false;
    fill(reference->u_m, RISE_DI_M, ZERO);
    fill(reference->applied, RISE_DI_M, ZERO);
    fill(reference->x_m, RISE_DI_R, ZERO);
}

rise_di_status rise_di_take_u_m(rise_di_reference *reference, int64_t stamp_ns, const rise_di_real u_m[RISE_DI_M]) {
    rise_di_status status = RISE_DI_TAKEN;
    if (reference->has_u_m && (stamp_ns <= reference->stamp_ns)) {
        status = RISE_DI_ORDER;
    } else if (!is_finite(u_m, RISE_DI_M)) {
        status = RISE_DI_NOT_FINITE;
    } else {
        for (int32_t i = 0; i < RISE_DI_M; i++) {
            if (magnitude(u_m[i]) > reference->parameters->bounds[i]) {
                status = RISE_DI_IMPLAUSIBLE;
            }
        }
    }
    if (status == RISE_DI_TAKEN) {
        reference->has_u_m = true;
        reference->stamp_ns = stamp_ns;
        copy(u_m, reference->u_m, RISE_DI_M);
    }
    return status;
}

void rise_di_reference_step(rise_di_reference *reference, rise_di_real y_m[RISE_DI_M]) {
    const rise_di_reference_parameters *p = reference->parameters;
    const int64_t now_ns = reference->number * p->period_ns;
    const bool aged = elapsed_ns(now_ns, reference->stamp_ns) > (uint64_t)p->max_age_ns;
    rise_di_real inputs[3 * RISE_DI_M];
    rise_di_real moved_x_m[RISE_DI_R];
    rise_di_real driven[RISE_DI_R];
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const rise_di_real u_m = aged ? ZERO : reference->u_m[i];
        const rise_di_real before = reference->applied[i];
        reference->applied[i] = clipped(u_m, before - p->reach[i], before + p->reach[i]);
        for (int32_t k = 0; k < 3; k++) {
            inputs[(k * RISE_DI_M) + i] = reference->applied[i];
        }
    }
    product(p->Phi, RISE_DI_R, RISE_DI_R, reference->x_m, moved_x_m);
    product(p->Gamma, RISE_DI_R, 3 * RISE_DI_M, inputs, driven);
    for (int32_t i = 0; i < RISE_DI_R; i++) {
        reference->x_m[i] = moved_x_m[i] + driven[i];
    }
    product(p->C, RISE_DI_M, RISE_DI_R, reference->x_m, y_m);
    reference->number = reference->number + 1;
}
#endif

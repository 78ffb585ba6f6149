/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "rise_di_rates.h"

#define FADE 0.3f         /* s, of the difference after the spare has taken over */
#define MEAN 0.1f         /* s, time constant of the mean torque of the spare */
#define LONGEST 0.04f     /* s, of a step of these two */
#define PAUSE_PERIODS 50U /* without a sample: the reference model starts again */
#define BIGGEST 1e30f     /* a larger number counts as infinite */

static const rise_di_parameters exported = RISE_DI_PARAMETERS;
static const rise_di_reference_parameters model = RISE_DI_REFERENCE;
static const int32_t axis_of[RISE_DI_M] = RISE_DI_AXES;
static const rise_di_real torque_per_u[RISE_DI_M] = RISE_DI_TORQUE_PER_U;

static bool is_number(float value) { return (value > -BIGGEST) && (value < BIGGEST); }

static float within(float value, float low, float high) { return (value < low) ? low : ((value > high) ? high : value); }

static float least_of(float a, float b) { return (a < b) ? a : b; }

static int64_t in_ns(uint64_t time_us) { return (int64_t)time_us * 1000; }

static bool is_stale(const rise_di_cycle *cycle, uint64_t stamp_us) {
    const uint64_t age_us = (cycle->now_us > stamp_us) ? (cycle->now_us - stamp_us) : 0U;
    return (float)age_us > (cycle->max_age * 1e6f);
}

static bool are_numbers(const rise_di_cycle *cycle) {
    bool numbers = true;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        numbers = numbers && is_number(cycle->rates[axis_of[i]]) && is_number(cycle->setpoint[axis_of[i]]);
    }
    return numbers;
}

static rise_di_refusal refusal_before(const rise_di_rates *rates, const rise_di_cycle *cycle) {
    rise_di_refusal refusal = rates->latched;
    if (!rates->started) {
        refusal = RISE_DI_REFUSED;
    } else if (rates->slow) {
        refusal = RISE_DI_SLOW;
    } else if (!cycle->enabled) {
        refusal = RISE_DI_OFF;
    } else if (!cycle->armed) {
        refusal = RISE_DI_NOT_ARMED;
    } else if (!cycle->has_rates) {
        refusal = RISE_DI_NO_RATES;
    } else if (cycle->landed) {
        refusal = RISE_DI_LANDED;
    } else if (is_stale(cycle, cycle->rates_us)) {
        refusal = RISE_DI_STALE_RATES;
    } else if (is_stale(cycle, cycle->setpoint_us)) {
        refusal = RISE_DI_STALE_SETPOINT;
    } else if (!are_numbers(cycle)) {
        refusal = RISE_DI_NO_NUMBER;
    } else {
        /* that of a fault, or none */
    }
    return refusal;
}

/* Torque of u = 1 at this airspeed over that at the speed of the scenario: less where the surfaces have more effect. */
static rise_di_real effect_scale(const rise_di_cycle *cycle) {
    rise_di_real scale = (rise_di_real)1;
#if RISE_DI_SCALED
    if (is_number(cycle->airspeed) && (cycle->airspeed > 0.0f)) {
        const rise_di_real ratio = RISE_DI_SPEED / (rise_di_real)within(cycle->airspeed, RISE_DI_SLOWEST, RISE_DI_FASTEST);
        scale = ratio * ratio;
    }
#else
    (void)cycle;
#endif
    return scale;
}

/* The samples of y and of y_m for the controller: the reference model steps past the instant of the rates. */
static void take_samples(rise_di_rates *rates, const rise_di_cycle *cycle) {
    const uint64_t stamp_us = (cycle->rates_us > cycle->filter_us) ? (cycle->rates_us - cycle->filter_us) : 0U;
    const int64_t stamp_ns = in_ns(stamp_us);
    const int64_t now_ns = in_ns(cycle->now_us);
    rise_di_real u_m[RISE_DI_M];
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const rise_di_real setpoint = (rise_di_real)cycle->setpoint[axis_of[i]];
        const rise_di_real bound = model.bounds[i];
        u_m[i] = (setpoint > bound) ? bound : ((setpoint < -bound) ? -bound : setpoint);
        rates->y[i] = (rise_di_real)cycle->rates[axis_of[i]];
    }
    if ((cycle->rates_us - rates->last_us) > (((uint64_t)model.period_ns * PAUSE_PERIODS) / 1000U)) {
        rise_di_reference_start(&rates->reference, &model);
        rates->reference_us = stamp_us;
    }
    (void)rise_di_take_u_m(&rates->reference, stamp_ns - in_ns(rates->reference_us), u_m);
    while ((in_ns(rates->reference_us) + (rates->reference.number * model.period_ns)) < stamp_ns) {
        rise_di_reference_step(&rates->reference, rates->y_m);
        (void)rise_di_take_y_m(&rates->controller, in_ns(rates->reference_us) + (rates->reference.number * model.period_ns), now_ns,
                               rates->y_m);
    }
    (void)rise_di_take_y(&rates->controller, stamp_ns, now_ns, rates->y);
}

/* The law begins with the u of the torque that flies. */
static void engage(rise_di_rates *rates, rise_di_real scale) {
    rise_di_restart(&rates->controller);
    rates->number = 0;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        rates->controller.u[i] = (rise_di_real)rates->mean[axis_of[i]] / (torque_per_u[i] * scale);
    }
}

/* No u beyond the torque of 1 at this airspeed: other limits, of the observer too, are other parameters. */
static void limit(rise_di_rates *rates, rise_di_real scale) {
    const rise_di_parameters *now = rates->controller.parameters;
    rise_di_parameters *next = &rates->parameters[(now == &rates->parameters[0]) ? 1 : 0];
    bool changed = false;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const rise_di_real end = (rise_di_real)1 / (((torque_per_u[i] < (rise_di_real)0) ? -torque_per_u[i] : torque_per_u[i]) * scale);
        rates->u_end[i] = end;
        next->limits.lower[i] = (exported.limits.lower[i] < -end) ? -end : exported.limits.lower[i];
        next->limits.upper[i] = (exported.limits.upper[i] > end) ? end : exported.limits.upper[i];
        changed = changed || (next->limits.lower[i] < now->limits.lower[i]) || (next->limits.lower[i] > now->limits.lower[i]) ||
                  (next->limits.upper[i] < now->limits.upper[i]) || (next->limits.upper[i] > now->limits.upper[i]);
#if RISE_DI_S > 0
        next->observer_limits.lower[i] = RISE_DI_OBSERVER_PART * next->limits.lower[i];
        next->observer_limits.upper[i] = RISE_DI_OBSERVER_PART * next->limits.upper[i];
        next->observer_limits.rate[i] = (RISE_DI_OBSERVER_SLEW * (next->limits.upper[i] - next->limits.lower[i])) / (rise_di_real)2;
#endif
    }
    if (changed) {
        rise_di_retune(&rates->controller, next);
    }
}

/* A tick of the law, and the torque of u; what speaks against it. */
static rise_di_refusal tick(rise_di_rates *rates, const rise_di_cycle *cycle, rise_di_real scale, float *torque) {
    rise_di_refusal refusal = RISE_DI_FLIES;
    rise_di_output output;
    if ((in_ns(cycle->rates_us - rates->tick_us) * 4) >= (exported.period_ns * 3)) { /* the rates may come faster */
        rates->tick_us = cycle->rates_us;
        limit(rates, scale);
        if (rise_di_tick(&rates->controller, in_ns(cycle->now_us), true, &output)) {
            rates->number = (output.dt > (rise_di_real)0) ? (rates->number + 1U) : 1U;
            rates->y_us = (uint64_t)output.stamp_ns / 1000U;
            rates->y_m_offset = output.y_m_offset;
        }
    }
    if (rates->controller.mode > RISE_DI_ENGAGED) {
        refusal = RISE_DI_FAILSAFE;
    }
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const float e = (float)(rates->y[i] - rates->y_m[i]);
        const float wanted = (float)(rise_di_command(&rates->controller)[i] * torque_per_u[i] * scale);
        if ((e > cycle->max_error) || (e < -cycle->max_error)) {
            refusal = RISE_DI_DIVERGED;
        }
        if (!is_number(wanted)) {
            refusal = RISE_DI_WRONG_TORQUE;
        }
        torque[axis_of[i]] = within(wanted, -1.0f, 1.0f);
    }
    return refusal;
}

void rise_di_rates_start(rise_di_rates *rates, float rate) {
    rates->parameters[0] = exported;
    rates->parameters[1] = exported;
    rates->parameters[1].digest = exported.digest + 1U;
    rates->started = rise_di_start(&rates->controller, rates->parameters);
    rates->slow = !((rate * (float)exported.period_ns) >= 0.99e9f); /* of a rate that is no number, too */
    rise_di_reference_start(&rates->reference, &model);
    rates->refusal = RISE_DI_OFF;
    rates->latched = RISE_DI_FLIES;
    rates->last_us = 0;
    rates->tick_us = 0;
    rates->reference_us = 0;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        rates->y[i] = (rise_di_real)0;
        rates->y_m[i] = (rise_di_real)0;
        rates->u_end[i] = (rise_di_real)0;
    }
    rates->number = 0;
    rates->y_us = 0;
    rates->y_m_offset = (rise_di_real)0;
    for (int32_t k = 0; k < 3; k++) {
        rates->torque[k] = 0.0f;
        rates->mean[k] = 0.0f;
        rates->handover[k] = 0.0f;
    }
}

bool rise_di_rates_run(rise_di_rates *rates, const rise_di_cycle *cycle) {
    const bool fresh = cycle->rates_us > rates->last_us;
    const float step = fresh ? least_of((float)(cycle->rates_us - rates->last_us) * 1e-6f, LONGEST) : 0.0f;
    const rise_di_real scale = effect_scale(cycle);
    const bool flew = rates->refusal == RISE_DI_FLIES;
    float torque[3] = {cycle->spare[0], cycle->spare[1], cycle->spare[2]}; /* an axis without a channel is the spare's */
    if (!cycle->enabled) {
        rates->latched = RISE_DI_FLIES;
    }
    rates->refusal = refusal_before(rates, cycle);
    if (fresh && are_numbers(cycle)) {
        take_samples(rates, cycle);
    }
    if ((rates->refusal == RISE_DI_FLIES) && (flew || fresh)) {
        if (!flew) {
            engage(rates, scale);
        }
        rates->refusal = tick(rates, cycle, scale, torque);
        rates->latched = rates->refusal;
    } else if (rates->refusal == RISE_DI_FLIES) { /* take-over needs a sample */
        rates->refusal = RISE_DI_STALE_RATES;
    } else {
        /* the spare flies */
    }
    for (int32_t k = 0; k < 3; k++) {
        if (rates->refusal == RISE_DI_FLIES) {
            rates->torque[k] = torque[k];
        } else {
            const float before = flew ? (rates->torque[k] - cycle->spare[k]) : (rates->handover[k] * (1.0f - (step / FADE)));
            rates->handover[k] = is_number(before) ? before : 0.0f;
            rates->torque[k] = within(cycle->spare[k] + rates->handover[k], -1.0f, 1.0f);
            rates->mean[k] = flew ? rates->torque[k] : (rates->mean[k] + ((rates->torque[k] - rates->mean[k]) * (step / MEAN)));
        }
    }
    rates->last_us = fresh ? cycle->rates_us : rates->last_us;
    return rates->refusal == RISE_DI_FLIES;
}

const char *rise_di_refusal_text(rise_di_refusal refusal) {
    static const char *const texts[] = {
        "none", "off", "not armed", "no rate control in this mode", "landed", "stale rates", "stale setpoint",
        "a rate or a setpoint that is not finite", "compiler flags that change the bits", "failsafe of the law",
        "a rate too far from its reference", "a torque that is not finite",
        "rates slower than the controller: export it with --rate",
    };
    return texts[refusal];
}

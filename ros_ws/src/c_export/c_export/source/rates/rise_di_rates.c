/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 */
#include "rise_di_rates.h"

#define FADE 0.3f         /* s, time constant with which the handover fades after the spare has taken over */
#define MEAN 0.1f         /* s, time constant of the mean torque of the spare */
#define LONGEST 0.04f     /* s, longest step of the fade and of the mean */
#define PAUSE_PERIODS 50U /* after more periods than these without a sample, the reference model starts again */
#define BIGGEST 1e30f     /* a larger number counts as infinite */
#define DWELL_US 1000000U  /* time without a fault, after which RISE-DI flies again */
#define WINDOW_US 1000000U /* in which the rate of the samples is measured: a lost one is 1 % of 100 Hz */
#define SLOWEST_PART 0.98f /* of the rate of the law: slower samples are refused */
#define LIKE_PART 1.05f    /* of the rate of the law: up to it each sample is a tick */

static const rise_di_parameters exported = RISE_DI_PARAMETERS;
static const rise_di_reference_parameters model = RISE_DI_REFERENCE;
static const int32_t axis_of[RISE_DI_M] = RISE_DI_AXES;
static const rise_di_real torque_per_u[RISE_DI_M] = RISE_DI_TORQUE_PER_U;

static bool is_number(float value) { return (value > -BIGGEST) && (value < BIGGEST); }

static float within(float value, float low, float high) { return (value < low) ? low : ((value > high) ? high : value); }

static float least_of(float a, float b) { return (a < b) ? a : b; }

static int64_t in_ns(uint64_t time_us) { return (int64_t)time_us * 1000; }

/* Whether a value is within two bounds. NaN is not. */
static bool is_within(float value, float low, float high) { return (value >= low) && (value <= high); }

static float rate_of_law(void) { return 1e9f / (float)exported.period_ns; }

/* Whether a stamp is older than max_age. If max_age is NaN, every stamp is. */
static bool is_stale(const rise_di_cycle *cycle, uint64_t stamp_us, float max_age) {
    const uint64_t age_us = (cycle->now_us > stamp_us) ? (cycle->now_us - stamp_us) : 0U;
    return !((float)age_us <= (max_age * 1e6f));
}

/* The maximum age. If the setting is out of its bounds, it is the largest bound. Only a RISE-DI with nothing to fall back to flies
 * with such a setting. */
static float age_of(const rise_di_cycle *cycle) {
    return is_within(cycle->max_age, RISE_DI_MAX_AGE_LEAST, RISE_DI_MAX_AGE_LARGEST) ? cycle->max_age : RISE_DI_MAX_AGE_LARGEST;
}

/* Whether the setpoint is stale. An autopilot holds the last setpoint for `hold`, so setpoints may come slowly. */
static bool is_setpoint_stale(const rise_di_cycle *cycle) {
    const float age = age_of(cycle);
    const bool is_longer = is_within(cycle->hold, age, RISE_DI_HOLD_LARGEST);
    return is_stale(cycle, cycle->setpoint_us, is_longer ? cycle->hold : age);
}

static bool are_numbers(const rise_di_cycle *cycle) {
    bool numbers = true;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        numbers = numbers && is_number(cycle->rates[axis_of[i]]) && is_number(cycle->setpoint[axis_of[i]]);
    }
    return numbers;
}

/* The first setting that an engineer has to change before RISE-DI can fly. */
static rise_di_refusal wrong_setting(const rise_di_rates *rates, const rise_di_cycle *cycle) {
    rise_di_refusal refusal = RISE_DI_FLIES;
    if (!rates->started) {
        refusal = RISE_DI_REFUSED;
    } else if (rates->is_alone) {
        /* nothing else can fly */
    } else if (!is_within(cycle->max_age, RISE_DI_MAX_AGE_LEAST, RISE_DI_MAX_AGE_LARGEST)) {
        refusal = RISE_DI_WRONG_AGE;
    } else if (!is_within(cycle->max_error, RISE_DI_MAX_ERROR_LEAST, RISE_DI_MAX_ERROR_LARGEST)) {
        refusal = RISE_DI_WRONG_ERROR;
    } else if (!is_within(cycle->hold, 0.0f, RISE_DI_HOLD_LARGEST)) {
        refusal = RISE_DI_WRONG_HOLD;
    } else if ((rates->rate > 0.0f) && (rates->rate < (SLOWEST_PART * rate_of_law()))) {
        refusal = RISE_DI_SLOW;
    } else {
        /* none */
    }
    return refusal;
}

/* The first reason why the pilot or the autopilot does not want RISE-DI to fly. A pilot cannot switch to a spare that fell silent. */
static rise_di_refusal not_wanted(const rise_di_rates *rates, const rise_di_cycle *cycle) {
    rise_di_refusal refusal = RISE_DI_FLIES;
    if ((!cycle->enabled) && (!rates->is_alone)) {
        refusal = RISE_DI_OFF;
    } else if (!cycle->armed) {
        refusal = RISE_DI_NOT_ARMED;
    } else if (!cycle->has_rates) {
        refusal = RISE_DI_NO_RATES;
    } else if (cycle->landed) {
        refusal = RISE_DI_LANDED;
    } else {
        /* none */
    }
    return refusal;
}

/* The first fault that passes by itself. */
static rise_di_refusal fault_of(const rise_di_rates *rates, const rise_di_cycle *cycle) {
    rise_di_refusal refusal = RISE_DI_FLIES;
    if (is_stale(cycle, cycle->rates_us, age_of(cycle))) {
        refusal = RISE_DI_STALE_RATES;
    } else if (is_setpoint_stale(cycle)) {
        refusal = RISE_DI_STALE_SETPOINT;
    } else if (!are_numbers(cycle)) {
        refusal = RISE_DI_NO_NUMBER;
    } else if (rates->is_silent && (!rates->is_alone)) {
        refusal = RISE_DI_SILENT;
    } else {
        /* none */
    }
    return refusal;
}

/* The first reason against RISE-DI: a setting, a wish of the pilot or the autopilot, a fault that passes, or a fault of the law that
 * holds. A take-over also waits until the rate of the samples is measured, and for a second after a fault that passes. */
static rise_di_refusal refusal_before(rise_di_rates *rates, const rise_di_cycle *cycle, bool flew) {
    const rise_di_refusal setting = wrong_setting(rates, cycle);
    const rise_di_refusal wish = not_wanted(rates, cycle);
    const rise_di_refusal fault = fault_of(rates, cycle);
    rise_di_refusal refusal = setting;
    if ((refusal == RISE_DI_FLIES) && (wish != RISE_DI_FLIES)) {
        refusal = wish;
    } else {
        refusal = (refusal == RISE_DI_FLIES) ? fault : refusal;
        rates->fault_us = (refusal == RISE_DI_FLIES) ? rates->fault_us : cycle->now_us;
    }
    refusal = (refusal == RISE_DI_FLIES) ? rates->latched : refusal;
    if ((refusal == RISE_DI_FLIES) && (!flew)) {
        const bool dwells = (!rates->is_alone) && (rates->fault_us > 0U) && ((cycle->now_us - rates->fault_us) < DWELL_US);
        refusal = (dwells || (!(rates->rate > 0.0f))) ? RISE_DI_WAITS : RISE_DI_FLIES;
    }
    return refusal;
}

/* The rate of the samples, over a second. */
static void measure_rate(rise_di_rates *rates, uint64_t stamp_us) {
    const uint64_t span_us = stamp_us - rates->window_us;
    if (rates->window_us == 0U) {
        rates->window_us = stamp_us;
    } else {
        rates->window_samples++;
        if (span_us >= WINDOW_US) {
            rates->rate = ((float)rates->window_samples * 1e6f) / (float)span_us;
            rates->window_us = stamp_us;
            rates->window_samples = 0U;
        }
    }
}

/* Keep the last torque and thrust of the spare that are numbers. If there were none for max_age, the spare is silent. If RISE-DI flies
 * then, it is alone. */
static void take_spare(rise_di_rates *rates, const rise_di_cycle *cycle) {
    bool numbers = true;
    for (int32_t k = 0; k < 3; k++) {
        numbers = numbers && is_number(cycle->spare[k]) && is_number(cycle->spare_thrust[k]);
    }
    if (numbers && (cycle->spare_us > 0U)) {
        rates->spare_us = cycle->spare_us;
        for (int32_t k = 0; k < 3; k++) {
            rates->spare[k] = cycle->spare[k];
            rates->spare_thrust[k] = cycle->spare_thrust[k];
        }
    }
    rates->is_silent = is_stale(cycle, rates->spare_us, age_of(cycle));
    rates->is_alone = rates->is_silent && cycle->armed && (rates->is_alone || (rates->refusal == RISE_DI_FLIES));
}

/* The torque for a u at this airspeed, divided by the torque for this u at the speed of the scenario. It falls with the airspeed,
 * because the surfaces then have more effect. */
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

/* Return whether this sample of the rates gives a y of the law, and set the values and the instant of this y. If the samples come at
 * the rate of the law, each of them is a y. If they come faster, y is interpolated at the periods of the law, when the first sample
 * after its instant has come. */
static bool resample(rise_di_rates *rates, const rise_di_cycle *cycle, uint64_t *instant_us) {
    const uint64_t period_us = ((uint64_t)exported.period_ns + 500U) / 1000U;
    const uint64_t stamp_us = (cycle->rates_us > cycle->filter_us) ? (cycle->rates_us - cycle->filter_us) : 0U;
    const uint64_t step_us = cycle->rates_us - rates->last_us;
    const bool is_like = rates->rate <= (LIKE_PART * rate_of_law());
    const bool is_due = is_like || (stamp_us >= rates->due_us);
    if (is_due) {
        const uint64_t late_us = (is_like || ((stamp_us - rates->due_us) >= step_us)) ? 0U : (stamp_us - rates->due_us);
        const rise_di_real part = (rise_di_real)late_us / (rise_di_real)step_us;
        for (int32_t i = 0; i < RISE_DI_M; i++) {
            const rise_di_real now = (rise_di_real)cycle->rates[axis_of[i]];
            rates->y[i] = (late_us > 0U) ? (now - ((now - (rise_di_real)rates->last[axis_of[i]]) * part)) : now;
        }
        *instant_us = stamp_us - late_us;
        rates->due_us = *instant_us + period_us;
    }
    return is_due;
}

/* Give the controller a y, and every y_m up to the first that is not before this y. */
static void take_samples(rise_di_rates *rates, const rise_di_cycle *cycle, uint64_t stamp_us) {
    const int64_t stamp_ns = in_ns(stamp_us);
    const int64_t now_ns = in_ns(cycle->now_us);
    rise_di_real u_m[RISE_DI_M];
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        const rise_di_real setpoint = (rise_di_real)cycle->setpoint[axis_of[i]];
        const rise_di_real bound = model.bounds[i];
        u_m[i] = (setpoint > bound) ? bound : ((setpoint < -bound) ? -bound : setpoint);
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

/* Let the law engage again, from the u that gives the mean torque of the spare. */
static void engage(rise_di_rates *rates, rise_di_real scale) {
    rise_di_restart(&rates->controller);
    rates->number = 0;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        rates->controller.u[i] = (rise_di_real)rates->mean[axis_of[i]] / (torque_per_u[i] * scale);
    }
}

/* Limit u to the torques from -1 to 1 at this airspeed. If this changes the limits of u, and with them those of the observer, the
 * controller takes other parameters. */
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

/* Compute a tick of the law if there is a y, and give the torque of u. Returns the fault of the law, or RISE_DI_FLIES. */
static rise_di_refusal tick(rise_di_rates *rates, const rise_di_cycle *cycle, bool has_y, rise_di_real scale, float *torque) {
    rise_di_refusal refusal = RISE_DI_FLIES;
    rise_di_output output;
    if (has_y) {
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

void rise_di_rates_start(rise_di_rates *rates) {
    rates->parameters[0] = exported;
    rates->parameters[1] = exported;
    rates->parameters[1].digest = exported.digest + 1U;
    rates->started = rise_di_start(&rates->controller, rates->parameters);
    rise_di_reference_start(&rates->reference, &model);
    rates->is_silent = true;
    rates->is_alone = false;
    rates->refusal = RISE_DI_OFF;
    rates->latched = RISE_DI_FLIES;
    rates->fault_us = 0;
    rates->last_us = 0;
    rates->due_us = 0;
    rates->window_us = 0;
    rates->window_samples = 0;
    rates->rate = 0.0f;
    rates->reference_us = 0;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        rates->y[i] = (rise_di_real)0;
        rates->y_m[i] = (rise_di_real)0;
        rates->u_end[i] = (rise_di_real)0;
    }
    rates->number = 0;
    rates->y_us = 0;
    rates->y_m_offset = (rise_di_real)0;
    rates->spare_us = 0;
    for (int32_t k = 0; k < 3; k++) {
        rates->last[k] = 0.0f;
        rates->torque[k] = 0.0f;
        rates->thrust[k] = 0.0f;
        rates->spare[k] = 0.0f;
        rates->spare_thrust[k] = 0.0f;
        rates->mean[k] = 0.0f;
        rates->handover[k] = 0.0f;
    }
}

/* Set the torque to that of the spare plus the handover. The handover is the difference to the torque that flew before, and fades. */
static void fall_back(rise_di_rates *rates, bool changed, bool flew, float step) {
    for (int32_t k = 0; k < 3; k++) {
        const float spare = rates->is_silent ? 0.0f : rates->spare[k];
        rates->handover[k] = changed ? (rates->torque[k] - spare) : (rates->handover[k] * (1.0f - (step / FADE)));
        rates->torque[k] = within(spare + rates->handover[k], -1.0f, 1.0f);
        rates->mean[k] = flew ? rates->torque[k] : (rates->mean[k] + ((rates->torque[k] - rates->mean[k]) * (step / MEAN)));
    }
}

/* Set the thrust to that of the spare. If the spare is silent, it is the thrust of the setpoint, which the spare would hand on, or 0
 * if the setpoint is stale. */
static void choose_thrust(rise_di_rates *rates, const rise_di_cycle *cycle) {
    const bool is_old = is_setpoint_stale(cycle);
    for (int32_t k = 0; k < 3; k++) {
        const float wanted = (is_old || (!is_number(cycle->setpoint_thrust[k]))) ? 0.0f : cycle->setpoint_thrust[k];
        rates->thrust[k] = rates->is_silent ? within(wanted, -1.0f, 1.0f) : rates->spare_thrust[k];
    }
}

bool rise_di_rates_run(rise_di_rates *rates, const rise_di_cycle *cycle) {
    const bool fresh = cycle->rates_us > rates->last_us;
    const float step = fresh ? least_of((float)(cycle->rates_us - rates->last_us) * 1e-6f, LONGEST) : 0.0f;
    const rise_di_real scale = effect_scale(cycle);
    const bool flew = rates->refusal == RISE_DI_FLIES;
    const bool was_silent = rates->is_silent;
    bool has_y = false;
    uint64_t y_us = 0;
    float torque[3];
    take_spare(rates, cycle);
    if (!cycle->enabled) {
        rates->latched = RISE_DI_FLIES;
    }
    if (fresh) {
        measure_rate(rates, cycle->rates_us);
        has_y = are_numbers(cycle) && resample(rates, cycle, &y_us);
        if (has_y) {
            take_samples(rates, cycle, y_us);
        }
    }
    rates->refusal = refusal_before(rates, cycle, flew);
    if ((rates->refusal == RISE_DI_FLIES) && (!flew)) {
        if (has_y) {
            engage(rates, scale);
        } else { /* take-over needs a y */
            rates->refusal = RISE_DI_WAITS;
        }
    }
    if (rates->refusal == RISE_DI_FLIES) {
        for (int32_t k = 0; k < 3; k++) {
            torque[k] = rates->is_silent ? 0.0f : rates->spare[k]; /* an axis without a channel is the spare's */
        }
        rates->refusal = tick(rates, cycle, has_y, scale, torque);
        rates->latched = rates->refusal;
    }
    if (rates->refusal == RISE_DI_FLIES) {
        for (int32_t k = 0; k < 3; k++) {
            rates->torque[k] = torque[k];
        }
    } else {
        fall_back(rates, flew || (rates->is_silent && (!was_silent)), flew, step);
    }
    choose_thrust(rates, cycle);
    if (fresh) {
        rates->last_us = cycle->rates_us;
        for (int32_t k = 0; k < 3; k++) {
            rates->last[k] = is_number(cycle->rates[k]) ? cycle->rates[k] : rates->last[k];
        }
    }
    return rates->refusal == RISE_DI_FLIES;
}

const char *rise_di_refusal_text(rise_di_refusal refusal) {
    static const char *const texts[] = {
        "none", "off", "not armed", "no rate control in this mode", "landed", "stale rates", "stale setpoint",
        "a rate or a setpoint that is not finite", "compiler flags that change the bits", "failsafe of the law",
        "a rate too far from its reference", "a torque that is not finite",
        "rates slower than the controller: export it with --rate", "the spare does not publish", "maximum age not within 0.01 to 1 s",
        "maximum error not within 0.1 to 30 rad/s", "hold of the setpoint not within 0 to 60 s",
        "waits: measures the rates, or a second since a fault",
    };
    return texts[refusal];
}

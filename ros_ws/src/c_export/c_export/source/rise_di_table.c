/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The table of parameters at run time: name, unit and bounds of each member, and the check of a struct that was edited.
 */
#include <stddef.h>

#include "rise_di.h"

static const rise_di_row table[RISE_DI_ROWS] = {RISE_DI_TABLE};

const rise_di_row *rise_di_row_at(int32_t index) {
    return ((index >= 0) && (index < RISE_DI_ROWS)) ? &table[index] : (const rise_di_row *)0;
}

/* Whether the values lie in their bounds; NaN does not. */
static bool is_within(const rise_di_real *values, const rise_di_row *row) {
    bool within = true;
    for (int32_t i = 0; i < row->count; i++) {
        within = within && (values[i] >= row->least) && (values[i] <= row->largest);
    }
    return within;
}

/* Whether each value of `lower` is at most that of `upper`. */
static bool is_ordered(const rise_di_real *lower, const rise_di_real *upper, int32_t count) {
    bool ordered = true;
    for (int32_t i = 0; i < count; i++) {
        ordered = ordered && (lower[i] <= upper[i]);
    }
    return ordered;
}

const char *rise_di_check(const rise_di_parameters *parameters) {
    const rise_di_parameters *p = parameters;
    const rise_di_real *reals = (const rise_di_real *)(const void *)((const char *)p + offsetof(rise_di_parameters, period));
    const char *wrong = (const char *)0;
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        wrong = ((p->D[i] * p->D[i]) < (rise_di_real)1) ? "D" : wrong;
    }
    wrong = is_ordered(p->limits.lower, p->limits.upper, RISE_DI_M) ? wrong : "limits.lower";
    wrong = is_ordered(&p->dt_least, &p->dt_largest, 1) ? wrong : "dt_least";
#if RISE_DI_P > 0
    wrong = is_ordered(p->stops.lower, p->stops.upper, RISE_DI_P) ? wrong : "stops.lower";
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        wrong = ((p->order[i] >= 0) && (p->order[i] < RISE_DI_M)) ? wrong : "order";
    }
#endif
#if RISE_DI_S > 0
    wrong = is_ordered(p->observer_limits.lower, p->observer_limits.upper, RISE_DI_M) ? wrong : "observer_limits.lower";
#endif
#if RISE_DI_SCHEDULE
    wrong = is_ordered(&p->V_least, &p->V_largest, 1) ? wrong : "V_least";
#endif
    wrong = ((p->sign >= (int64_t)RISE_DI_LITERAL) && (p->sign <= (int64_t)RISE_DI_SOFT)) ? wrong : "sign";
    wrong = ((p->hold_ns >= 0) && (p->ramp_ns >= 0)) ? wrong : "hold_ns, ramp_ns";
    wrong = (p->max_age_ns > 0) ? wrong : "max_age_ns";
    wrong = ((p->period_ns > 0) && (p->slope_ns > 0)) ? wrong : "period_ns, slope_ns";
    for (int32_t k = RISE_DI_ROWS - 1; k >= 0; k--) {
        wrong = is_within(&reals[table[k].place], &table[k]) ? wrong : table[k].name;
    }
    return wrong;
}

/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Which rate controller flies: RISE-DI or the spare, the autopilot's own. No header of an autopilot: times in us of its clock,
 * roll, pitch, yaw in rad/s, torque setpoints from -1 to 1. rise_di_axes.h maps these to the channels of the scenario.
 */
#ifndef RISE_DI_RATES_H
#define RISE_DI_RATES_H

#include "rise_di.h"
#include "rise_di_axes.h"

/* Why the spare flies. */
typedef enum {
    RISE_DI_FLIES = 0,          /* it does not */
    RISE_DI_OFF = 1,            /* not enabled */
    RISE_DI_NOT_ARMED = 2,
    RISE_DI_NO_RATES = 3,       /* no rate control in this mode */
    RISE_DI_LANDED = 4,
    RISE_DI_STALE_RATES = 5,
    RISE_DI_STALE_SETPOINT = 6,
    RISE_DI_NO_NUMBER = 7,      /* a rate or a setpoint is not finite */
    RISE_DI_REFUSED = 8,        /* wrong compiler flags */
    RISE_DI_FAILSAFE = 9,       /* of the law; this and the next two until not enabled */
    RISE_DI_DIVERGED = 10,      /* a rate is too far from its reference */
    RISE_DI_WRONG_TORQUE = 11,  /* not finite */
    RISE_DI_SLOW = 12           /* the rates come slower than the controller's rate */
} rise_di_refusal;

/* What a cycle takes. */
typedef struct {
    uint64_t now_us;
    uint64_t rates_us;    /* of the sample of the rates */
    uint64_t filter_us;   /* delay of the filters of the rates: y is of the instant before it */
    uint64_t setpoint_us; /* of the setpoint */
    bool enabled, armed, has_rates, landed;
    float rates[3];
    float setpoint[3];
    float spare[3];       /* torque of the spare */
    float airspeed;       /* m/s; not finite or 0: unknown, the torque is not scaled */
    float max_age;        /* s */
    float max_error;      /* rad/s */
} rise_di_cycle;

typedef struct {
    rise_di_parameters parameters[2]; /* of the scenario, with the limits of the present airspeed, in turn */
    rise_di_controller controller;
    rise_di_reference reference;
    bool started;
    bool slow; /* the rates come slower than a tick a period needs */
    rise_di_refusal refusal;
    rise_di_refusal latched; /* one of the last three, or RISE_DI_FLIES */
    uint64_t last_us;        /* sample of the rates of the last cycle */
    uint64_t tick_us;        /* and of the last tick */
    uint64_t reference_us;   /* start of the reference model */
    rise_di_real y[RISE_DI_M];
    rise_di_real y_m[RISE_DI_M];
    uint32_t number;            /* of the ticks since the law engaged */
    uint64_t y_us;              /* stamp of the y of the last tick: that of the rates, or of a sample before a lost one */
    rise_di_real y_m_offset;    /* s, of the newest y_m after y, of the last tick */
    rise_di_real u_end[RISE_DI_M]; /* abs(u) of the torque of 1 at the airspeed of the last tick */
    float torque[3];         /* to be sent */
    float mean[3];           /* torque of the spare, low-passed while it flies */
    float handover[3];       /* the last torque less that of the spare when it took over; fades */
} rise_di_rates;

/* Begin with the spare. `rate`, Hz, of the samples of the rates: below that of the controller the spare flies on. */
void rise_di_rates_start(rise_di_rates *rates, float rate);

/* A cycle, at each sample of the rates and when these stop. Returns whether RISE-DI flies; rates->torque is to be sent. */
bool rise_di_rates_run(rise_di_rates *rates, const rise_di_cycle *cycle);

/* The words for a refusal. */
const char *rise_di_refusal_text(rise_di_refusal refusal);

#endif

/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Decides which rate controller flies: RISE-DI, or the spare, which is the autopilot's own. This code needs no header of an
 * autopilot. Times are in us of the autopilot's clock, the rates of roll, pitch and yaw in rad/s, and torques and thrusts from -1
 * to 1. rise_di_axes.h maps the axes to the channels of the scenario.
 */
#ifndef RISE_DI_RATES_H
#define RISE_DI_RATES_H

#include "rise_di.h"
#include "rise_di_axes.h"

/* Why the spare flies. */
typedef enum {
    RISE_DI_FLIES = 0,          /* the spare does not fly */
    RISE_DI_OFF = 1,            /* not enabled */
    RISE_DI_NOT_ARMED = 2,
    RISE_DI_NO_RATES = 3,       /* no rate control in this mode */
    RISE_DI_LANDED = 4,
    RISE_DI_STALE_RATES = 5,
    RISE_DI_STALE_SETPOINT = 6,
    RISE_DI_NO_NUMBER = 7,      /* a rate or a setpoint is not finite */
    RISE_DI_REFUSED = 8,        /* wrong compiler flags */
    RISE_DI_FAILSAFE = 9,       /* of the law; this and the next two hold until RISE-DI is no longer enabled */
    RISE_DI_DIVERGED = 10,      /* a rate is too far from its reference */
    RISE_DI_WRONG_TORQUE = 11,  /* not finite */
    RISE_DI_SLOW = 12,          /* the measured rate of the samples is below the controller's */
    RISE_DI_SILENT = 13,        /* the spare does not publish: no take-over */
    RISE_DI_WRONG_AGE = 14,     /* max_age is out of its bounds */
    RISE_DI_WRONG_ERROR = 15,   /* max_error */
    RISE_DI_WRONG_HOLD = 16,    /* hold */
    RISE_DI_WAITS = 17          /* for the measured rate of the samples, or a second since the last fault */
} rise_di_refusal;

/* Bounds of what a pilot sets; NaN is out of them. */
#define RISE_DI_MAX_AGE_LEAST 0.01f    /* s */
#define RISE_DI_MAX_AGE_LARGEST 1.0f
#define RISE_DI_MAX_ERROR_LEAST 0.1f   /* rad/s */
#define RISE_DI_MAX_ERROR_LARGEST 30.0f
#define RISE_DI_HOLD_LARGEST 60.0f     /* s, from 0 on */

/* What a cycle takes. */
typedef struct {
    uint64_t now_us;
    uint64_t rates_us;    /* of the sample of the rates */
    uint64_t filter_us;   /* delay of the filters of the rates: y is of the instant before it */
    uint64_t setpoint_us; /* of the setpoint */
    uint64_t spare_us;    /* of torque and thrust of the spare, the older of the two; 0: none yet */
    bool enabled, armed, has_rates, landed;
    float rates[3];
    float setpoint[3];
    float setpoint_thrust[3]; /* thrust of the setpoint, which the spare hands on */
    float spare[3];       /* torque of the spare */
    float spare_thrust[3];
    float airspeed;       /* m/s; not finite or 0: unknown, the torque is not scaled */
    float max_age;        /* s, of the rates and of the spare */
    float max_error;      /* rad/s */
    float hold;           /* s, how long the autopilot holds a setpoint; at least max_age */
} rise_di_cycle;

typedef struct {
    rise_di_parameters parameters[2]; /* of the scenario, with the limits of the present airspeed, in turn */
    rise_di_controller controller;
    rise_di_reference reference;
    bool started;
    bool is_silent; /* the spare has given no torque and thrust that are numbers for max_age */
    bool is_alone;  /* the spare fell silent while RISE-DI flew, which has nothing to fall back to */
    rise_di_refusal refusal;
    rise_di_refusal latched; /* a fault that holds until RISE-DI is no longer enabled, or RISE_DI_FLIES */
    uint64_t fault_us;       /* instant of the last cycle with a wrong setting or a fault that passes by itself */
    uint64_t last_us;        /* stamp of the last sample of the rates */
    float last[3];           /* the last rates that are numbers */
    uint64_t due_us;         /* instant of the next y of the law */
    uint64_t window_us;      /* begin of the window in which the rate is measured */
    uint32_t window_samples;
    float rate;              /* Hz, measured, of the samples of the rates; 0: not yet */
    uint64_t reference_us;   /* start of the reference model */
    rise_di_real y[RISE_DI_M];
    rise_di_real y_m[RISE_DI_M];
    uint32_t number;            /* of the ticks since the law engaged */
    uint64_t y_us;              /* stamp of the y of the last tick: that of the rates, or of a sample before a lost one */
    rise_di_real y_m_offset;    /* s, of the newest y_m after y, of the last tick */
    rise_di_real u_end[RISE_DI_M]; /* abs(u) of the torque of 1 at the airspeed of the last tick */
    float torque[3];         /* to be sent */
    float thrust[3];
    uint64_t spare_us;       /* of the last torque and thrust of the spare with all numbers */
    float spare[3];
    float spare_thrust[3];
    float mean[3];           /* torque, low-passed while the spare flies */
    float handover[3];       /* the last torque less that of the spare when it took over; fades */
} rise_di_rates;

/* Begin with the spare. */
void rise_di_rates_start(rise_di_rates *rates);

/* Run a cycle. Call this for each sample of the rates, and also if these stop. Then send rates->torque and rates->thrust. Returns
 * whether RISE-DI flies.
 *
 * The law steps at its own period. If the samples come at most 5 % faster than the law steps, each is a tick. If they come faster, y
 * is interpolated at the periods of the law.
 *
 * RISE-DI does not take over from a silent spare. If the spare falls silent while RISE-DI flies, there is nothing to fall back to.
 * RISE-DI then flies on with the thrust of the setpoint, even if it is no longer enabled. If the law cannot fly, the torque fades to
 * 0, and RISE-DI returns without the wait of a second. */
bool rise_di_rates_run(rise_di_rates *rates, const rise_di_cycle *cycle);

/* The text of a refusal, for the user. */
const char *rise_di_refusal_text(rise_di_refusal refusal);

#endif

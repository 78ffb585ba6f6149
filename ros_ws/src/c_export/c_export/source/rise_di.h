/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The RISE-DI controller in C99: law, anti-windup, limits, guard, allocation, feedforward, observer, schedule; the reference
 * model of live commands. No library, no heap, no global.
 *
 * The caller owns the struct rise_di_controller. Order of calls in a period:
 *
 *   rise_di_start     once, before the first sample; false: do not fly
 *   rise_di_take_y    for each sample of y; rise_di_take_y_m for each sample of y_m
 *   rise_di_tick      once a period; true: send rise_di_command(controller) with the stamp output.stamp_ns
 *
 * Vectors have RISE_DI_M values in the order of RISE_DI_OUTPUTS and RISE_DI_INPUTS (rise_di_parameters.h): SI and rad, deviations
 * from trim. Stamps are nanoseconds of the clock of the caller. Two functions must never run at once for the same controller, not
 * even if one of them runs in an interrupt.
 *
 * Every operation is rounded once to rise_di_real. Compile with -ffp-contract=off: a fused multiply-add has a single rounding for
 * two operations and gives different last bits. Never compile with -ffast-math or a part of it: rise_di.c stops the compiler, or
 * rise_di_start returns false. The equations are those of docs/theory.md.
 */
#ifndef RISE_DI_H
#define RISE_DI_H

#include <stdbool.h>
#include <stdint.h>

#include "rise_di_parameters.h"

#ifndef RISE_DI_REAL
#if RISE_DI_FLOAT32
typedef float rise_di_real;
#else
typedef double rise_di_real;
#endif
#endif

/* How sgn(e) of equation (21) is sampled. */
typedef enum { RISE_DI_LITERAL = 0, RISE_DI_IMPLICIT = 1, RISE_DI_SOFT = 2 } rise_di_sign;

typedef enum {
    RISE_DI_WAITING = 0, /* no y or no y_m received yet: nothing is commanded */
    RISE_DI_ENGAGED = 1, /* the law commands u */
    RISE_DI_HOLD = 2,    /* failsafe: y or y_m is stale, u is held, nothing is integrated */
    RISE_DI_RAMP = 3,    /* failsafe: u ramps to trim */
    RISE_DI_TRIM = 4,    /* failsafe: u is at trim */
    RISE_DI_INACTIVE = 5 /* deactivated: u is held or ramps to trim */
} rise_di_mode;

typedef enum {
    RISE_DI_TAKEN = 0,
    RISE_DI_FUTURE = 1,     /* refused: the stamp is ahead of the clock by more than max_age_ns */
    RISE_DI_ORDER = 2,      /* refused: the stamp is not later than the stamp before */
    RISE_DI_NOT_FINITE = 3, /* refused: NaN or infinite */
    RISE_DI_IMPLAUSIBLE = 4, /* lost: beyond y_max, or a jump of y; the third sample in a row after a jump is taken */
    RISE_DI_NOT_STARTED = 5  /* refused: rise_di_start has not returned true */
} rise_di_status;

/* Limits of magnitude and rate; the largest number of rise_di_real where there is no limit. */
typedef struct {
    rise_di_real lower[RISE_DI_M]; /* units of u, from trim */
    rise_di_real upper[RISE_DI_M]; /* units of u, from trim */
    rise_di_real rate[RISE_DI_M];  /* units of u / s */
} rise_di_limits;

#if RISE_DI_P > 0
#define RISE_DI_COMMANDS RISE_DI_P /* values of a command, in the order of RISE_DI_EFFECTORS */

/* End stops and rates of the effectors. */
typedef struct {
    rise_di_real lower[RISE_DI_P]; /* units of the effector, from trim */
    rise_di_real upper[RISE_DI_P]; /* units of the effector, from trim */
    rise_di_real rate[RISE_DI_P];  /* units of the effector / s */
} rise_di_stops;
#else
#define RISE_DI_COMMANDS RISE_DI_M /* values of a command, in the order of RISE_DI_INPUTS */
#endif

/* Parameters of a controller, constant. RISE_DI_PARAMETERS initialises the parameters of the scenario. */
typedef struct {
    uint64_t digest;          /* hash of the parameters, the channel `parameters` of the log */
    int64_t period_ns;        /* of the ticks */
    int64_t max_age_ns;       /* an older sample is stale */
    int64_t hold_ns;          /* failsafe: how long u is held */
    int64_t ramp_ns;          /* failsafe: how long u then takes to trim */
    int64_t slope_ns;         /* least distance of two samples for a slope of y_m */
    int64_t deactivation_holds; /* 1: u is held when deactivated, 0: u ramps to trim */
    int64_t sign;             /* rise_di_sign */
#if RISE_DI_P > 0
    int64_t order[RISE_DI_M]; /* indices of the inputs of the law, beginning with the one that keeps its effect the longest */
#endif
    rise_di_real period;      /* s */
    rise_di_real dt_least;    /* s, lower limit of dt */
    rise_di_real dt_largest;  /* s, upper limit of dt: max_age_ns + period_ns */
    rise_di_real K[RISE_DI_M];           /* diagonal of K (22), 1/s */
    rise_di_real Lambda[RISE_DI_M];      /* diagonal of Lambda (4), 1/s */
    rise_di_real beta[RISE_DI_M];        /* diagonal of beta (21), units of y / s^2 */
    rise_di_real D[RISE_DI_M];           /* diagonal of D (11), +1 or -1 */
    rise_di_real input_scale[RISE_DI_M]; /* u per scaled input: units of u s / units of y */
    rise_di_real omega[RISE_DI_M];       /* abs(Omega_ii) in scaled inputs; implicit sign */
    rise_di_real eps[RISE_DI_M];         /* half-width of the softened sign, units of y */
    rise_di_real y_max[RISE_DI_M];       /* largest abs(y) and abs(y_m), units of y */
    rise_di_real y_reach[RISE_DI_M];     /* change of y in a period that is always possible, units of y */
    rise_di_limits limits;               /* of u */
#if RISE_DI_P > 0 /* allocation: effectors = T u, u = effect effectors, P effectors; row by row, as every matrix */
    rise_di_real T[RISE_DI_P * RISE_DI_M];
    rise_di_real effect[RISE_DI_M * RISE_DI_P];
    rise_di_real exchange[RISE_DI_P * RISE_DI_P]; /* I - T effect: the motions without effect on u */
    rise_di_stops stops;
#endif
#if RISE_DI_SCHEDULE
    rise_di_real speed;               /* trim speed V0, m/s */
    rise_di_real airspeed[RISE_DI_M]; /* 1 for the output V, else 0 */
    rise_di_real time;                /* time constant of the schedule, s */
    rise_di_real V_least;             /* m/s, where the factor of input_scale is largest */
    rise_di_real V_largest;           /* m/s, where the factor of input_scale is least */
#endif
#if RISE_DI_N > 0 /* feedforward: x_dot = A x + gravity sin(x) + B u, y = C x, N states */
    rise_di_real A[RISE_DI_N * RISE_DI_N];            /* row by row, as every matrix */
    rise_di_real B[RISE_DI_N * RISE_DI_M];
    rise_di_real C[RISE_DI_M * RISE_DI_N];
    rise_di_real gravity[RISE_DI_N * RISE_DI_N];
    rise_di_real inverse[RISE_DI_M * RISE_DI_M];      /* of Omega = C B */
    rise_di_real path_A[RISE_DI_N * RISE_DI_N];       /* (I - B Omega^-1 C) A */
    rise_di_real path_gravity[RISE_DI_N * RISE_DI_N]; /* (I - B Omega^-1 C) gravity */
    rise_di_real lead[RISE_DI_M];                     /* time from a tick until the input acts, s */
    rise_di_real has_sine[RISE_DI_N];                 /* 1 for a state with a sine term, else 0 */
#endif
#if RISE_DI_S > 0 /* observer: z+ = Phi z + Gamma (u - u_trim), e = H z, S estimates */
    rise_di_real Phi[RISE_DI_S * RISE_DI_S];
    rise_di_real Gamma[RISE_DI_S * RISE_DI_M];
    rise_di_real H[RISE_DI_M * RISE_DI_S];
    rise_di_real L[RISE_DI_S * RISE_DI_M]; /* correction of z by e - H z */
    rise_di_real F[RISE_DI_M * RISE_DI_S]; /* u_o = -sigma F z */
    rise_di_limits observer_limits;        /* of u_o */
    rise_di_real fade_rate;                /* of sigma after engagement, 1/s */
#endif
} rise_di_parameters;

/* State of the law between two ticks. */
typedef struct {
    rise_di_real e_0[RISE_DI_M];        /* e at engagement, units of y */
    rise_di_real e[RISE_DI_M];          /* e = y - y_m at the last tick, units of y */
    rise_di_real integral_e[RISE_DI_M]; /* units of y s */
    rise_di_real Pi[RISE_DI_M];         /* equation (21), scaled input */
#if RISE_DI_SCHEDULE
    rise_di_real scale[RISE_DI_M]; /* factor of input_scale */
#endif
#if RISE_DI_S > 0
    rise_di_real z[RISE_DI_S];   /* estimates, predicted for the next tick */
    rise_di_real u_o[RISE_DI_M]; /* contribution to the trim, units of u */
    rise_di_real sigma;          /* fade-in, 0 to 1 */
#endif
} rise_di_law;

#if RISE_DI_N > 0
/* State of the feedforward between two ticks. */
typedef struct {
    rise_di_real x[RISE_DI_N];   /* state of the nominal model, SI */
    rise_di_real u[RISE_DI_M];   /* input in the middle of the last tick */
    rise_di_real dt;             /* of the last tick, s */
    rise_di_real ticks;          /* since engagement */
    rise_di_real u_0[RISE_DI_M]; /* u_ff at engagement */
} rise_di_feedforward;
#endif

typedef struct {
    int64_t stamp_ns;
    rise_di_real value[RISE_DI_M];
} rise_di_sample;

/* The last samples with increasing stamps, a ring. */
typedef struct {
    rise_di_sample sample[RISE_DI_SAMPLES];
    int32_t newest;  /* index of the newest sample */
    int32_t count;   /* number of samples, at most RISE_DI_SAMPLES */
    int64_t seen_ns; /* stamp of the newest sample, or of a later y that was lost because y jumped or stood still */
} rise_di_samples;

/* A controller. The caller reads `mode`, and the command by rise_di_command. Before the law engages, the caller may set u, and the
 * law then begins with this u. */
typedef struct {
    const rise_di_parameters *parameters;
    rise_di_mode mode;
    bool has_law;                    /* whether the law has engaged since the start */
    rise_di_law law;
    int64_t y_stamp_ns;              /* stamp of y of the last step */
    int64_t stamp_ns;                /* of the last u */
    int64_t tick_ns;                 /* instant of the tick that gave the last u */
    rise_di_real y[RISE_DI_M];       /* of the last step */
    rise_di_real y_m[RISE_DI_M];     /* at the stamp of y */
    rise_di_real u[RISE_DI_M];       /* commanded, after saturation, units of u from trim */
    rise_di_real u_free[RISE_DI_M];  /* before saturation */
    rise_di_real u_trim[RISE_DI_M];  /* u at engagement */
    rise_di_real u_ff[RISE_DI_M];    /* feedforward, 0 without */
    int64_t failsafe_start_ns;
    rise_di_real u_failsafe[RISE_DI_M]; /* u at the start of the failsafe */
#if RISE_DI_P > 0
    rise_di_real effectors[RISE_DI_P]; /* commanded, inside stops and rates, from trim; u is what they give */
    rise_di_real effectors_failsafe[RISE_DI_P]; /* at the start of the failsafe */
#endif
    int64_t hold_ns;                 /* times of the present failsafe */
    int64_t ramp_ns;
#if RISE_DI_N > 0
    rise_di_feedforward feedforward;
#endif
    rise_di_samples y_samples;
    rise_di_samples y_m_samples;
    int64_t begin_ns;               /* stamp of the first y taken */
    rise_di_real change[RISE_DI_M]; /* largest change of y in a period, fading, units of y */
    rise_di_sample far;             /* the last y that was lost after a jump */
    int32_t agreeing;               /* number of such y in a row that agree */
    int64_t since_ns;               /* stamp of the first y with the present values */
    int32_t changes;                /* number of y in a row with a change, at most RISE_DI_MOVING */
    int32_t equal;                  /* number of y in a row after that, each with the values before it, at most RISE_DI_STILL */
    bool is_frozen;                 /* whether y stands still */
} rise_di_controller;

/* Inputs of a tick, for a log, and the stamp of u. */
typedef struct {
    int64_t stamp_ns;            /* of u: the stamp of its y; without a y, that of the last u plus the time since then */
    rise_di_real y[RISE_DI_M];
    rise_di_real y_m[RISE_DI_M]; /* at the stamp of y */
    rise_di_real y_m_offset;     /* stamp of the newest y_m minus stamp of y, s */
    rise_di_real dt;             /* step of the law, s; 0 without a step */
} rise_di_output;

/* Set a controller to u = 0, so that it waits for the first samples. `parameters` must live as long as the controller. Returns
 * false if the compiler does not compute what is written; docs/export.md has the flags that it needs. The controller then takes no
 * sample and commands nothing. The same holds for a controller in memory of zeros that was never started. */
bool rise_di_start(rise_di_controller *controller, const rise_di_parameters *parameters);

/* Take a sample of y or of y_m. A sample that is not taken changes nothing, except that a y that jumps or stands still counts in
 * the tests of the next y. */
rise_di_status rise_di_take_y(rise_di_controller *controller, int64_t stamp_ns, int64_t now_ns, const rise_di_real value[RISE_DI_M]);
rise_di_status rise_di_take_y_m(rise_di_controller *controller, int64_t stamp_ns, int64_t now_ns, const rise_di_real value[RISE_DI_M]);

/* Compute the tick at now_ns. If it returns true, send rise_di_command with the stamp output->stamp_ns. If `active` is false, the
 * controller is deactivated. */
bool rise_di_tick(rise_di_controller *controller, int64_t now_ns, bool active, rise_di_output *output);

/* The command, RISE_DI_COMMANDS values from trim. It is u, or with an allocation the values of the effectors. */
const rise_di_real *rise_di_command(const rise_di_controller *controller);

/* Compute a tick with samples of the caller in place of those taken. Without a y, `y` is a null pointer. */
bool rise_di_guard_tick(rise_di_controller *controller, int64_t now_ns, const rise_di_sample *y, const rise_di_samples *y_m,
                        bool active, rise_di_output *output);

/* Replace the parameters between two ticks without a jump of u. Parameters of equal digest change nothing. */
void rise_di_retune(rise_di_controller *controller, const rise_di_parameters *parameters);

/* Let the law engage again with the next fresh y and y_m, from the u at that time. A failsafe goes on until then. */
void rise_di_restart(rise_di_controller *controller);

/* Append a sample to a ring. */
void rise_di_append(rise_di_samples *samples, int64_t stamp_ns, const rise_di_real value[RISE_DI_M]);

/* Check parameters that you have edited. Returns the name of the first member that is out of its bounds, such as "K", or a null
 * pointer if there is none. Give edited parameters another digest, because rise_di_retune takes parameters of equal digest for the
 * same. In rise_di_table.c. */
const char *rise_di_check(const rise_di_parameters *parameters);

#define RISE_DI_TEXT 24 /* characters of a name and of a unit at most, with the 0 at the end */

/* A row of the table of parameters. It describes `count` reals of struct rise_di_parameters. The first of them comes `place` reals
 * after `period`. */
typedef struct {
    char name[RISE_DI_TEXT];
    char unit[RISE_DI_TEXT]; /* y, u: of the channel; v: of an input of the law */
    int32_t place;
    int32_t count;
    rise_di_real least; /* bounds, both allowed */
    rise_di_real largest;
} rise_di_row;

/* The row at an index, or a null pointer if the table has no such row. The first row has the index 0. In rise_di_table.c. */
const rise_di_row *rise_di_row_at(int32_t index);

#if RISE_DI_R > 0
/* Parameters of the reference model, equation (2), constant: x_m+ = Phi x_m + Gamma (u_m, u_m, u_m), y_m = C x_m, R states. */
typedef struct {
    int64_t period_ns;
    int64_t max_age_ns;                            /* the command counts as 0 when u_m is older */
    rise_di_real Phi[RISE_DI_R * RISE_DI_R];       /* row by row, as every matrix */
    rise_di_real Gamma[RISE_DI_R * 3 * RISE_DI_M]; /* for u_m at the begin, in the middle and at the end of a step */
    rise_di_real C[RISE_DI_M * RISE_DI_R];
    rise_di_real bounds[RISE_DI_M];                /* largest abs(u_m), units of y */
    rise_di_real reach[RISE_DI_M];                 /* largest change of u_m from step to step, units of y */
} rise_di_reference_parameters;

/* The reference model at the time number * period_ns since its start. The caller reads `number`. */
typedef struct {
    const rise_di_reference_parameters *parameters;
    int64_t number;                /* of the steps */
    int64_t stamp_ns;              /* of u_m */
    bool has_u_m;
    rise_di_real u_m[RISE_DI_M];     /* the last taken */
    rise_di_real applied[RISE_DI_M]; /* u_m within `bounds` and `reach`, which the model follows */
    rise_di_real x_m[RISE_DI_R];
} rise_di_reference;

/* Set a reference model to x_m = 0. RISE_DI_REFERENCE initialises the parameters of the scenario. */
void rise_di_reference_start(rise_di_reference *reference, const rise_di_reference_parameters *parameters);

/* Take a live command u_m, whose stamp counts from the start of the model. It acts from the next step on. A refused u_m changes
 * nothing. */
rise_di_status rise_di_take_u_m(rise_di_reference *reference, int64_t stamp_ns, const rise_di_real u_m[RISE_DI_M]);

/* Step the model by a period, and give the y_m at the end of the step. */
void rise_di_reference_step(rise_di_reference *reference, rise_di_real y_m[RISE_DI_M]);
#endif

#endif

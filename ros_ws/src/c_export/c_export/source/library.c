/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The controller as a shared library for Python (c_export/library.py). The caller brings the memory of a controller.
 */
#include "rise_di.c"

static const rise_di_parameters exported = RISE_DI_PARAMETERS;

int64_t library_bytes(void);
int64_t library_start(rise_di_controller *controller);
int64_t library_take(rise_di_controller *controller, int64_t is_y, int64_t stamp_ns, int64_t now_ns, const double *value);
int64_t library_tick(rise_di_controller *controller, int64_t now_ns, int64_t active, double *u);
void library_replay(rise_di_controller *controller, int64_t ticks, const int64_t *now_ns, const int64_t *stamp_ns,
                    const int64_t *flags, const int64_t *offset_ns, const double *y, const double *y_m, double *u);

static void from_double(const double *from, rise_di_real *to) {
    for (int32_t i = 0; i < RISE_DI_M; i++) {
        to[i] = (rise_di_real)from[i];
    }
}

/* What the controller sends. */
static void command_of(const rise_di_controller *controller, double *u) {
    for (int32_t i = 0; i < RISE_DI_COMMANDS; i++) {
        u[i] = (double)rise_di_command(controller)[i];
    }
}

int64_t library_bytes(void) { return (int64_t)sizeof(rise_di_controller); }

int64_t library_start(rise_di_controller *controller) { return (int64_t)rise_di_start(controller, &exported); }

int64_t library_take(rise_di_controller *controller, int64_t is_y, int64_t stamp_ns, int64_t now_ns, const double *value) {
    rise_di_real sample[RISE_DI_M];
    from_double(value, sample);
    return (is_y != 0) ? (int64_t)rise_di_take_y(controller, stamp_ns, now_ns, sample)
                       : (int64_t)rise_di_take_y_m(controller, stamp_ns, now_ns, sample);
}

/* Returns the mode, or -1 if u must not be sent. */
int64_t library_tick(rise_di_controller *controller, int64_t now_ns, int64_t active, double *u) {
    rise_di_output output;
    const bool published = rise_di_tick(controller, now_ns, active != 0, &output);
    command_of(controller, u);
    return published ? (int64_t)controller->mode : -1;
}

/* Ticks with the inputs of a log: flags 1 for active, + 2 with samples, + 4 for a new controller, + 8 for a restart. */
void library_replay(rise_di_controller *controller, int64_t ticks, const int64_t *now_ns, const int64_t *stamp_ns,
                    const int64_t *flags, const int64_t *offset_ns, const double *y, const double *y_m, double *u) {
    for (int64_t k = 0; k < ticks; k++) {
        rise_di_samples samples;
        rise_di_sample sample;
        rise_di_output output;
        rise_di_real reference[RISE_DI_M];
        samples.count = 0;
        sample.stamp_ns = stamp_ns[k];
        from_double(&y[k * RISE_DI_M], sample.value);
        from_double(&y_m[k * RISE_DI_M], reference);
        if ((flags[k] & 2) != 0) {
            rise_di_append(&samples, stamp_ns[k], reference);
            if (offset_ns[k] > 0) {
                rise_di_append(&samples, stamp_ns[k] + offset_ns[k], reference);
            }
        }
        if ((flags[k] & 4) != 0) {
            (void)rise_di_start(controller, &exported);
        }
        if ((flags[k] & 8) != 0) {
            rise_di_restart(controller);
        }
        (void)rise_di_guard_tick(controller, now_ns[k], ((flags[k] & 2) != 0) ? &sample : (const rise_di_sample *)0, &samples,
                                 (flags[k] & 1) != 0, &output);
        command_of(controller, &u[k * RISE_DI_COMMANDS]);
    }
}

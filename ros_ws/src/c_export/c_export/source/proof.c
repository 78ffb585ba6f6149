/* SPDX-FileCopyrightText: RISE-DI contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The program of the proof. It reads events of a controller and a reference model, and writes the state after each tick. Its
 * arguments are four files: parameter sets, events, states to load, and the states that it writes.
 * If it is compiled as C++ with counting.h in front, every value counts its operations, and the largest counts of a call go to
 * standard output.
 */
#include <stdio.h>
#include <stdlib.h>

#include "rise_di.c"

enum { START = 0, TAKE_Y = 1, TAKE_Y_M = 2, TICK = 3, RETUNE = 4, RESTART = 5, GUARD_TICK = 6, LOAD = 7, TAKE_U_M = 8,
       STEP_REFERENCE = 9 };

typedef struct {
    /* flag: the index of a set (START, RETUNE); 1 if the controller is active (TICK, GUARD_TICK), and 2 more with samples (GUARD_TICK) */
    int64_t kind, now_ns, stamp_ns, flag, offset_ns;
    double y[RISE_DI_M], y_m[RISE_DI_M];
} event;

static FILE *states;

static void write_integer(int64_t value) { (void)fwrite(&value, sizeof value, 1, states); }

static void write_reals(const rise_di_real *values, int count) {
    for (int i = 0; i < count; i++) {
        const double value = (double)values[i];
        (void)fwrite(&value, sizeof value, 1, states);
    }
}

static void write_state(const rise_di_controller *c, bool published, int64_t refused, const rise_di_output *output) {
    rise_di_law law = c->law;
    rise_di_real y[RISE_DI_M], y_m[RISE_DI_M];
    copy(c->y, y, RISE_DI_M);
    copy(c->y_m, y_m, RISE_DI_M);
    write_integer(published);
    write_integer(refused);
    write_integer(c->mode);
    write_integer(c->has_law);
    write_integer(c->y_stamp_ns);
    write_integer(c->failsafe_start_ns);
    write_integer(c->hold_ns);
    write_integer(c->ramp_ns);
    write_integer(published ? output->stamp_ns : 0);
    write_reals(c->u, RISE_DI_M);
    write_reals(c->u_free, RISE_DI_M);
    write_reals(c->u_trim, RISE_DI_M);
    write_reals(c->u_ff, RISE_DI_M);
    write_reals(c->u_failsafe, RISE_DI_M);
#if RISE_DI_P > 0
    write_reals(rise_di_command(c), RISE_DI_P);
    write_reals(c->effectors_failsafe, RISE_DI_P);
#endif
    if (!c->has_law) { /* nothing of these exists yet */
        fill(y, RISE_DI_M, ZERO);
        fill(y_m, RISE_DI_M, ZERO);
        fill((rise_di_real *)&law, (int32_t)(sizeof law / sizeof(rise_di_real)), ZERO);
    }
    write_reals(y, RISE_DI_M);
    write_reals(y_m, RISE_DI_M);
    write_reals((const rise_di_real *)&law, (int)(sizeof law / sizeof(rise_di_real)));
#if RISE_DI_N > 0
    rise_di_feedforward feedforward = c->feedforward;
    if (!c->has_law) {
        fill((rise_di_real *)&feedforward, (int32_t)(sizeof feedforward / sizeof(rise_di_real)), ZERO);
    }
    write_reals((const rise_di_real *)&feedforward, (int)(sizeof feedforward / sizeof(rise_di_real)));
#endif
    if (published) {
        write_reals(output->y, RISE_DI_M);
        write_reals(output->y_m, RISE_DI_M);
        write_reals(&output->y_m_offset, 1);
        write_reals(&output->dt, 1);
    } else {
        for (int i = 0; i < 2 * RISE_DI_M + 2; i++) {
            write_integer(0);
        }
    }
}

static void read_reals(FILE *from, rise_di_real *values, int count) {
    for (int i = 0; i < count; i++) {
        double value = 0.0;
        (void)!fread(&value, sizeof value, 1, from);
        values[i] = (rise_di_real)value;
    }
}

/* Read the reals that write_state writes into a controller, which is engaged afterwards. */
static void load_state(rise_di_controller *c, FILE *from, int64_t stamp_ns) {
    rise_di_real unused[2 * RISE_DI_M + 2];
    c->mode = RISE_DI_ENGAGED;
    c->has_law = true;
    c->y_stamp_ns = stamp_ns;
    read_reals(from, c->u, RISE_DI_M);
    read_reals(from, c->u_free, RISE_DI_M);
    read_reals(from, c->u_trim, RISE_DI_M);
    read_reals(from, c->u_ff, RISE_DI_M);
    read_reals(from, c->u_failsafe, RISE_DI_M);
#if RISE_DI_P > 0
    read_reals(from, c->effectors, RISE_DI_P);
    read_reals(from, c->effectors_failsafe, RISE_DI_P);
#endif
    read_reals(from, c->y, RISE_DI_M);
    read_reals(from, c->y_m, RISE_DI_M);
    read_reals(from, (rise_di_real *)&c->law, (int)(sizeof c->law / sizeof(rise_di_real)));
#if RISE_DI_N > 0
    read_reals(from, (rise_di_real *)&c->feedforward, (int)(sizeof c->feedforward / sizeof(rise_di_real)));
#endif
    read_reals(from, unused, 2 * RISE_DI_M + 2);
}

static void to_real(const double *from, rise_di_real *to) {
    for (int i = 0; i < RISE_DI_M; i++) {
        to[i] = (rise_di_real)from[i];
    }
}

static bool guard_tick(rise_di_controller *c, const event *next, rise_di_output *output) {
    rise_di_samples y_m;
    rise_di_sample y;
    y_m.count = 0;
    y.stamp_ns = next->stamp_ns;
    if ((next->flag & 2) != 0) {
        rise_di_real value[RISE_DI_M];
        to_real(next->y, y.value);
        to_real(next->y_m, value);
        rise_di_append(&y_m, next->stamp_ns, value);
        if (next->offset_ns > 0) {
            rise_di_append(&y_m, next->stamp_ns + next->offset_ns, value);
        }
    }
    return rise_di_guard_tick(c, next->now_ns, (next->flag & 2) != 0 ? &y : NULL, &y_m, (next->flag & 1) != 0, output);
}

int main(int count, char **arguments) {
    static const rise_di_parameters exported = RISE_DI_PARAMETERS;
    static rise_di_parameters sets[64];
    static rise_di_controller controller;
#if RISE_DI_R > 0
    static const rise_di_reference_parameters model = RISE_DI_REFERENCE;
    static rise_di_reference reference;
#endif
    rise_di_output output;
    event next;
    int64_t refused = 0;
    size_t number = 0;
    FILE *of_sets, *events, *loaded;
    if (count != 5 || (of_sets = fopen(arguments[1], "rb")) == NULL || (events = fopen(arguments[2], "rb")) == NULL ||
        (loaded = fopen(arguments[3], "rb")) == NULL || (states = fopen(arguments[4], "wb")) == NULL) {
        return EXIT_FAILURE;
    }
    while (number < 64 && fread(&sets[number], sizeof sets[0], 1, of_sets) == 1) {
        number++;
    }
    while (fread(&next, sizeof next, 1, events) == 1) {
        rise_di_real y[RISE_DI_M], y_m[RISE_DI_M];
        const rise_di_parameters *set = next.flag <= 0 ? &exported : &sets[(size_t)next.flag % 64];
        bool published = false;
        to_real(next.y, y);
        to_real(next.y_m, y_m);
#ifdef COUNTING
        begin_count();
#endif
        switch (next.kind) {
        case START:
            if (!rise_di_start(&controller, set)) {
                (void)fputs("rise_di_start returns false: the compiler does not compute what is written\n", stderr);
                return EXIT_FAILURE;
            }
            refused = 0;
#if RISE_DI_R > 0
            rise_di_reference_start(&reference, &model);
#endif
            break;
        case TAKE_Y:
            refused = refused * 2 % 1048576 + (rise_di_take_y(&controller, next.stamp_ns, next.now_ns, y) != RISE_DI_TAKEN);
            break;
        case TAKE_Y_M:
            refused = refused * 2 % 1048576 + (rise_di_take_y_m(&controller, next.stamp_ns, next.now_ns, y_m) != RISE_DI_TAKEN);
            break;
        case TICK:
            published = rise_di_tick(&controller, next.now_ns, next.flag != 0, &output);
            break;
        case RETUNE:
            rise_di_retune(&controller, set);
            break;
        case RESTART:
            rise_di_restart(&controller);
            break;
        case GUARD_TICK:
            published = guard_tick(&controller, &next, &output);
            break;
#if RISE_DI_R > 0
        case TAKE_U_M:
            refused = rise_di_take_u_m(&reference, next.stamp_ns, y) != RISE_DI_TAKEN;
            break;
        case STEP_REFERENCE:
            rise_di_reference_step(&reference, y_m);
            write_integer(refused);
            write_reals(y_m, RISE_DI_M);
            write_reals(reference.x_m, RISE_DI_R);
            refused = 0;
            break;
#endif
        case LOAD:
            load_state(&controller, loaded, next.stamp_ns);
            break;
        default:
            return EXIT_FAILURE;
        }
#ifdef COUNTING
        if (next.kind != START) {
            end_count();
        }
#endif
        if (next.kind == TICK || next.kind == GUARD_TICK) {
            write_state(&controller, published, refused, &output);
            refused = 0;
        }
    }
    printf("{\"controller_bytes\": %zu, \"parameters_bytes\": %zu", sizeof controller, sizeof exported);
#ifdef COUNTING
    print_count();
#endif
    printf("}\n");
    return fclose(states) == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}

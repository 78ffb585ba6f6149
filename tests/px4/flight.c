// SPDX-FileCopyrightText: RISE-DI contributors
// SPDX-License-Identifier: Apache-2.0
//
// A flight of rise_di_rates.c around the linear airplane of examples/px4_airplane/rates_airframe.yaml, with a PI of PX4's form as
// the spare. Words key=value on the command line change it; a line of figures comes out.
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rise_di_rates.h"

#define STATES 6
#define STEP 1e-4        /* s, of the integration of the airplane */
#define END_STOP 0.261799 /* rad, at a torque of 1 */

/* alpha, q, beta, p, r, and the bank: along a banked wing gravity moves beta */
static const double A[STATES][STATES] = {{-22.4219, 0.817805, 0, 0, 0, 0},
                                         {-512.964, -19.2404, 0, 0, 0, 0},
                                         {0, 0, -6.92682, -0.0754134, -0.817189, 9.81 / 11.5},
                                         {0, 0, -605.518, -67.1245, 24.2746, 0},
                                         {0, 0, 422.374, 4.78212, -18.1151, 0},
                                         {0, 0, 0, 1, 0, 0}};
static const double B[STATES][3] = {{5.57133, 0, 0}, {533.904, 0, 0}, {0, 0.345125, -5.65739}, {0, 1219.92, -543.938}, {0, -42.0821, 510.508}};
static double x[STATES];
static float integral[3];

/* What a word may set; an instant below 0 is never. */
static double hz = 250, duration = 10, set_hz = 250, max_age = 0.04, max_error = 3, hold = 1, airspeed = 11.5;
static double nan_rates_at = -1, nan_set_at = -1, nan_spare_at = -1, nan_thrust_at = -1, nan_air_at = -1;
static double stop_rates_at = -1, stop_set_at = -1, stop_spare_at = -1, spare_from = 0, off_at = -1, on_at = -1, hz_at = -1, next_hz = 0;
static double stop_wrong_at = 1e9, wrong_age_at = -1, jitter = 0;

static const struct { const char *name; double *value; } WORDS[] = {
    {"hz", &hz}, {"duration", &duration}, {"set_hz", &set_hz}, {"max_age", &max_age}, {"max_error", &max_error}, {"hold", &hold},
    {"airspeed", &airspeed}, {"nan_rates_at", &nan_rates_at}, {"nan_set_at", &nan_set_at}, {"nan_spare_at", &nan_spare_at},
    {"nan_thrust_at", &nan_thrust_at}, {"nan_air_at", &nan_air_at}, {"stop_rates_at", &stop_rates_at}, {"stop_set_at", &stop_set_at},
    {"stop_spare_at", &stop_spare_at}, {"spare_from", &spare_from}, {"off_at", &off_at}, {"on_at", &on_at}, {"hz_at", &hz_at},
    {"next_hz", &next_hz}, {"wrong_age_at", &wrong_age_at}, {"stop_wrong_at", &stop_wrong_at}, {"jitter", &jitter},
};

static void fly_airplane(const float *torque, double time) {
    const double u[3] = {torque[1] * END_STOP, torque[0] * END_STOP, torque[2] * END_STOP};
    for (int s = 0; s < (int)(time / STEP + 0.5); s++) {
        double x_dot[STATES] = {0};
        for (int i = 0; i < STATES; i++) {
            for (int j = 0; j < STATES; j++) { x_dot[i] += A[i][j] * x[j]; }
            for (int j = 0; j < 3; j++) { x_dot[i] += B[i][j] * u[j]; }
        }
        for (int i = 0; i < STATES; i++) { x[i] += STEP * x_dot[i]; }
    }
}

static void step_spare(float *torque, const float *rates, const float *setpoint, float time) {
    const float P[3] = {0.05f, 0.087f, 0.4f}, I[3] = {2.9f, 1.2f, 20.f}, FF[3] = {0.2f, 0.33f, 0.26f};
    for (int k = 0; k < 3; k++) {
        const float error = setpoint[k] - rates[k];
        integral[k] = fmaxf(-0.4f, fminf(0.4f, integral[k] + I[k] * error * time));
        torque[k] = FF[k] * setpoint[k] + P[k] * error + integral[k];
    }
}

static int is_at(double instant, double t, double period) { return instant > 0 && fabs(t - instant) < period / 2; }
static int is_past(double instant, double t) { return instant > 0 && t > instant; }

int main(int argc, char **argv) {
    for (int k = 1; k < argc; k++) {
        const char *equals = strchr(argv[k], '=');
        size_t found = 0;
        while (found < sizeof WORDS / sizeof *WORDS && (equals == NULL || strncmp(argv[k], WORDS[found].name, (size_t)(equals - argv[k])) != 0 ||
                                                        WORDS[found].name[equals - argv[k]] != 0)) { found++; }
        if (found == sizeof WORDS / sizeof *WORDS) { fprintf(stderr, "unknown word %s\n", argv[k]); return 2; }
        *WORDS[found].value = strtod(equals + 1, NULL);
    }
    static rise_di_rates rates;
    rise_di_rates_start(&rates);
    rise_di_cycle cycle;
    memset(&cycle, 0, sizeof cycle);
    unsigned takeovers = 0, fallbacks = 0, ticks = 0, not_numbers = 0, samples = 0;
    double flown = 0, jump = 0, squares = 0, last_set = -1e9, first = -1, fell = -1, t = 0, end_torque = 0, least_gap = 1e9, last_takeover = -1;
    float before[3] = {0}, setpoint[3] = {0}, spare[3] = {0};
    uint64_t last_y_us = 0;
    for (int k = 0; t < duration; k++) {
        const double period = 1.0 / (is_past(hz_at, t) ? next_hz : hz);
        t += period;
        const double noise = jitter * ((k * 7919) % 101 / 50.0 - 1.0); /* fixed and even */
        const uint64_t now_us = 1000000 + (uint64_t)((t + noise) * 1e6 + 0.5);
        cycle.now_us = now_us + 100;
        if (!is_past(stop_rates_at, t)) {
            cycle.rates_us = now_us;
            cycle.rates[0] = (float)x[3];
            cycle.rates[1] = (float)x[1];
            cycle.rates[2] = (float)x[4];
        }
        if (!is_past(stop_set_at, t) && t - last_set >= 1 / set_hz - 1e-9) {
            last_set = t;
            cycle.setpoint_us = now_us;
            for (int i = 0; i < 3; i++) {
                setpoint[i] = (float)((const double[]){0.3, 0.15, 0.1}[i] * sin((3 + i) * t));
                cycle.setpoint_thrust[i] = i == 0 ? (float)(0.5 + 0.1 * sin(t)) : 0.f;
            }
        }
        cycle.filter_us = 5600;
        cycle.enabled = t > 2.5 && !(is_past(off_at, t) && !is_past(on_at, t));
        cycle.armed = cycle.has_rates = true;
        cycle.airspeed = is_past(nan_air_at, t) ? NAN : (float)airspeed;
        cycle.max_age = wrong_age_at > 0 && t > wrong_age_at && t < stop_wrong_at ? NAN : (float)max_age;
        cycle.max_error = (float)max_error;
        cycle.hold = (float)hold;
        memcpy(cycle.setpoint, setpoint, sizeof setpoint);
        const float flown_rates[3] = {(float)x[3], (float)x[1], (float)x[4]};
        step_spare(spare, flown_rates, setpoint, (float)period);
        if (t > spare_from && !is_past(stop_spare_at, t)) {
            cycle.spare_us = now_us;
            memcpy(cycle.spare, spare, sizeof spare);
            memcpy(cycle.spare_thrust, cycle.setpoint_thrust, sizeof cycle.spare_thrust);
        }
        if (is_at(nan_spare_at, t, period)) { cycle.spare[1] = NAN; }
        if (is_at(nan_thrust_at, t, period)) { cycle.spare_thrust[0] = NAN; cycle.setpoint_thrust[0] = NAN; }
        if (is_at(nan_rates_at, t, period)) { cycle.rates[1] = NAN; }
        if (is_at(nan_set_at, t, period)) { cycle.setpoint[1] = NAN; }
        const bool flew = rates.refusal == RISE_DI_FLIES;
        const bool flies = rise_di_rates_run(&rates, &cycle);
        ticks += flies && rates.y_us != last_y_us;
        last_y_us = rates.y_us;
        if (flies && !flew) {
            takeovers++;
            least_gap = last_takeover < 0 ? least_gap : fmin(least_gap, t - last_takeover);
            last_takeover = t;
            first = first < 0 ? t : first;
        }
        if (flew && !flies) { fallbacks++; fell = fell < 0 ? t : fell; }
        flown += flies ? period : 0;
        for (int i = 0; i < 3; i++) {
            not_numbers += !isfinite(rates.torque[i]) || !isfinite(rates.thrust[i]);
            jump = k > 5 && flies != flew ? fmax(jump, fabs(rates.torque[i] - before[i])) : jump;
            before[i] = rates.torque[i];
        }
        for (int i = 0; i < 3 && flies; i++) { squares += pow(rates.y[i] - rates.y_m[i], 2); samples++; }
        fly_airplane(rates.torque, period);
    }
    for (int i = 0; i < 3; i++) { end_torque = fmax(end_torque, fabs(rates.torque[i])); }
    const int64_t drift_us = (int64_t)rates.y_us;
    printf("flown=%.17g takeovers=%u fallbacks=%u tick_rate=%.17g jump=%.17g not_numbers=%u rms=%.17g refusal=%d measured=%.17g first=%.17g "
           "fell=%.17g least_gap=%.17g silent=%d thrust=%.17g wanted_thrust=%.17g torque=%.17g y_us=%lld\n",
           flown, takeovers, fallbacks, flown > 0 ? ticks / flown : 0, jump, not_numbers, samples > 0 ? sqrt(squares / samples) : 0,
           (int)rates.refusal, (double)rates.rate, first, fell, least_gap, (int)rates.is_silent, (double)rates.thrust[0],
           (double)cycle.setpoint_thrust[0], end_torque, (long long)drift_us);
    return 0;
}

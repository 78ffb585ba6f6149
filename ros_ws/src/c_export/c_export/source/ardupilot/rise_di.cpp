// SPDX-FileCopyrightText: RISE-DI contributors
// SPDX-License-Identifier: Apache-2.0
//
// A fast task of ArduPlane between stabilize and set_servos. It gives rates and deflections to rise_di_rates.c, and sets the
// deflections that this returns. ArduPlane's own rate controllers run on as the spare. Deflections are hundredths of a degree, 4500
// at the end stop.
#include "Plane.h"
#if CONFIG_HAL_BOARD == HAL_BOARD_SITL
#include <fenv.h>
#endif

#if !AP_SCRIPTING_ENABLED
#error "RCx_OPTION 300 needs AP_SCRIPTING_ENABLED 1: without it ArduPlane refuses the option and does not arm"
#endif

extern "C" {
#include "rise_di_rates.h"
}

#ifndef RISE_DI_MAX_AGE
#define RISE_DI_MAX_AGE 0.04f // s, of the gyro, at which the spare takes over
#endif
#ifndef RISE_DI_MAX_ERROR
#define RISE_DI_MAX_ERROR 3.0f // rad/s, distance of a rate from its reference at which the spare takes over
#endif

static_assert(RISE_DI_MAX_AGE >= RISE_DI_MAX_AGE_LEAST && RISE_DI_MAX_AGE <= RISE_DI_MAX_AGE_LARGEST, "RISE_DI_MAX_AGE: 0.01 to 1 s");
static_assert(RISE_DI_MAX_ERROR >= RISE_DI_MAX_ERROR_LEAST && RISE_DI_MAX_ERROR <= RISE_DI_MAX_ERROR_LARGEST,
              "RISE_DI_MAX_ERROR: 0.1 to 30 rad/s");

static const float END = 4500.0f;
static const SRV_Channel::Function surfaces[3] {SRV_Channel::k_aileron, SRV_Channel::k_elevator, SRV_Channel::k_rudder};

// The equivalent airspeed, m/s. Before ArduPlane 4.8 its function is named airspeed_estimate.
template <class T> static auto take_airspeed(const T &ahrs, float &airspeed, int) -> decltype(ahrs.airspeed_EAS(airspeed))
{
    return ahrs.airspeed_EAS(airspeed);
}

template <class T> static auto take_airspeed(const T &ahrs, float &airspeed, long) -> decltype(ahrs.airspeed_estimate(airspeed))
{
    return ahrs.airspeed_estimate(airspeed);
}

// Whether the switch of the transmitter is on. It is the channel whose RCx_OPTION is 300, "Scripting1", and on above 1800 us. Without
// such a channel RISE-DI is off.
static bool is_enabled()
{
    const RC_Channel *input = rc().find_channel_for_option(RC_Channel::AUX_FUNC::SCRIPTING_1);
    return input != nullptr && input->get_aux_switch_pos() == RC_Channel::AuxSwitchPos::HIGH;
}

// The self-test divides by 0 and compares NaN. Both would end SITL, so its traps are held meanwhile.
static void start(rise_di_rates &rates)
{
#if CONFIG_HAL_BOARD == HAL_BOARD_SITL
    fenv_t traps;
    feholdexcept(&traps);
    rise_di_rates_start(&rates);
    fesetenv(&traps);
#else
    rise_di_rates_start(&rates);
#endif
}

static const char *text_of(bool flies, const rise_di_rates &rates)
{
    return flies ? "RISE-DI flies" : rise_di_refusal_text(rates.refusal);
}

// Log y, y_m and u. While RISE-DI flies, y is that of the law, else it is that of this loop. TimeUS is the instant of y.
static void write_log(const rise_di_rates &rates, const rise_di_cycle &cycle)
{
#if HAL_LOGGING_ENABLED
    const rise_di_controller &law = rates.controller;
    const bool flies = rates.refusal == RISE_DI_FLIES;
    float y[3] {}, y_m[3] {}, u[3] {};

    for (int i = 0; i < RISE_DI_M; i++) {
        y[i] = (float)(flies ? law.y[i] : rates.y[i]);
        y_m[i] = (float)law.y_m[i];
        u[i] = (float)law.u[i];
    }

    AP::logger().WriteStreaming("RDI", "TimeUS,Y0,Y1,Y2,M0,M1,M2,U0,U1,U2,N,Ref", "QfffffffffIB",
                                flies ? rates.y_us : cycle.rates_us - cycle.filter_us,
                                (double)y[0], (double)y[1], (double)y[2], (double)y_m[0], (double)y_m[1], (double)y_m[2],
                                (double)u[0], (double)u[1], (double)u[2], (unsigned)rates.number, (unsigned)rates.refusal);
#endif
}

void Plane::rise_di()
{
    static rise_di_rates rates;
    static bool begun = false;

    if (!begun) {
        start(rates);
        begun = true;
    }

    const Vector3f &gyro = ahrs.get_gyro();
    const bool manual = control_mode == &mode_manual || control_mode == &mode_training || control_mode == &mode_initializing;
    const bool tunes = control_mode == &mode_autotune; // tunes the spare, which must fly meanwhile
    const float targets[3] {rollController.get_pid_info().target, pitchController.get_pid_info().target,
                            yawController.get_pid_info().target};
    rise_di_cycle cycle {};
    cycle.now_us = AP_HAL::micros64();
    cycle.rates_us = AP::ins().get_gyro_health() ? cycle.now_us : rates.last_us;
    const float cutoff = AP::ins().get_gyro_filter_hz(); // of a second-order filter: delay 1 / (sqrt(2) pi f)
    cycle.filter_us = cutoff > 1.0f ? (uint64_t)(225079.0f / cutoff) : 0;
    cycle.setpoint_us = cycle.now_us; // stabilize has run in this loop
    cycle.spare_us = cycle.now_us;
    cycle.enabled = is_enabled();
    cycle.armed = hal.util->get_soft_armed();
    cycle.has_rates = !manual && !tunes;
    cycle.landed = !is_flying();
#if HAL_QUADPLANE_ENABLED
    cycle.has_rates = cycle.has_rates && !quadplane.in_vtol_mode() && !quadplane.in_assisted_flight();
#endif

    for (int k = 0; k < 3; k++) {
        cycle.rates[k] = gyro[k];
        cycle.setpoint[k] = radians(targets[k]);
        cycle.spare[k] = SRV_Channels::get_output_scaled(surfaces[k]) / END;
    }

    float speed = 0.0f;
    cycle.airspeed = take_airspeed(ahrs, speed, 0) ? speed : 0.0f;
    cycle.max_age = RISE_DI_MAX_AGE;
    cycle.max_error = RISE_DI_MAX_ERROR;

    const bool flew = rates.refusal == RISE_DI_FLIES;
    const rise_di_refusal refused = rates.refusal;
    const bool flies = rise_di_rates_run(&rates, &cycle);
    const bool is_told = cycle.enabled && rates.refusal != refused && rates.refusal != RISE_DI_WAITS;

    for (int k = 0; k < 3 && !manual; k++) {
        SRV_Channels::set_output_scaled(surfaces[k], rates.torque[k] * END);
    }

    if (flies != flew || is_told) {
        GCS_SEND_TEXT(flies ? MAV_SEVERITY_INFO : MAV_SEVERITY_WARNING, "RISE-DI: %s (%.0f Hz)", text_of(flies, rates),
                      (double)rates.rate);
    }

    write_log(rates, cycle);
}

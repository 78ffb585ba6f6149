// SPDX-FileCopyrightText: RISE-DI contributors
// SPDX-License-Identifier: Apache-2.0
//
// The task on a host, with the traps of ArduPlane's SITL: a division by 0, an overflow, an operation on NaN end the process.
// 6 s at 200 Hz in flight, the switch on from 2 s to 4 s. The word "autotune": in that mode. Prints the log and what was told.
#include "Plane.h"
#include <cfenv>
#include <cstdarg>
#include <cstdio>
#include <cstring>

static uint64_t now_us = 1000000;
static float deflections[22];
static const Vector3f gyro {0.0f, 0.0f, 0.0f};
static const AP_PIDInfo pid {0.0f};
static RC_Channel channel;
static RC_Channels channels;
static AP_InertialSensor sensors;
static AP_Logger a_logger;
static AP_HAL::Util util;
static AP_HAL::HAL board {&util};
const AP_HAL::HAL &hal = board;

static double seconds() { return (double)(now_us - 1000000) * 1e-6; }
uint64_t AP_HAL::micros64() { return now_us; }
bool AP_HAL::Util::get_soft_armed() const { return true; }
bool AP_InertialSensor::get_gyro_health() const { return true; }
uint16_t AP_InertialSensor::get_gyro_filter_hz() const { return 20; }
AP_InertialSensor &AP::ins() { return sensors; }
AP_Logger &AP::logger() { return a_logger; }
RC_Channels &rc() { return channels; }
RC_Channel *RC_Channels::find_channel_for_option(RC_Channel::AUX_FUNC) { return &channel; }
RC_Channel::AuxSwitchPos RC_Channel::get_aux_switch_pos() const
{
    return seconds() > 2.0 && seconds() < 4.0 ? AuxSwitchPos::HIGH : AuxSwitchPos::LOW;
}
float SRV_Channels::get_output_scaled(SRV_Channel::Function function) { return deflections[function]; }
void SRV_Channels::set_output_scaled(SRV_Channel::Function function, float value) { deflections[function] = value; }
const AP_PIDInfo &Controller::get_pid_info() const { return pid; }
bool Plane::is_flying() { return true; }
const Vector3f &Plane::AHRS::get_gyro() const { return gyro; }
bool Plane::AHRS::airspeed_EAS(float &airspeed) const { airspeed = 22.0f; return true; }
bool Plane::QuadPlane::in_vtol_mode() const { return false; }
bool Plane::QuadPlane::in_assisted_flight() const { return false; }

void gcs_send_text(MAV_SEVERITY, const char *format, ...)
{
    char line[128];
    va_list values;
    va_start(values, format);
    vsnprintf(line, sizeof line, format, values);
    va_end(values);
    printf("told %.2f %s\n", seconds(), line);
}

void AP_Logger::WriteStreaming(const char *, const char *, const char *fmt, ...)
{
    va_list values;
    va_start(values, fmt);
    static uint64_t last = 0;
    const uint64_t stamp = va_arg(values, uint64_t);
    va_end(values);

    if (stamp <= last) { printf("told %.2f log stands still\n", seconds()); }

    last = stamp;
}

int main(int argc, char **argv)
{
    feenableexcept(FE_OVERFLOW | FE_DIVBYZERO | FE_INVALID);
    static Plane plane;
    plane.control_mode = argc > 1 && strcmp(argv[1], "autotune") == 0 ? &plane.mode_autotune : nullptr;

    for (int k = 0; k < 1200; k++) {
        now_us += 5000;
        plane.rise_di();
    }

    return 0;
}

// What rise_di.cpp uses of ArduPlane 4.8, with the types of its headers: the compiler then checks the shell without ArduPilot.
#pragma once
#include <cstddef>
#include <cstdint>

#define HAL_LOGGING_ENABLED 1
#define HAL_QUADPLANE_ENABLED 1
#define HAL_BOARD_SITL 3
#define CONFIG_HAL_BOARD HAL_BOARD_SITL
#ifndef AP_SCRIPTING_ENABLED
#define AP_SCRIPTING_ENABLED 1
#endif

struct Vector3f {
    float x, y, z;
    float operator[](uint8_t i) const { return i == 0 ? x : (i == 1 ? y : z); }
};
inline constexpr float radians(float deg) { return deg * 0.0174532925f; }

enum MAV_SEVERITY { MAV_SEVERITY_WARNING = 4, MAV_SEVERITY_INFO = 6 };
void gcs_send_text(MAV_SEVERITY severity, const char *format, ...) __attribute__((format(printf, 2, 3)));
#define GCS_SEND_TEXT(severity, format, args...) gcs_send_text(severity, format, ##args)

namespace AP_HAL
{
uint64_t micros64();
struct Util {
    bool get_soft_armed() const;
};
struct HAL {
    Util *util;
};
}
extern const AP_HAL::HAL &hal;

struct AP_InertialSensor {
    bool get_gyro_health() const;
    uint16_t get_gyro_filter_hz() const;
};
struct AP_Logger {
    void WriteStreaming(const char *name, const char *labels, const char *fmt, ...);
};
namespace AP
{
AP_InertialSensor &ins();
AP_Logger &logger();
}

struct SRV_Channel {
    enum Function { k_aileron = 4, k_elevator = 19, k_rudder = 21 };
};
struct SRV_Channels {
    static float get_output_scaled(SRV_Channel::Function function);
    static void set_output_scaled(SRV_Channel::Function function, float value);
};
struct RC_Channel {
    enum class AUX_FUNC : uint16_t {
#if AP_SCRIPTING_ENABLED
        SCRIPTING_1 = 300
#endif
    };
    enum class AuxSwitchPos : uint8_t { LOW, MIDDLE, HIGH };
    AuxSwitchPos get_aux_switch_pos() const;
};
struct RC_Channels {
    RC_Channel *find_channel_for_option(RC_Channel::AUX_FUNC option);
};
RC_Channels &rc();

struct AP_PIDInfo {
    float target;
};
struct Controller {
    const AP_PIDInfo &get_pid_info() const;
};
struct Mode {
};

class Plane
{
public:
    void rise_di();

    // private in ArduPlane: host.cpp sets them
    struct AHRS {
        const Vector3f &get_gyro() const;
        bool airspeed_EAS(float &airspeed) const;
    } ahrs;
    struct QuadPlane {
        bool in_vtol_mode() const;
        bool in_assisted_flight() const;
    } quadplane;
    Controller rollController, pitchController, yawController;
    Mode *control_mode;
    Mode mode_manual, mode_training, mode_initializing, mode_autotune;
    int airspeed; // AP_Airspeed: -Wshadow of ArduPlane is an error
    bool is_flying();
};

// SPDX-FileCopyrightText: RISE-DI contributors
// SPDX-License-Identifier: Apache-2.0
//
// What RiseDiControl.cpp takes of PX4, as far as a compiler needs it: names and types of PX4 1.16, no function of it.
// Each header that the module includes is a link to this file.
#pragma once
#include <cstdint>
#include <cstring>

#define __EXPORT
#define MODULE_NAME "rise_di_control"
#define PX4_OK 0
#define PX4_ERROR (-1)
#define ORB_ID(name) &orb_##name
using hrt_abstime = uint64_t;
using orb_advert_t = void *;
hrt_abstime hrt_absolute_time();
__attribute__((format(printf, 1, 2))) void px4_log(const char *text, ...);
#define PX4_INFO px4_log
#define PX4_WARN px4_log
#define PX4_ERR px4_log
__attribute__((format(printf, 2, 3))) void mavlink_log(orb_advert_t *publication, const char *text, ...);
#define mavlink_log_warning mavlink_log
#define mavlink_log_emergency mavlink_log
namespace math { template <class T> constexpr T min(T a, T b) { return a < b ? a : b; } }
#define PRINT_MODULE_DESCRIPTION(text) px4_log("%s", text)
#define PRINT_MODULE_USAGE_NAME(name, kind) px4_log("%s %s", name, kind)
#define PRINT_MODULE_USAGE_COMMAND(name) px4_log("%s", name)
#define PRINT_MODULE_USAGE_DEFAULT_COMMANDS()

namespace time_literals { constexpr hrt_abstime operator""_ms(unsigned long long t) { return t * 1000; }
constexpr hrt_abstime operator""_s(unsigned long long t) { return t * 1000000; } }

struct orb_metadata {};
extern orb_metadata orb_vehicle_angular_velocity, orb_airspeed_validated, orb_vehicle_land_detected, orb_vehicle_control_mode,
       orb_parameter_update, orb_vehicle_rates_setpoint, orb_vehicle_thrust_setpoint_virtual_fw,
       orb_vehicle_torque_setpoint_virtual_fw, orb_vehicle_thrust_setpoint_virtual_mc,
       orb_vehicle_torque_setpoint_virtual_mc, orb_manual_control_setpoint, orb_rise_di_status, orb_vehicle_thrust_setpoint,
       orb_vehicle_torque_setpoint;

struct vehicle_angular_velocity_s { uint64_t timestamp, timestamp_sample; float xyz[3]; };
struct airspeed_validated_s { uint64_t timestamp; float calibrated_airspeed_m_s; };
struct vehicle_land_detected_s { uint64_t timestamp; bool landed; };
struct vehicle_control_mode_s { uint64_t timestamp; bool flag_armed, flag_control_rates_enabled; };
struct parameter_update_s { uint64_t timestamp; };
struct vehicle_rates_setpoint_s { uint64_t timestamp; float roll, pitch, yaw, thrust_body[3]; };
struct vehicle_thrust_setpoint_s { uint64_t timestamp, timestamp_sample; float xyz[3]; };
struct vehicle_torque_setpoint_s { uint64_t timestamp, timestamp_sample; float xyz[3]; };
struct manual_control_setpoint_s { uint64_t timestamp; float aux1, aux2, aux3, aux4, aux5, aux6; };
struct rise_di_status_s {
	uint64_t timestamp, timestamp_sample, parameters;
	uint32_t number;
	uint8_t mode, refusal;
	double y[3], y_m[3], e[3], u[3], u_end[3], y_m_offset;
	float rate;
};

namespace px4
{
struct wq_config_t {};
namespace wq_configurations { constexpr wq_config_t nav_and_controllers{}; }
struct ScheduledWorkItem {
	ScheduledWorkItem(const char *, const wq_config_t &) {}
	virtual ~ScheduledWorkItem() = default;
	void ScheduleNow();
	void ScheduleDelayed(uint32_t us);
private:
	virtual void Run() = 0;
};
enum class params { RDI_EN, RDI_AUX, RDI_MAX_AGE, RDI_MAX_ERR, COM_OF_LOSS_T, IMU_GYRO_CUTOFF };
}
template <px4::params> struct ParamInt { int32_t get() const; };
template <px4::params> struct ParamFloat { float get() const; };
struct ModuleParams {
	explicit ModuleParams(ModuleParams *) {}
	void updateParams();
};
#define DEFINE_PARAMETERS(a, b, c, d, e, f) PX4_DECLARE(a) PX4_DECLARE(b) PX4_DECLARE(c) PX4_DECLARE(d) PX4_DECLARE(e) PX4_DECLARE(f)
#define PX4_DECLARE(x) PX4_TYPE x;
#define PX4_TYPE(...) __VA_ARGS__

template <class T> struct ModuleBase {
	static T *get_instance();
	static int main(int argc, char *argv[]);
	static bool should_exit();
	static void exit_and_cleanup();
	virtual ~ModuleBase() = default;
	virtual int print_status() = 0;
	struct { void store(T *); } static _object;
	static int _task_id;
	static constexpr int task_id_is_work_queue = -2;
};

namespace uORB
{
struct Subscription {
	explicit Subscription(const orb_metadata *) {}
	bool updated();
	bool update(void *);
	bool copy(void *);
};
struct SubscriptionCallbackWorkItem : Subscription {
	SubscriptionCallbackWorkItem(px4::ScheduledWorkItem *, const orb_metadata *topic) : Subscription(topic) {}
	bool registerCallback();
	void unregisterCallback();
};
template <typename T> struct Publication {
	explicit Publication(const orb_metadata *) {}
	bool advertise();
	bool publish(const T &);
};
}

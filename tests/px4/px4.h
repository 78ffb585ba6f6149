// SPDX-FileCopyrightText: RISE-DI contributors
// SPDX-License-Identifier: Apache-2.0
//
// What RiseDiControl.cpp takes of PX4: names and types of PX4 1.16. Topics and parameters are in the memory of the process, so
// that host.cpp can run the module. Each header that the module includes is a link to this file.
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

namespace px4 { struct ScheduledWorkItem; }
// `place` is that of the last sample among the samples of all topics.
struct orb_metadata { unsigned char data[256]; unsigned generation; px4::ScheduledWorkItem *callback; unsigned place; };
extern unsigned places;
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
	void ScheduleNow() {}
	void ScheduleDelayed(uint32_t) {}
public: // private in PX4: host.cpp calls it
	virtual void Run() = 0;
};
enum class params { RDI_EN, RDI_AUX, RDI_MAX_AGE, RDI_MAX_ERR, COM_OF_LOSS_T, IMU_GYRO_CUTOFF };
}
extern float parameter_values[8]; // by px4::params
template <px4::params name> struct ParamInt { int32_t get() const { return (int32_t)parameter_values[(int)name]; } };
template <px4::params name> struct ParamFloat { float get() const { return parameter_values[(int)name]; } };
struct ModuleParams {
	explicit ModuleParams(ModuleParams *) {}
	void updateParams() {}
};
#define DEFINE_PARAMETERS(a, b, c, d, e, f) PX4_DECLARE(a) PX4_DECLARE(b) PX4_DECLARE(c) PX4_DECLARE(d) PX4_DECLARE(e) PX4_DECLARE(f)
#define PX4_DECLARE(x) PX4_TYPE x;
#define PX4_TYPE(...) __VA_ARGS__

template <class T> struct ModuleBase {
	static T *get_instance() { return _object.instance; }
	static int main(int argc, char *argv[]) { return argc > 1 && strcmp(argv[1], "status") == 0 ? get_instance()->print_status() : T::task_spawn(argc, argv); }
	static bool should_exit() { return false; }
	static void exit_and_cleanup() {}
	virtual ~ModuleBase() = default;
	virtual int print_status() = 0;
	struct Object { T *instance; void store(T *value) { instance = value; } };
	static Object _object;
	static int _task_id;
	static constexpr int task_id_is_work_queue = -2;
};
template <class T> typename ModuleBase<T>::Object ModuleBase<T>::_object{};
template <class T> int ModuleBase<T>::_task_id = -1;

namespace uORB
{
struct Subscription {
	explicit Subscription(orb_metadata *topic) : _topic(topic) {}
	bool updated() const { return _topic->generation != _seen; }
	template <class T> bool copy(T *value)
	{
		static_assert(sizeof(T) <= sizeof _topic->data, "a larger topic");
		memcpy(value, _topic->data, sizeof(T));
		_seen = _topic->generation;
		return true;
	}
	template <class T> bool update(T *value) { return updated() && copy(value); }
protected:
	orb_metadata *_topic;

private:
	unsigned _seen{0};
};
struct SubscriptionCallbackWorkItem : Subscription {
	SubscriptionCallbackWorkItem(px4::ScheduledWorkItem *item, orb_metadata *topic) : Subscription(topic), _item(item) {}
	bool registerCallback()
	{
		_topic->callback = _item;
		return true;
	}
	void unregisterCallback() { _topic->callback = nullptr; }
private:
	px4::ScheduledWorkItem *_item;
};
template <typename T> struct Publication {
	explicit Publication(orb_metadata *topic) : _topic(topic) {}
	bool advertise() { return true; }
	bool publish(const T &value)
	{
		memcpy(_topic->data, &value, sizeof value);
		_topic->generation++;
		_topic->place = ++places;
		return true;
	}
private:
	orb_metadata *_topic;
};
}

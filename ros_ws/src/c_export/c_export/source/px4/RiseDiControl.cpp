// SPDX-FileCopyrightText: RISE-DI contributors
// SPDX-License-Identifier: Apache-2.0
//
// A module of PX4. It gives topics to rise_di_rates.c, and publishes the torque and the thrust that this returns.
// `fw_rate_control start vtol` runs on as the spare.
#include <mathlib/mathlib.h>
#include <px4_platform_common/module.h>
#include <px4_platform_common/module_params.h>
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <systemlib/mavlink_log.h>
#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>
#include <uORB/SubscriptionCallback.hpp>
#include <uORB/topics/airspeed_validated.h>
#include <uORB/topics/manual_control_setpoint.h>
#include <uORB/topics/parameter_update.h>
#include <uORB/topics/rise_di_status.h>
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_control_mode.h>
#include <uORB/topics/vehicle_land_detected.h>
#include <uORB/topics/vehicle_rates_setpoint.h>
#include <uORB/topics/vehicle_thrust_setpoint.h>
#include <uORB/topics/vehicle_torque_setpoint.h>

extern "C" {
#include "rise_di_rates.h"
}

using namespace time_literals;

class RiseDiControl : public ModuleBase<RiseDiControl>, public ModuleParams, public px4::ScheduledWorkItem
{
public:
	RiseDiControl() : ModuleParams(nullptr), ScheduledWorkItem(MODULE_NAME, px4::wq_configurations::nav_and_controllers)
	{
		rise_di_rates_start(&_rates);
		_torque_pub.advertise();
		_thrust_pub.advertise();
		_status_pub.advertise();
	}

	static int task_spawn(int argc, char *argv[]);
	static int custom_command(int argc, char *argv[]) { return print_usage("unknown command"); }
	static int print_usage(const char *reason = nullptr);
	int print_status() override;
	static bool is_stop_refused();

private:
	void Run() override;
	bool is_enabled() const;
	hrt_abstime filter_delay() const;
	void report(bool flew, bool was_alone, const rise_di_cycle &cycle);
	void publish(bool flies);

	uORB::SubscriptionCallbackWorkItem _velocity_sub{this, ORB_ID(vehicle_angular_velocity)};
	uORB::SubscriptionCallbackWorkItem _spare_torque_sub{this, ORB_ID(vehicle_torque_setpoint_virtual_fw)}; // handed on without delay
	uORB::Subscription _airspeed_sub{ORB_ID(airspeed_validated)};
	uORB::Subscription _landed_sub{ORB_ID(vehicle_land_detected)};
	uORB::Subscription _mode_sub{ORB_ID(vehicle_control_mode)};
	uORB::Subscription _parameters_sub{ORB_ID(parameter_update)};
	uORB::Subscription _setpoint_sub{ORB_ID(vehicle_rates_setpoint)};
	uORB::Subscription _spare_thrust_sub{ORB_ID(vehicle_thrust_setpoint_virtual_fw)};
	uORB::Subscription _sticks_sub{ORB_ID(manual_control_setpoint)};
	uORB::Publication<rise_di_status_s> _status_pub{ORB_ID(rise_di_status)};
	uORB::Publication<vehicle_thrust_setpoint_s> _thrust_pub{ORB_ID(vehicle_thrust_setpoint)};
	uORB::Publication<vehicle_torque_setpoint_s> _torque_pub{ORB_ID(vehicle_torque_setpoint)};

	airspeed_validated_s _airspeed{};
	manual_control_setpoint_s _sticks{};
	vehicle_angular_velocity_s _velocity{};
	vehicle_control_mode_s _mode{};
	vehicle_land_detected_s _landed{};
	vehicle_rates_setpoint_s _setpoint{};
	vehicle_thrust_setpoint_s _spare_thrust{};
	vehicle_torque_setpoint_s _spare_torque{};

	rise_di_rates _rates{};
	rise_di_refusal _told{RISE_DI_OFF};
	uint32_t _takeovers{0};
	uint32_t _fallbacks{0};
	orb_advert_t _mavlink_log_pub{nullptr};

	DEFINE_PARAMETERS(
		(ParamInt<px4::params::RDI_EN>) _enabled,
		(ParamInt<px4::params::RDI_AUX>) _aux,
		(ParamFloat<px4::params::RDI_MAX_AGE>) _max_age,
		(ParamFloat<px4::params::RDI_MAX_ERR>) _max_error,
		(ParamFloat<px4::params::COM_OF_LOSS_T>) _hold,
		(ParamFloat<px4::params::IMU_GYRO_CUTOFF>) _cutoff
	)
};

// The delay of the second-order Butterworth filter of the gyro at low frequencies, us: 1 / (sqrt(2) pi f).
hrt_abstime RiseDiControl::filter_delay() const
{
	const float cutoff = _cutoff.get();
	return cutoff > 1.f ? (hrt_abstime)(225079.f / cutoff) : 0;
}

bool RiseDiControl::is_enabled() const
{
	const float aux[] {1.f, _sticks.aux1, _sticks.aux2, _sticks.aux3, _sticks.aux4, _sticks.aux5, _sticks.aux6};
	const int32_t place = _aux.get();
	return _enabled.get() != 0 && place >= 0 && place <= 6 && aux[place] > 0.5f;
}

void RiseDiControl::Run()
{
	if (should_exit()) {
		_velocity_sub.unregisterCallback();
		_spare_torque_sub.unregisterCallback();
		exit_and_cleanup();
		return;
	}

	if (_parameters_sub.updated()) {
		parameter_update_s update;
		_parameters_sub.copy(&update);
		updateParams();
	}

	const bool fresh = _velocity_sub.update(&_velocity);
	const bool spare_fresh = _spare_torque_sub.update(&_spare_torque);
	_airspeed_sub.update(&_airspeed);
	_landed_sub.update(&_landed);
	_mode_sub.update(&_mode);
	_setpoint_sub.update(&_setpoint);
	_spare_thrust_sub.update(&_spare_thrust);
	_sticks_sub.update(&_sticks);

	const hrt_abstime now = hrt_absolute_time();
	rise_di_cycle cycle{};
	cycle.now_us = now;
	cycle.rates_us = _velocity.timestamp_sample;
	cycle.filter_us = filter_delay();
	cycle.setpoint_us = _setpoint.timestamp;
	cycle.spare_us = math::min(_spare_torque.timestamp, _spare_thrust.timestamp);
	cycle.enabled = is_enabled();
	cycle.armed = _mode.flag_armed;
	cycle.has_rates = _mode.flag_control_rates_enabled;
	cycle.landed = _landed.landed;
	const float setpoint[3] {_setpoint.roll, _setpoint.pitch, _setpoint.yaw};

	for (int k = 0; k < 3; k++) {
		cycle.rates[k] = _velocity.xyz[k];
		cycle.setpoint[k] = setpoint[k];
		cycle.setpoint_thrust[k] = _setpoint.thrust_body[k];
		cycle.spare[k] = _spare_torque.xyz[k];
		cycle.spare_thrust[k] = _spare_thrust.xyz[k];
	}

	cycle.airspeed = now < _airspeed.timestamp + 1_s ? _airspeed.calibrated_airspeed_m_s : 0.f;
	cycle.max_age = _max_age.get();
	cycle.max_error = _max_error.get();
	cycle.hold = _hold.get();

	const bool flew = _rates.refusal == RISE_DI_FLIES;
	const bool was_alone = _rates.is_alone;
	const bool flies = rise_di_rates_run(&_rates, &cycle);
	report(flew, was_alone, cycle);

	if (flies ? fresh : (spare_fresh || flew || _rates.is_alone)) { publish(flies); }

	ScheduleDelayed(20_ms); // so that a cycle also runs if the rates stop
}

// Report each change between RISE-DI and the spare. While RISE-DI is enabled but does not fly, report why.
void RiseDiControl::report(bool flew, bool was_alone, const rise_di_cycle &cycle)
{
	const rise_di_refusal refusal = _rates.refusal;
	const bool flies = refusal == RISE_DI_FLIES;
	_takeovers += flies && !flew ? 1 : 0;
	_fallbacks += flew && !flies ? 1 : 0;

	if (flies && !flew) {
		PX4_INFO("RISE-DI flies");

	} else if (flew ? !flies : (cycle.enabled && refusal != RISE_DI_WAITS && refusal != _told)) {
		mavlink_log_warning(&_mavlink_log_pub, "RISE-DI does not fly: %s (rates %.0f Hz)\t",
				    rise_di_refusal_text(refusal), (double)_rates.rate);
	}

	_told = !cycle.enabled ? RISE_DI_OFF : (refusal == RISE_DI_WAITS ? _told : refusal);

	if (_rates.is_alone && !was_alone) {
		mavlink_log_emergency(&_mavlink_log_pub, "RISE-DI: fw_rate_control is silent, no fall-back, land\t");
	}
}

void RiseDiControl::publish(bool flies)
{
	vehicle_torque_setpoint_s torque{};
	rise_di_status_s status{};
	torque.timestamp_sample = flies || _rates.is_silent ? _velocity.timestamp_sample : _spare_torque.timestamp_sample;

	for (int k = 0; k < 3; k++) { torque.xyz[k] = _rates.torque[k]; }

	torque.timestamp = hrt_absolute_time();

	vehicle_thrust_setpoint_s thrust{};
	thrust.timestamp = torque.timestamp;
	thrust.timestamp_sample = torque.timestamp_sample;

	for (int k = 0; k < 3; k++) { thrust.xyz[k] = _rates.thrust[k]; }

	// The allocator runs on the torque, and takes the thrust that it finds then (PX4 1.17 publishes in this order, too).
	_thrust_pub.publish(thrust);
	_torque_pub.publish(torque);

	status.timestamp = torque.timestamp;
	status.timestamp_sample = flies ? _rates.y_us : _velocity.timestamp_sample;
	status.mode = _rates.controller.mode;
	status.refusal = _rates.refusal;
	status.number = _rates.number;
	status.parameters = _rates.parameters[0].digest;
	status.y_m_offset = (double)_rates.y_m_offset;
	status.rate = _rates.rate;

	for (int i = 0; i < RISE_DI_M; i++) {
		status.y[i] = (double)(flies ? _rates.controller.y[i] : _rates.y[i]);
		status.y_m[i] = (double)_rates.controller.y_m[i];
		status.e[i] = (double)_rates.controller.law.e[i];
		status.u[i] = (double)_rates.controller.u[i];
		status.u_end[i] = (double)_rates.u_end[i];
	}

	_status_pub.publish(status);
}

bool RiseDiControl::is_stop_refused()
{
	RiseDiControl *instance = get_instance();
	return instance != nullptr && instance->_mode.flag_armed;
}

int RiseDiControl::task_spawn(int argc, char *argv[])
{
	RiseDiControl *instance = new RiseDiControl();

	if (instance == nullptr || !instance->_velocity_sub.registerCallback() || !instance->_spare_torque_sub.registerCallback()) {
		delete instance;
		return PX4_ERROR;
	}

	_object.store(instance);
	_task_id = task_id_is_work_queue;
	instance->ScheduleNow();
	return PX4_OK;
}

int RiseDiControl::print_status()
{
	PX4_INFO("RISE-DI %s, %u take-overs, %u fall-backs", _rates.refusal == RISE_DI_FLIES ? "flies" : "does not fly",
		 (unsigned)_takeovers, (unsigned)_fallbacks);
	PX4_INFO("refusal: %s", rise_di_refusal_text(_rates.refusal));
	PX4_INFO("rates at %.1f Hz, fw_rate_control %s", (double)_rates.rate, _rates.is_silent ? "silent" : "alive");
	return PX4_OK;
}

int RiseDiControl::print_usage(const char *reason)
{
	if (reason != nullptr) { PX4_WARN("%s", reason); }

	PRINT_MODULE_DESCRIPTION("RISE-DI rate controller, written by rise-di export --px4. Its spare: fw_rate_control start vtol.");
	PRINT_MODULE_USAGE_NAME("rise_di_control", "controller");
	PRINT_MODULE_USAGE_COMMAND("start");
	PRINT_MODULE_USAGE_DEFAULT_COMMANDS();
	return 0;
}

extern "C" __EXPORT int rise_di_control_main(int argc, char *argv[])
{
	if (argc > 1 && strcmp(argv[1], "stop") == 0 && RiseDiControl::is_stop_refused()) {
		PX4_ERR("refused while armed: nothing else publishes the torque");
		return PX4_ERROR;
	}

	return RiseDiControl::main(argc, argv);
}

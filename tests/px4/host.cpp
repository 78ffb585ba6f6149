// SPDX-FileCopyrightText: RISE-DI contributors
// SPDX-License-Identifier: Apache-2.0
//
// The module RiseDiControl.cpp on a host, with the topics and parameters of px4.h: 8 s at 250 Hz, RDI_EN 1 from 2 s on.
// The words: an event of `main`, and its instant, s. Prints what the module published and told.
#include "px4.h"
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>

static hrt_abstime now_us = 1000000;
hrt_abstime hrt_absolute_time() { return now_us; }
orb_metadata orb_vehicle_angular_velocity, orb_airspeed_validated, orb_vehicle_land_detected, orb_vehicle_control_mode,
	     orb_parameter_update, orb_vehicle_rates_setpoint, orb_vehicle_thrust_setpoint_virtual_fw,
	     orb_vehicle_torque_setpoint_virtual_fw, orb_vehicle_thrust_setpoint_virtual_mc, orb_vehicle_torque_setpoint_virtual_mc,
	     orb_manual_control_setpoint, orb_rise_di_status, orb_vehicle_thrust_setpoint, orb_vehicle_torque_setpoint;
float parameter_values[8];
unsigned places;

// PX4 cuts a line of its log after 126 characters, of which 43 are level, name of the module and colours.
static void print(const char *text, va_list values, size_t size)
{
	char line[128];
	vsnprintf(line, size, text, values);
	printf("told %.2f %s\n", (double)(now_us - 1000000) * 1e-6, line);
}
void px4_log(const char *text, ...) { va_list values; va_start(values, text); print(text, values, 84); va_end(values); }
void mavlink_log(orb_advert_t *, const char *text, ...) { va_list values; va_start(values, text); print(text, values, 127); va_end(values); }
extern "C" int rise_di_control_main(int argc, char *argv[]);

// Returns what waits for the topic.
template <class T> static px4::ScheduledWorkItem *send(orb_metadata &topic, T value)
{
	uORB::Publication<T>(&topic).publish(value);
	return topic.callback;
}

int main(int argc, char **argv)
{
	const char *event = argc > 1 ? argv[1] : "";
	const double at = argc > 2 ? atof(argv[2]) : 1e9;
	float values[8] = {0.f, 0.f, 0.04f, 3.f, 1.f, 40.f}; // RDI_EN, RDI_AUX, RDI_MAX_AGE, RDI_MAX_ERR, COM_OF_LOSS_T, IMU_GYRO_CUTOFF
	memcpy(parameter_values, values, sizeof values);
	char name[] = "rise_di_control", start[] = "start", stop[] = "stop", status[] = "status";
	char *words[] = {name, start};
	rise_di_control_main(2, words);
	unsigned not_numbers = 0;

	for (int k = 0; k < 2000; k++) {
		now_us += strcmp(event, "slow") == 0 ? 5000 : 4000;
		const double t = (double)(now_us - 1000000) * 1e-6;
		const bool past = t > at;
		const bool once = std::fabs(t - at) < 0.002;
		const auto is = [event](const char *text) { return strcmp(event, text) == 0; };
		parameter_values[0] = t > 2.0 && !(past && is("off")) ? 1.f : 0.f;
		parameter_values[2] = past && is("age") ? NAN : 0.04f;
		vehicle_control_mode_s mode{};
		mode.flag_armed = mode.flag_control_rates_enabled = true;
		send(orb_vehicle_control_mode, mode);
		const float thrust = 0.5f + 0.1f * (float)std::sin(t);

		if (!(past && is("setpoint"))) { send(orb_vehicle_rates_setpoint, vehicle_rates_setpoint_s{now_us, 0.1f, 0.f, 0.f, {thrust, 0.f, 0.f}}); }

		const auto send_spare = [&] {
			const float roll = once && is("nan_torque") ? NAN : 0.1f;
			const float first = once && is("nan_thrust") ? NAN : thrust;
			send(orb_vehicle_thrust_setpoint_virtual_fw, vehicle_thrust_setpoint_s{now_us, now_us, {first, 0.f, 0.f}});
			return send(orb_vehicle_torque_setpoint_virtual_fw, vehicle_torque_setpoint_s{now_us, now_us, {roll, -0.2f, 0.05f}});
		};

		if (!(past && is("spare")) && !is("never") && !is("behind")) { send_spare(); }

		if (!(past && is("rates"))) {
			const float roll = once && is("nan_rates") ? NAN : 0.1f;
			send(orb_vehicle_angular_velocity, vehicle_angular_velocity_s{now_us, now_us, {roll, 0.f, 0.f}});
		}

		orb_vehicle_angular_velocity.callback->Run();

		if (is("behind")) { // by a task of another priority
			px4::ScheduledWorkItem *const woken = send_spare();

			if (woken != nullptr) { woken->Run(); }
		}

		vehicle_torque_setpoint_s torque{};
		vehicle_thrust_setpoint_s sent{};
		memcpy(&torque, orb_vehicle_torque_setpoint.data, sizeof torque);
		memcpy(&sent, orb_vehicle_thrust_setpoint.data, sizeof sent);

		for (int i = 0; i < 3; i++) { not_numbers += !std::isfinite(torque.xyz[i]) || !std::isfinite(sent.xyz[i]); }

		if (torque.timestamp_sample != now_us && !(past && is("rates"))) { printf("told %.2f late torque\n", t); }

		// PX4's allocator runs on the torque, and takes the thrust that it finds then
		if (orb_vehicle_thrust_setpoint.place > orb_vehicle_torque_setpoint.place) { printf("told %.2f late thrust\n", t); }

		if (k == 1999) {
			printf("published %u %u not_numbers %u thrust %.4f wanted %.4f torque %.4f\n", orb_vehicle_torque_setpoint.generation,
			       orb_vehicle_thrust_setpoint.generation, not_numbers, (double)sent.xyz[0], (double)thrust, (double)torque.xyz[0]);
		}
	}

	words[1] = stop;
	printf("stop %d\n", rise_di_control_main(2, words));
	words[1] = status;
	rise_di_control_main(2, words);
	return 0;
}

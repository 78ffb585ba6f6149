#!/bin/sh
# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
#
# Starts a program of the stack by its name (rise-di, aircraft, controller, ...), or any other command, within the workspace.
set -e
PATH=/opt/rise-di/venv/bin:$PATH
. /opt/rise-di/install/setup.sh
name=${1:?no command given, expected rise-di, aircraft, controller, reference_model, recorder, or another program}
shift
for program in /opt/rise-di/install/lib/*/"$name"; do
  [ ! -x "$program" ] || exec "$program" "$@"
done
if [ "$name" = ros2 ]; then # under the interpreter of the venv, whose packages the launch files need
  set -- "$(command -v ros2)" "$@"
  name=python3
fi
exec "$name" "$@"

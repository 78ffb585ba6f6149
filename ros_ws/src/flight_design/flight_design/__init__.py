# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Design of a flight control law: gains, identification of the aircraft, learning in flight."""

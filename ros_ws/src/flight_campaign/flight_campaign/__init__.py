# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo campaigns over thousands of uncertain aircraft.

Control laws are tuned and compared, too.
"""

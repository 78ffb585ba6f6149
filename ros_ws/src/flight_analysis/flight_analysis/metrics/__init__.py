# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute metrics of a flight, each as a pure function of the tape of the flight."""

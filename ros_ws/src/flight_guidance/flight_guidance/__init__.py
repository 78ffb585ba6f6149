# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guidance of the RISE-DI flight stack: attitude, altitude, course and routes outside the control
law.
"""

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenarios, launch files, process runner and service clients of the RISE-DI flight stack."""

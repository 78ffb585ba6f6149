# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The plant of equation (1) with its actuators, and the faults of effectors."""

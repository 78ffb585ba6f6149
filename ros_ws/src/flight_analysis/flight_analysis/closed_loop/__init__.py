# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read a scenario, fly it as a closed loop in one process, and replay a recorded flight."""

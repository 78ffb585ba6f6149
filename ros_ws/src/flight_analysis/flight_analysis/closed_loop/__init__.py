# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A scenario, the closed loop in one process, and the replay of a recorded flight."""

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Start and follow flights: launch files, process runner, monitor and player."""

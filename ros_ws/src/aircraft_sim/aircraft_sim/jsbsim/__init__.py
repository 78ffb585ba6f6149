# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Aircraft of JSBSim: their files, trim, commands, flight and linearisation."""

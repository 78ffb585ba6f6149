# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The air: gusts, turbulence, and wind that varies with the position."""

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Control laws under one tuning procedure, compared on the same aircraft and winds."""

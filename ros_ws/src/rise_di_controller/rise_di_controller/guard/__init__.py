# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guard the law with checks of samples, engagement, failsafe and probe."""

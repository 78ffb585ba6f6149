# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What stands between the law and the aircraft: samples, engagement, failsafe, probe."""

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""From a recorded flight to its summary, figures, tables and report page."""

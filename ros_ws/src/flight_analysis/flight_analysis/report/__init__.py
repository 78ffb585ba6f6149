# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""From a recorded flight to summary, figures, tables and report page."""

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Turn a recorded flight into a summary, figures, tables and a report page."""

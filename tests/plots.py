# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the figures of a report as the Python library plotly does.

It refuses names and values that plotly.js does not know.
"""

import plotly.graph_objects as go

from flight_analysis.report.plotting import Figure


def drawn(figure: Figure | None) -> go.Figure:
    """Return the figure, which must exist."""
    assert figure is not None
    return go.Figure(figure.data, figure.layout)

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures of a report as the Python library plotly reads them.

It refuses names and values that plotly.js does not know.
"""

import plotly.graph_objects as go

from flight_analysis.report.plotting import Figure


def drawn(figure: Figure | None) -> go.Figure:
    """The figure, which is there."""
    assert figure is not None
    return go.Figure(figure.data, figure.layout)

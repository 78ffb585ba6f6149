# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the learner.

What it identifies, and when, is the section `learn` of the controller in its scenario.
"""

from flight_core.fields import Field
from flight_core.parameters import NodeConfig


class LearnerConfig(NodeConfig):
    """The learner's parameters."""

    scenario_file: str = Field(
        description="path of the scenario that flies: its airframe file is the rough model"
    )

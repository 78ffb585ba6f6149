# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the learner.

The section `learn` of the controller in the scenario says what the learner identifies, and when.
"""

from flight_core.fields import Field
from flight_core.parameters import NodeConfig


class LearnerConfig(NodeConfig):
    """The learner's parameters."""

    scenario_file: str = Field(
        description="path of the scenario that flies; its airframe file is the rough model"
    )

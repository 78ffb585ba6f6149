# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the recorder."""

from typing import Annotated

from flight_core.fields import Field
from flight_core.parameters import RATES, NodeConfig, NonNegative

OptionalNames = tuple[str, ...]


class RecorderConfig(NodeConfig):
    """Parameters of the recorder's node."""

    # The rate of the laws, so that all messages of one tick are written together.
    rate: Annotated[float, Field(ge=5, le=RATES[1])] = Field(
        default=100.0, description="rate of writing, Hz"
    )
    directory: str = Field(
        default="", description="folder of the bag; empty: runs/<UTC stamp>-recording"
    )
    topics: OptionalNames = Field(default=(), description="more topics to record, of any type")
    min_free: NonNegative = Field(
        default=100.0, description="free disk space below which recording ends, MB; 0 for no check"
    )
    attach: OptionalNames = Field(default=(), description="more files to attach to the log")
    metadata_file: str = Field(
        default="",
        description="YAML file of named sets of strings, which become metadata records of the log",
    )
    scenario_file: str = Field(default="", description="scenario file to attach to the log")

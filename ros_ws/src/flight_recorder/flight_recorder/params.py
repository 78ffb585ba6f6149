# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the recorder."""

from typing import Annotated

from pydantic import BeforeValidator, Field

from flight_core.parameters import NodeParameters, NonNegative, as_tuple

OptionalNames = Annotated[tuple[str, ...], BeforeValidator(as_tuple)]


class RecorderParameters(NodeParameters):
    """All parameters of the recorder's node."""

    rate: Annotated[float, Field(ge=5, le=1000)] = Field(description="how often the topics are emptied to the file, Hz")
    directory: str = Field(default="", description="the folder of the bag; empty makes runs/<UTC stamp>-recording")
    topics: OptionalNames = Field(default=(), description="further topics to record, whatever their type")
    min_free: NonNegative = Field(
        default=100.0, description="free space of the disk below which recording ends, MB (1e6 bytes); 0 does not look"
    )
    attach: OptionalNames = Field(default=(), description="further files to store inside the log")
    metadata_file: str = Field(
        default="", description="a YAML file of named sets of strings to store inside the log as its metadata"
    )
    scenario_file: str = Field(default="", description="a scenario file to store inside the log")

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Sections `controller` of osprey_servo under other laws: those of docs/laws.md, and that of the example package."""

import re
from typing import Any

import yaml
from tests.conftest import REPOSITORY

from flight_bringup.scenarios import find_scenario
from rise_di_controller.params import ControllerConfig

EXAMPLE = REPOSITORY / "examples" / "pid_law"
_SECTION = "/**/controller"


def _section(text: str) -> dict[str, Any]:
    parameters: dict[str, Any] = yaml.safe_load(text)[_SECTION]["ros__parameters"]
    return parameters


_RISE_DI = _section(find_scenario("osprey_servo").path.read_text(encoding="utf-8"))

COMMON = {key: value for key, value in _RISE_DI.items() if key in ControllerConfig.model_fields}
"""The parameters that every law has."""

_BLOCKS = re.findall(r"```yaml\n(.*?)```", (REPOSITORY / "docs" / "laws.md").read_text(encoding="utf-8"), re.DOTALL)

SECTIONS = {law["law"]: COMMON | law for law in map(yaml.safe_load, _BLOCKS)}
SECTIONS["pid"] = _section((EXAMPLE / "osprey_pid.yaml").read_text(encoding="utf-8"))

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide sections `controller` of osprey_servo with other laws.

They are those of docs/laws.md and of the example package.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.conftest import REPOSITORY

from flight_analysis.closed_loop.scenario_library import find_scenario
from rise_di_controller import laws
from rise_di_controller.params import ControllerConfig

EXAMPLE = REPOSITORY / "examples" / "pid_law"
_SECTION = "/**/controller"


def _section(text: str) -> dict[str, Any]:
    parameters: dict[str, Any] = yaml.safe_load(text)[_SECTION]["ros__parameters"]
    return parameters


_RISE_DI = _section(find_scenario("osprey_servo").path.read_text())

COMMON = {key: value for key, value in _RISE_DI.items() if key in ControllerConfig.model_fields}
"""The parameters that every law has."""

_BLOCKS = re.findall(r"```yaml\n(.*?)```", (REPOSITORY / "docs" / "laws.md").read_text(), re.DOTALL)

SECTIONS = {law["law"]: COMMON | law for law in map(yaml.safe_load, _BLOCKS)}
SECTIONS["pid"] = _section((EXAMPLE / "osprey_pid.yaml").read_text())

OWN_LAW = os.environ.get("RISE_DI_LAW")
"""A scenario file of osprey_servo under an installed law: the tests of every law are its too."""
if OWN_LAW:
    SECTIONS["own"] = _section(Path(OWN_LAW).read_text())


@contextmanager
def example_installed(folder: Path) -> Iterator[None]:
    """Install the example as a package.

    The folder has its modules, and the metadata with its entry point.
    """
    metadata = folder / "pid_law-0.1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: pid_law\nVersion: 0.1.0\n")
    (metadata / "entry_points.txt").write_text(f"[{laws.GROUP}]\npid = pid_law.pid:PidConfig\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE))
        patch.syspath_prepend(str(folder))
        laws._registered.cache_clear()
        yield
    laws._registered.cache_clear()

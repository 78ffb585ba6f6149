# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read files of recorded commands, which are CSV with the columns time, in s, and value.

    time,value
    0.00,0.0
    0.02,0.013

`params.Recorded` checks that the times rise from 0.
"""

import csv
from pathlib import Path
from typing import Any

from flight_core.files import read_file
from flight_core.parameters import ParameterError, require

HEADER = ["time", "value"]
EXPECTED = "a CSV file whose first line is time,value"


def read_stick(file: str, key: str) -> dict[str, Any]:
    """Read the columns `time`, in s, and `value` from a CSV file.

    `key` names the file in the message of an error. Raises ParameterError if the file cannot be
    read, has another header, or has a row that is not two numbers.
    """
    where = f"{key}: {file}"
    content = read_file(Path(file), where, EXPECTED)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ParameterError(f"{where}: cannot be read ({error}), expected {EXPECTED}") from None
    rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines()) if row]
    require(rows[:1] == [HEADER], where, ",".join(rows[0]) if rows else "no line", EXPECTED)
    numbers = [_numbers(row, f"{where}: row {k}") for k, row in enumerate(rows[1:], 1)]
    return {"time": [t for t, _ in numbers], "value": [value for _, value in numbers]}


def _numbers(row: list[str], where: str) -> tuple[float, float]:
    try:
        t, value = map(float, row)
    except ValueError:
        raise ParameterError(f"{where}: found {','.join(row)}, expected two numbers") from None
    return t, value

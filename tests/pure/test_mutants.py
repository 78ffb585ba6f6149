# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The list of mutants is of today's code; `make mutants` runs it."""

from pathlib import Path

import pytest
from benchmarks.mutants import REPOSITORY, Mutant, mutants

MUTANTS = mutants()
FILES = sorted({mutant.path for mutant in MUTANTS})


@pytest.mark.parametrize("path", FILES, ids=[Path(path).stem for path in FILES])
def test_each_mutant_of_file_changes_one_place(path: str) -> None:
    text = (REPOSITORY / path).read_text(encoding="utf-8")
    for mutant in (mutant for mutant in MUTANTS if mutant.path == path):
        assert mutant.mutated(text) != text
        assert all((REPOSITORY / "tests" / name).is_file() for name in mutant.tests)


def test_mutant_of_other_code_is_refused() -> None:
    mutant = Mutant("flight_core/rates.py", (), old="no such code", new="", what="")
    with pytest.raises(ValueError, match="found 'no such code' 0 times, expected once"):
        mutant.mutated("text")

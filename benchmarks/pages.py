# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run the blocks of the tutorials as they stand, also those that the tests leave out.

    make pages                            # every page, half an hour on two cores
    make pages ARGS="landing campaign"    # these pages

Each page has an empty folder, in which its blocks run in their order. tests/docs/test_pages.py runs
most of them with fewer aircraft, samples and seconds. A block "by hand" needs what a host may lack,
or changes the environment: its reason is printed. Exit status 1: a block failed.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.docs.test_pages import BY_HAND, PAGES, blocks, environment


def run_page(page: Path, folder: Path) -> int:
    """Run the blocks of a page in a folder, and print each with its time. Returns the failures."""
    failures = 0
    session = ""  # the Python blocks of a page are one session
    for kind, text, reason in blocks(page):
        title = f"{page.stem}: {text.strip().splitlines()[0]}"
        if BY_HAND in reason:
            print(f"{title}\n    {reason}")
            continue
        if kind == "python":
            session += text
            continue
        failures += not passes(title, ["bash", "-euo", "pipefail", "-c", text], folder)
    if session:
        failures += not passes(f"{page.stem}: its Python", [sys.executable, "-c", session], folder)
    return failures


def passes(title: str, command: list[str], folder: Path) -> bool:
    """Return whether a command has exit status 0.

    Prints the title and the time, and the output of a failure.
    """
    begin = time.monotonic()
    process = subprocess.run(  # noqa: S603 - the blocks of our own pages
        command, cwd=folder, env=environment(), capture_output=True, text=True, check=False
    )
    verdict = "passed" if process.returncode == 0 else f"FAILED, status {process.returncode}"
    print(f"{title}\n    {verdict} in {time.monotonic() - begin:.0f} s", flush=True)
    if process.returncode:
        print(process.stdout[-2000:], process.stderr[-2000:], sep="\n", file=sys.stderr)
    return process.returncode == 0


def main() -> None:
    """Run the pages that are named, by default all."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = [page.stem for page in PAGES]
    parser.add_argument("pages", nargs="*", choices=[[], *names], help=", ".join(names))
    pages = parser.parse_args().pages
    failures = 0
    for page in PAGES:
        if page.stem in pages or not pages:
            with tempfile.TemporaryDirectory() as folder:
                failures += run_page(page, Path(folder))
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()

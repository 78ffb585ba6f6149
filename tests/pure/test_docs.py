# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the pages: tables, links, anchors, and what their first screen says."""

import re
from pathlib import Path

from tests.conftest import REPOSITORY

TOP = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "docker/README.md",
    "examples/pid_law/README.md",
)
PAGES = [*(REPOSITORY / name for name in TOP), *sorted((REPOSITORY / "docs").rglob("*.md"))]
LINKED = (
    "architecture",
    "evidence",
    "experiments",
    "fly-a-route",
    "glossary",
    "guidance",
    "laws",
    "log",
    "outcomes",
    "symbols",
    "theory",
    "topics",
)


def prose(page: Path) -> str:
    """Return the text of a page without code blocks, code spans and formulas."""
    text = re.sub(r"^(```.*?^```|    .*?$)", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]*`|\$\$.*?\$\$|\$[^$]*\$", "", text, flags=re.DOTALL)


def links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", prose(page))


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings
    }


def name(path: Path) -> str:
    return str(path.relative_to(REPOSITORY))


def test_rows_have_a_cell_for_each_column() -> None:
    """The cells are counted below a heading, and a | in a formula would begin a cell."""
    bad = []
    for page in PAGES:
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
            cells = {len(re.split(r"(?<!\\)\|", row)) for row in table.splitlines()}
            if len(cells) != 1 or not re.match(r".*\n\|( ?:?-+:? ?\|)+\n", table):
                bad.append(f"{name(page)}: {table}")
    assert not bad, "\n".join(bad)


def test_relative_links_and_anchors_exist() -> None:
    broken = []
    for page in PAGES:
        for link in links(page):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            if not re.match(r"[a-z]+:", link) and not (
                target.exists() and (not anchor or anchor in anchors(target))
            ):
                broken.append(f"{name(page)}: {link}")
    assert not broken, "\n".join(broken)


def test_tests_that_pages_name_exist() -> None:
    tests = "".join(path.read_text() for path in (REPOSITORY / "tests").rglob("*.py"))
    named = {
        (name(page), test)
        for page in PAGES
        for test in re.findall(r"`(test_\w+)`", page.read_text())
    }
    unknown = [
        f"{page}: {test}"
        for page, test in sorted(named)
        if not re.search(rf"^def {test}\(", tests, re.MULTILINE)
    ]
    assert not unknown, "\n".join(unknown)


def test_the_readme_links_the_main_pages() -> None:
    assert {f"docs/{page}.md" for page in LINKED} <= set(links(REPOSITORY / "README.md"))


FIRST_SCREEN = 40  # lines of a page that a visitor sees without scrolling


def test_first_screen_of_readme_says_how_to_fly_and_how_to_test() -> None:
    lines = (REPOSITORY / "README.md").read_text().splitlines()[:FIRST_SCREEN]
    targets = (REPOSITORY / "Makefile").read_text()
    for target in ("fly", "test"):
        assert any(line.startswith(f"    make {target} ") for line in lines)
        assert f"\n{target}: " in targets

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the pictures of the documentation show what the pages say, drawn by today's code."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from benchmarks import diagrams
from benchmarks.pictures import DEFAULT, FIGURES, IMAGES, PICTURES, TITLE
from PIL import Image
from tests.conftest import REPOSITORY

from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.summary import summarise

DOCS = REPOSITORY / "docs"
LARGEST = 150_000  # bytes of a picture: a repository keeps each version


def texts(drawing: Path) -> list[str]:
    """Return the texts of an SVG."""
    tree = ElementTree.parse(drawing)
    found = (text.text for text in tree.iter("{http://www.w3.org/2000/svg}text"))
    return [text for text in found if text]


def title(picture: Path) -> str | None:
    """Return what a picture says that it shows."""
    if picture.suffix == ".svg":
        return ElementTree.parse(picture).findtext(".//{http://purl.org/dc/elements/1.1/}title")
    with Image.open(picture) as image:
        return image.info.get(TITLE)


def shown_in(page: Path) -> list[tuple[str, str]]:
    """Return the pictures of a page, each with its text and the line below it."""
    picture = r"^!\[(.*?)\]\((?:docs/)?images/(.*?)\)\n(?=(.*\n.*))"
    pictures = re.findall(picture, page.read_text(), re.MULTILINE)
    return [(name, f"{text} {below}") for text, name, below in pictures]


def test_every_picture_is_small_drawn_by_the_command_and_on_a_page() -> None:
    assert {path.name for path in IMAGES.iterdir()} == {*PICTURES}
    assert [path for path in IMAGES.iterdir() if path.stat().st_size > LARGEST] == []
    pages = [REPOSITORY / "README.md", *DOCS.rglob("*.md")]
    assert {name for page in pages for name, _ in shown_in(page)} == {*PICTURES}


@pytest.mark.parametrize(
    "name", [name for name in PICTURES if PICTURES[name].is_of_page or name.endswith(".svg")]
)
def test_picture_and_its_pages_name_the_flight_that_it_shows(name: str) -> None:
    shows = PICTURES[name].shows
    assert title(IMAGES / name) == shows
    if (LIBRARY / f"{shows}.yaml").is_file():
        for page in [REPOSITORY / "README.md", *DOCS.rglob("*.md")]:
            for picture, text in shown_in(page):
                assert picture != name or shows in text, page.name


@pytest.mark.slow
def test_first_picture_is_of_the_flight_beside_it() -> None:
    """The picture has the errors of this scenario, which `rise-di fly` flies first."""
    tape = simulate(find_scenario(DEFAULT))
    expected = {name: part["whole"]["rms"] for name, part in summarise(tape)["errors"].items()}
    with Image.open(IMAGES / "report.png") as image:
        drawn = json.loads(image.info[FIGURES])
    assert drawn == pytest.approx(expected, rel=0.01)  # three digits are legible


@pytest.mark.parametrize("name", ["nodes", "bridge", "packages", "laws"])
def test_drawing_is_of_todays_tables(name: str, tmp_path: Path) -> None:
    diagrams.save_drawing(getattr(diagrams, name)(), tmp_path / "now.svg", name)
    assert texts(tmp_path / "now.svg") == texts(IMAGES / f"{name}.svg")

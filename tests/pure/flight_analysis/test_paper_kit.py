# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the figures for a paper, which independent readers read back."""

import re
import xml.etree.ElementTree as ET
import zlib
from pathlib import Path

import pytest
import yaml
from tests.conftest import REPOSITORY, refusing

from flight_analysis.report.paper import write_figure
from flight_analysis.report.summary import RecordedFlight


def test_pdf_has_the_width_and_vectors(flight: RecordedFlight, tmp_path: Path) -> None:
    """A width of 88 mm is 249.4 points of 1/72 inch.

    Paths are the operators l and S in the stream. There is no image and no Type 3 font.
    """
    write_figure(tmp_path / "fig.pdf", [flight], "88mm", "q,V")
    content = (tmp_path / "fig.pdf").read_bytes()
    assert content.startswith(b"%PDF-")
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content)
    assert box is not None
    assert float(box[1]) == pytest.approx(88.0 / 25.4 * 72.0, abs=0.1)
    streams = [
        zlib.decompress(part)
        for part in re.findall(
            rb"/FlateDecode.*?stream\r?\n(.*?)\r?\nendstream", content, re.DOTALL
        )
    ]
    assert max(stream.count(b" l\n") for stream in streams) > 100
    assert b"/Subtype /Image" not in content
    assert b"/Type3" not in content


def test_svg_keeps_text_and_rows(flight: RecordedFlight, tmp_path: Path) -> None:
    write_figure(tmp_path / "fig.svg", [flight], "180mm", ["V", "e.q", "elevator"])
    root = ET.parse(tmp_path / "fig.svg").getroot()
    text = " ".join(
        "".join(node.itertext()) for node in root.iter("{http://www.w3.org/2000/svg}text")
    )
    assert float(root.attrib["width"].removesuffix("pt")) == pytest.approx(
        180.0 / 25.4 * 72.0, abs=0.1
    )
    for label in ("V - 25 (m/s)", "true error of q (deg/s)", "elevator (deg)", "t (s)", "y_m"):
        assert label in text
    first = (tmp_path / "fig.svg").read_bytes()
    write_figure(tmp_path / "fig.svg", [flight], "180mm", ["V", "e.q", "elevator"])
    assert (tmp_path / "fig.svg").read_bytes() == first


@pytest.mark.parametrize(
    "name, width, channels, words",
    [
        ("fig.gif", "88mm", "", "figure: found fig.gif, expected a name that ends in .pdf"),
        ("fig.pdf", "8mm", "", "width: found 8mm, expected 30 mm to 1 m"),
        ("fig.pdf", "88mm", "q,alfa", "channels: found 'alfa'"),
    ],
)
def test_wrong_figure_is_told(
    flight: RecordedFlight, tmp_path: Path, name: str, width: str, channels: str, words: str
) -> None:
    with refusing(re.escape(words)):
        write_figure(tmp_path / name, [flight], width, channels)
    assert not list(tmp_path.iterdir())


def test_citation_names_the_paper_and_invents_nothing() -> None:
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    (paper,) = citation["references"]
    assert paper["title"].startswith("A Robust Dynamic Inversion Technique")
    assert [author["family-names"] for author in paper["authors"]] == [
        "Tanyer",
        "Tatlicioglu",
        "Zergeroglu",
    ]
    assert "doi" not in paper
    assert "take them from your copy" in (REPOSITORY / "README.md").read_text()

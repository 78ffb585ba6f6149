# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Describe a report page as records, and write it as HTML that needs no network.

A page begins with its head, which has the title, the verdicts and the tiles. The blocks follow in
their order. A block has figures, a replay, cards, messages or tables. The line of contents links to
the blocks that have a short name.
"""

import base64
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup
from numpy.typing import NDArray

from flight_analysis.report import figures, plotting
from flight_analysis.report.comparison import ComparisonTable
from flight_analysis.report.display_units import format_value
from flight_analysis.report.glossary import GLOSSARY
from flight_analysis.report.plotting import Figure, SampleStore, pack
from flight_analysis.report.replay_scene import Replay
from flight_analysis.report.summary import finite_or_null
from flight_analysis.report.tables import MetricTable
from flight_core.vectors import FloatArray

HERE = Path(__file__).parent

# ---- Head


class Colour(StrEnum):
    """The colour of a verdict: whether all is well, or the host or the flight fell short."""

    GOOD = "good"  # green: nothing is wrong
    HOST = "host"  # amber: the host was too busy, and nothing is wrong with the aircraft
    BAD = "bad"  # red: the flight falls short of something
    PLAIN = "plain"  # nothing was judged


@dataclass(frozen=True, kw_only=True)
class Step:
    """What to do next, as a sentence and a command to type."""

    sentence: str
    command: str


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The verdict on a flight: a bold sentence, more text, details to unfold, and a next step.

    On a page that compares flights, a verdict has the label and the colour of its flight.
    """

    headline: str
    colour: Colour
    text: str = ""
    details: Sequence[str] = ()
    step: Step | None = None
    label: str = ""
    line: str = ""  # colour of the flight in figures


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A tile on the page: the error of an output beside the allowed error, as text and as a bar.

    If there is no allowed error, because nothing was judged, the tile has no bar.
    """

    name: str
    value: str
    unit: str
    text: str
    part: float = 0.0  # error as a fraction of the allowed error
    has_limit: bool = False

    @property
    def is_within(self) -> bool:
        """Whether the error is within the allowed one."""
        return self.part <= 1.0

    @property
    def length(self) -> float:
        """The length of the bar in percent, where 50 percent is the allowed error."""
        return min(50.0 * self.part, 100.0)


# ---- Blocks


def anchor(title: str) -> str:
    """Return the name by which links find a block on the page, made from the block's title."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


class Section(NamedTuple):
    """A block with a figure and a heading. Without a figure, the block is left out."""

    title: str
    hint: str
    figure: Figure | None
    is_over_time: bool = True  # all figures over time are zoomed together
    contents: str = ""  # name in the line of contents, or "" to leave it out there

    @property
    def kind(self) -> str:
        """The kind of the block, which tells the template how to draw it."""
        return "figure"


@dataclass(frozen=True, kw_only=True)
class Card:
    """A claim about a flight, with the conditions under which it holds and a way to check it.

    `words` are the words of the claim that the glossary explains.
    """

    title: str
    sentences: Sequence[str]
    step: Step | None = None
    words: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True)
class Cards:
    """A block of cards beside each other, under one heading."""

    kind: ClassVar[str] = "cards"
    title: str
    cards: Sequence[Card]
    contents: str = ""


@dataclass(frozen=True, kw_only=True)
class ReplayBlock:
    """The block with the replay of a flight in three dimensions."""

    kind: ClassVar[str] = "replay"
    replay: Replay
    title: str = "Replay"
    contents: str = "Replay"


class MessageLine(NamedTuple):
    """A line with a message of the log, as text."""

    time: str
    kind: str
    text: str


@dataclass(frozen=True, kw_only=True)
class Messages:
    """The block with the messages of a log."""

    kind: ClassVar[str] = "messages"
    lines: Sequence[MessageLine]
    title: str = "Messages of the log"
    contents: str = "Messages"


Tables = Sequence[MetricTable] | Sequence[ComparisonTable]


class TableGroup(NamedTuple):
    """Tables that are shown together, and the same tables with angles in radians.

    On a page that compares flights, `colours` has the colours of the flights.
    """

    tables: Tables
    title: str = ""
    note: str = ""
    colours: Sequence[str] = ()
    in_radians: Tables = ()


@dataclass(frozen=True, kw_only=True)
class Figures:
    """A block with groups of tables of numbers. On the page of a flight, a reader can fold it."""

    kind: ClassVar[str] = "tables"
    groups: Sequence[TableGroup]
    is_folded: bool = False
    title: str = "All figures"
    contents: str = "All figures"
    # words that the glossary explains, in addition to those in the tables
    words: Sequence[str] = ()


Block = Section | Cards | ReplayBlock | Messages | Figures


class Page(NamedTuple):
    """The content of a report page."""

    title: str
    blocks: Sequence[Block]
    lines: Sequence[str] = ()  # lines of text below the title
    verdicts: Sequence[Verdict] = ()
    tiles: Sequence[Tile] = ()
    notes: Sequence[str] = ()
    samples: SampleStore | None = None  # None if no figure has long curves

    @property
    def shown(self) -> list[Block]:
        """The blocks that have something to show."""
        return [block for block in self.blocks if _has_content(block)]

    @property
    def contents(self) -> list[tuple[str, str]]:
        """The entries of the line of contents: anchor (link target) and name of each block."""
        entries = [(anchor(block.title), block.contents) for block in self.shown if block.contents]
        return [*entries, *([("words", "Words")] if self.words else [])]

    @property
    def words(self) -> dict[str, str]:
        """The words on the page that the glossary explains, with their meanings."""
        used: set[str] = set()
        for block in self.shown:
            if isinstance(block, Cards):
                used.update(*(card.words for card in block.cards))
            elif isinstance(block, Figures):
                used.update(block.words)
                tables = [table for group in block.groups for table in group.tables]
                used.update(*(each.words for each in tables if isinstance(each, MetricTable)))
        if self.tiles:
            used |= {"worst", "allowed"} if self.tiles[0].has_limit else {"rms"}
        return {word: meaning for word, meaning in GLOSSARY.items() if word in used}

    @property
    def replay(self) -> Replay | None:
        """The replay, or None if the page has no replay."""
        for block in self.blocks:
            if isinstance(block, ReplayBlock):
                return block.replay
        return None

    @property
    def has_figures(self) -> bool:
        """Whether the page has a figure."""
        return any(isinstance(block, Section) for block in self.shown)

    @property
    def has_times(self) -> bool:
        """Whether the page has figures over time, which are all zoomed together."""
        return any(isinstance(block, Section) and block.is_over_time for block in self.shown)

    @property
    def has_angles(self) -> bool:
        """Whether the page can switch its angles between deg and rad."""
        groups = [
            group for block in self.blocks if isinstance(block, Figures) for group in block.groups
        ]
        return any(group.in_radians for group in groups)


def _has_content(block: Block) -> bool:
    if isinstance(block, Section):
        return block.figure is not None
    if isinstance(block, Cards):
        return bool(block.cards)
    if isinstance(block, Messages):
        return bool(block.lines)
    return not isinstance(block, Figures) or any(group.tables for group in block.groups)


# ---- HTML


def page_html(page: Page) -> str:
    """Return the page as HTML, with plotly, the script and the samples inside."""
    return "".join(page_parts(page))


def page_parts(page: Page) -> Iterator[str]:
    """Yield the HTML of a page in pieces, because the page of a long flight has some 100 MB."""
    return _template().generate(
        page=page,
        dark=plotting.DARK | figures.DARK,
        library=pack((HERE / "vendor" / "plotly-basic.min.js").read_bytes()),
        style=Markup((HERE / "page.css").read_text(encoding="utf-8")),  # noqa: S704 - our own file
        script=Markup((HERE / "page.js").read_text(encoding="utf-8")),  # noqa: S704 - our own file
    )


@cache
def _template() -> Template:
    """Return the template of a page. Compile it only once, because this takes long."""
    environment = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "script_json": script_json,
        "ratio": format_ratio,
        "css": Markup,
        "anchor": anchor,
    }
    return environment.get_template("page.html.jinja")


def script_json(value: Any) -> Markup:
    """Write JSON for a script element. Each "<" is escaped, so that no tag can end it."""
    content = finite_or_null(
        {"data": value.data, "layout": value.layout} if isinstance(value, Figure) else value
    )
    text = json.dumps(content, default=_typed_array, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704


def _typed_array(array: FloatArray | NDArray[np.float32]) -> dict[str, str]:
    """Return an array for plotly.js: its type, "f8" or "f4", and its bytes, little endian."""
    return {"dtype": array.dtype.str[1:], "bdata": base64.b64encode(array.tobytes()).decode()}


def format_ratio(ratio: float | None) -> Markup:
    """Write a ratio with three digits, or as an integer if it is 100 or more."""
    if ratio is None:
        return Markup()
    return Markup("&times;{}").format(format_value(ratio) if ratio < 100.0 else f"{ratio:.0f}")

# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A hook of MkDocs that turns the formulas of a page into MathML.

Browsers draw MathML without a script and without another host.
"""

import html
import re
from typing import Any

from math_core import LatexError, LatexToMathML
from mkdocs.exceptions import PluginError

FORMULA = re.compile(
    r'(?P<opening><(?P<tag>span|div) class="arithmatex">)\\[(\[](?P<tex>.*?)\\[)\]]</(?P=tag)>',
    re.DOTALL,
)
"""A formula as pymdownx.arithmatex leaves it: a span inside a line, or a div on a line of its own.
"""

CONVERTER = LatexToMathML(fancy_error=False)


def mathml(tex: str, displayed: bool) -> str:
    r"""Convert a formula to MathML, with the number of its \tag at the right.

    Raises LatexError if the formula is no LaTeX.
    """
    numbered = rf"\begin{{equation}}{tex}\end{{equation}}" if r"\tag" in tex else tex
    return CONVERTER.convert_with_local_state(numbered, displaystyle=displayed)


def on_page_content(content: str, page: Any, **_: object) -> str:
    """Convert the formulas in a page's HTML to MathML.

    Raises PluginError, which names the page and the formula that is no LaTeX.
    """

    def converted(match: re.Match[str]) -> str:
        tex = html.unescape(match["tex"]).strip()
        try:
            return (
                f"{match['opening']}{mathml(tex, displayed=match['tag'] == 'div')}</{match['tag']}>"
            )
        except LatexError as error:
            raise PluginError(f"{page.file.src_uri}: {tex}: {error}") from None

    return FORMULA.sub(converted, content)

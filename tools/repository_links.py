# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A hook of MkDocs that turns a link to a file of the repository into the name of that file.

Links to pages of the site stay as they are.
"""

import posixpath
import re
from typing import Any

LINK = re.compile(r"\[(?P<text>[^\]]+)\]\((?P<target>\.\./[^)#\s]+)[^)]*\)")


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Replace a page's links to files of the repository by the files' paths.

    The paths are from the root of the repository.
    """
    folder = posixpath.dirname(posixpath.join("docs", page.file.src_uri))

    def named(link: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, link["target"]))
        if path.startswith("docs/"):
            return link.group()
        return link["text"] if link["text"].strip("`") in path else f"{link['text']} (`{path}`)"

    return LINK.sub(named, markdown)

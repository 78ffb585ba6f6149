# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Text from samples, logs and files before a user sees it.

It has no terminal control code and a bounded length.
"""

MAX_LENGTH = 1000  # characters of a sentence, however long the bad input is


def printable(text: str) -> str:
    """A text with unprintable characters written as escapes.

    Those are line ends and terminal control codes, for example.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def bounded(text: str) -> str:
    """A printable text of at most MAX_LENGTH characters and their escapes.

    The middle of a longer text is left out.
    """
    if len(text) > MAX_LENGTH:
        text = f"{text[: MAX_LENGTH // 2]} ... {text[5 - MAX_LENGTH // 2 :]}"
    return printable(text)


def sentences(*parts: str) -> str:
    """The parts that are not empty, as one text."""
    return "; ".join(filter(None, parts))

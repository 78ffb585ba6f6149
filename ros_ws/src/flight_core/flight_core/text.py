# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Make text from samples, logs and files safe to show to a user.

The result has no terminal control code, and a limited length.
"""

MAX_LENGTH = 1000  # characters of a sentence, however long the bad input is


def printable(text: str) -> str:
    """Write unprintable characters, such as line ends and terminal control codes, as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def bounded(text: str) -> str:
    """Make a text printable and at most MAX_LENGTH characters long, not counting escapes.

    The middle of a longer text is left out.
    """
    if len(text) > MAX_LENGTH:
        text = f"{text[: MAX_LENGTH // 2]} ... {text[5 - MAX_LENGTH // 2 :]}"
    return printable(text)


def sentences(*parts: object) -> str:
    """Join texts and refusals into one text, leaving out None and empty ones."""
    return "; ".join(str(part) for part in parts if part)

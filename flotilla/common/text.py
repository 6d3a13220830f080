"""Text that others wrote, in a form that can be shown on a terminal."""

from __future__ import annotations

import re

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
"""Characters that control a terminal or change the direction of text; not tabs and line ends."""


def shown(text: str) -> str:
    """The text with each control character as its escape sequence of Python's, such as `\\x1b`."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)

"""Text that others wrote: in a form that can be shown on a terminal, and as a day."""

from __future__ import annotations

import re
from datetime import date

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
"""Characters that control a terminal or change the direction of text; not tabs and line ends."""


def shown(text: str) -> str:
    """The text with each control character as its escape sequence of Python's, such as `\\x1b`."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def day(value: object) -> date:
    """The day in a text such as 2027-01-31. ValueError for any other form, and for values that are no text.

    Robots compare the last day of a bundle as text, in which 20270131 comes after every day of theirs.
    """
    if not isinstance(value, str) or not re.fullmatch("[0-9]{4}-[0-9]{2}-[0-9]{2}", value):
        raise ValueError("give a day such as 2027-01-31")
    return date.fromisoformat(value)

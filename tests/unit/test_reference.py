"""The pages of docs/reference/ that need no built runtime say what the sources say."""

from __future__ import annotations

import pytest

from flotilla.reference import keys
from flotilla.reference.pages import FOLDER, PAGES


@pytest.mark.parametrize("name", PAGES)
def test_page_is_the_sources(name: str) -> None:
    """Seen to fail with another range, default or docstring in flotilla/fleet/model.py, and with an option less."""
    assert (FOLDER / name).read_text(encoding="utf-8") == PAGES[name](), "run `make reference` and commit the page"


@pytest.mark.parametrize("section", keys.SECTIONS, ids=lambda section: section.title)
def test_each_key_has_a_meaning(section: keys.Section) -> None:
    """Seen to fail with the docstring of `Can.bitrate` removed."""
    assert [key for key, field, _ in keys.fields(section) if not field.description] == []


@pytest.mark.parametrize("section", keys.SECTIONS, ids=lambda section: section.title)
def test_only_a_list_has_items(section: keys.Section) -> None:
    """Seen to fail for `board.qemu.machine` and five more strings, whose remedy was to write further items."""
    found = [
        key for key, _, value in keys.fields(section) if "items" in value.text and not value.text.startswith("list")
    ]
    assert found == []

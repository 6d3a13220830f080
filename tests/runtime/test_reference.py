"""The pages of docs/reference/ that are made from the built runtime say what it says."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from flotilla.reference import blocks
from flotilla.reference.pages import RUNTIME_PAGES


@pytest.mark.parametrize("path", RUNTIME_PAGES, ids=lambda path: path.name)
def test_page_is_the_sources(flotilla_run: Path, path: Path) -> None:
    """Seen to fail with another default of the key `overruns`, and with another summary and header of the block pid."""
    made = RUNTIME_PAGES[path](flotilla_run.parent)
    assert path.read_text(encoding="utf-8") == made, "run `make reference` and commit the page"


def listed(program: Path, *words: str) -> list[dict[str, list[dict[str, str]]]]:
    done = subprocess.run([program, "--json", *words], capture_output=True, text=True, check=True)
    found: list[dict[str, list[dict[str, str]]]] = json.loads(done.stdout)
    return found


def test_ports_are_those_of_the_given_parameters(flotilla_run: Path) -> None:
    """Seen to fail with the ports of the type listed instead of those of the configured block."""
    program = flotilla_run.with_name("flotilla-blocks")
    first, second = listed(program, "sum", "signs=+-+", "sum")
    assert [port["name"] for port in first["inputs"]] == ["in0", "in1", "in2"]
    assert [port["name"] for port in second["inputs"]] == ["in0", "in1"]
    said = subprocess.run([program, "sum", "signs=+-+"], capture_output=True, text=True, check=True).stdout
    assert "in2" in said
    wrong = subprocess.run([program, "--json", "sum", "signs=x"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert 'sum: signs: "x" is not 1 to 32 of + and -' in wrong.stderr


def test_a_block_without_a_header_is_noticed(
    flotilla_run: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Seen to fail with such blocks left out of the page."""
    monkeypatch.setattr(blocks, "SOURCES", tmp_path)
    with pytest.raises(KeyError):
        blocks.page(flotilla_run.parent)

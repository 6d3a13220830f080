"""Run libFuzzer on a parser of targets.py: `python -m tests.fuzz NAME [libFuzzer's options and corpora]`.

atheris counts the branches of the modules that it imports, so it comes before they do.
"""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["flotilla", "tests.fuzz", "json", "mcap"]):
    from tests.fuzz import targets


def main(argv: list[str]) -> None:
    if len(argv) < 2 or argv[1] not in targets.TARGETS:
        sys.exit(f"{__doc__}\nNAME: one of {', '.join(targets.TARGETS)}")
    name = argv.pop(1)

    def run(data: bytes) -> None:
        targets.accepts(name, data)

    atheris.instrument_func(run)
    atheris.Setup(argv, run)
    atheris.Fuzz()


main(sys.argv)

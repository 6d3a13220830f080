"""clang-tidy over the runtime, as `runtime/.clang-tidy` says: `python -m runtime.tidy build/runtime-sanitized`.

The analyzer takes seconds for a file, so a file is checked again only when ninja has compiled it again, which knows its
headers, or when the checks have changed. Tests are left to the compiler and the sanitizers.
"""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

RUNTIME = Path(__file__).resolve().parent
TIDY = Path(sys.executable).parent / "clang-tidy"


def objects(build: Path) -> dict[Path, Path]:
    """Each source of the runtime, with one of the objects that were made of it."""
    found = {}
    for command in json.loads((build / "compile_commands.json").read_text()):
        source = (build / command["file"]).resolve()
        if source.is_relative_to(RUNTIME) and not source.is_relative_to(RUNTIME / "tests"):
            found[source] = build / command["output"]
    return found


def check(source: Path, build: Path, stamp: Path) -> bool:
    """Whether nothing was found in `source`; what was is printed."""
    run = subprocess.run([TIDY, "-p", build, "--quiet", source], capture_output=True, text=True, check=False)
    if run.returncode:
        print(run.stdout or run.stderr, end="")
        return False
    stamp.parent.mkdir(parents=True, exist_ok=True)
    stamp.touch()
    return True


def main(build: Path) -> int:
    rules = max(path.stat().st_mtime for path in (TIDY, *RUNTIME.rglob(".clang-tidy")))
    todo = {}
    for source, compiled in sorted(objects(build).items()):
        stamp = build / "tidy" / source.relative_to(RUNTIME)
        if not stamp.exists() or stamp.stat().st_mtime < max(rules, compiled.stat().st_mtime):
            todo[source] = stamp
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        clean = list(threads.map(lambda item: check(item[0], build, item[1]), todo.items()))
    return 0 if all(clean) else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

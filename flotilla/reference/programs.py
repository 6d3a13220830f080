"""What the runtime's programs say of themselves."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any


def listing(programs: Path, program: str, *arguments: str) -> list[dict[str, Any]]:
    """The JSON that a program in `programs` prints; CalledProcessError, with what it says shown, if it fails."""
    done = subprocess.run([programs / program, *arguments], stdout=subprocess.PIPE, check=True)
    listed: list[dict[str, Any]] = json.loads(done.stdout)
    return listed

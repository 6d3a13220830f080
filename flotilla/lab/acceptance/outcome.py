"""What a robot was found to be: each check, and all figures, in a file that the operator's key signs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.fleet import keys, ssh_signatures

NAMESPACE = "flotilla-acceptance"
"""What the signature is for (`ssh-keygen -Y`)."""
State = Literal["holds", "fails", "not judged"]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Outcome(_Model):
    """Of one check."""

    part: str
    what: str
    """What was looked at: `COM5`, `wake-up under load`."""
    state: State
    found: str
    """In words, with figures; why, where it was not judged."""
    remedy: str = ""
    """What to do about a failure."""

    def __str__(self) -> str:
        said = f"{self.part}: {self.what}: {self.found}"
        return f"{said}; {self.remedy}" if self.remedy else said


class Acceptance(_Model):
    """Of one robot at one time."""

    format: Literal[1] = 1
    robot: str
    board: str
    made: datetime
    emulated: bool
    """A guest: its times are the host's, and none is judged."""
    computer: str
    kernel: str
    """`uname -r`."""
    release: str
    """Of the running slot."""
    plan: str
    outcomes: list[Outcome]
    figures: dict[str, float]
    """By name with unit: what compares between robots, and over time."""
    histograms_us: dict[str, dict[int, int]]
    """Samples by latency, by scenario and quantity."""

    @property
    def failures(self) -> list[Outcome]:
        return [each for each in self.outcomes if each.state == "fails"]

    @property
    def name(self) -> str:
        return f"{self.robot}-{self.made:%Y%m%dT%H%M%SZ}"


def directory() -> Path:
    return paths.BUILD / "reports" / "acceptance"


def write(made: Acceptance) -> Path:
    """The file, `ROBOT-TIME.json`, with its signature beside it, `.json.sig`."""
    directory().mkdir(parents=True, exist_ok=True)
    file = directory() / f"{made.name}.json"
    content = (json.dumps(made.model_dump(mode="json"), indent=1, sort_keys=True) + "\n").encode()
    durable.write(signature_of(file), signature(content))
    return durable.write(file, content)


def signature(content: bytes) -> bytes:
    """Of a report, by the operator's key."""
    return ssh_signatures.sign(content, keys.usable(keys.operator()), NAMESPACE)


def signature_of(file: Path) -> Path:
    return file.with_name(f"{file.name}.sig")


def is_signed(file: Path) -> bool:
    """Whether the operator's key, or the one before it, signed the file as it is."""
    public = [keys.public(each) for each in (keys.operator(), keys.former_operator()) if each]
    return ssh_signatures.is_signed(file.read_bytes(), signature_of(file), public, NAMESPACE)


def read(file: Path) -> Acceptance:
    """UserError where the file is not as it was signed."""
    if not is_signed(file):
        raise UserError(f"{paths.shown(file)}: is not as the operator's key signed it; remove it, and accept the robot")
    try:
        return Acceptance.model_validate_json(file.read_text())
    except ValidationError as error:
        raise UserError(f"{paths.shown(file)}: is no acceptance: {error.errors()[0]['msg']}") from error


def of_board(board: str) -> Iterator[Acceptance]:
    """All there are of robots of a board, the oldest first."""
    found = (read(file) for file in sorted(directory().glob("*.json")))
    yield from sorted((each for each in found if each.board == board), key=lambda each: each.made)

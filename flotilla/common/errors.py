"""Errors that are the user's to repair, as opposed to defects of the builder."""

from __future__ import annotations

from dataclasses import dataclass


class UserError(Exception):
    """A message that says what is wrong and what to do; printed without a traceback, exit status 1."""


@dataclass(frozen=True, order=True)
class Problem:
    """One finding in a file of the user's: where it is, what stands there, what would be right."""

    file: str
    """Path relative to the project, with a line number where one is known: `ansible/inventory/robots.yml:12`."""
    key: str
    """Dotted path inside the file: `robot3.address`."""
    value: str
    """What stands there, as written."""
    message: str
    """What is wrong with it."""
    remedy: str
    """What would be right."""

    def __str__(self) -> str:
        return f"{self.file}: {self.key}: {self.value}: {self.message}; {self.remedy}"


class ProblemsError(UserError):
    """Every problem found, reported at once."""

    def __init__(self, problems: list[Problem]) -> None:
        self.problems = sorted(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))

"""pytest plugin: a test's tier is its folder's, and which tests go to one of several processes.

The tests of a file share what is dear to make, such as a guest, so a file goes to one process. Those of a folder named
`shared` share its guests: what each guest is asked goes to one process.
"""

from __future__ import annotations

import re
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

TIERS = {"unit": "unit", "runtime": "runtime", "image": "image"} | dict.fromkeys(
    ("boot", "provisioning", "end_to_end", "hosts"), "boot"
)
"""By folder. What is marked `nightly` is of that tier only."""
SAME_PLACE = {"test_manual.py": "tests/provisioning/test_fleet.py"}
"""Files that come after another in its process: both play fleet.yml, whose report lies at one place."""


_GUEST = re.compile(r"\[(?:.*-)?([a-z0-9_]+-(?:debian|lean))(?:-.*)?\]$")
"""What tests/boot/shared/conftest.py calls a board with a kernel, among a test's parameters."""
_SHARED = "smartcoret3-debian"
"""Of these the one that tests without such a parameter ask."""


def tier(nodeid: str) -> str:
    """Of a test's folder."""
    return TIERS[nodeid.split("/")[1]]


def together(nodeid: str) -> str:
    """What goes to one process."""
    path = nodeid.partition("::")[0]
    folder, _, file = path.rpartition("/")
    if not folder.endswith("/shared"):
        return SAME_PLACE.get(file, path)
    guest = _GUEST.search(nodeid)
    return f"{folder} {guest[1] if guest else _SHARED}"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """pytest-xdist's own that keeps tests together, but for which, and for the order."""
    config.option.loadscopereorder = False  # tests/suite.py has put them in order
    scheduler = LoadScopeScheduling(config, log)
    scheduler._split_scope = together
    return scheduler

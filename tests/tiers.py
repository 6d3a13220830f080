"""pytest plugin: a test's tier is its folder's, and which tests go to one of several processes.

The tests of a file share what is dear to make, such as a guest, so a file goes to one process; a folder named `shared`
does as a whole.
"""

from __future__ import annotations

from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

TIERS = {"unit": "unit", "runtime": "runtime", "image": "image"} | dict.fromkeys(
    ("boot", "provisioning", "end_to_end", "hosts"), "boot"
)
"""By folder. What is marked `nightly` is of that tier only."""
SAME_PLACE = {"test_manual.py": "tests/provisioning/test_fleet.py"}
"""Files that come after another in its process: both play fleet.yml, whose report lies at one place."""


def tier(nodeid: str) -> str:
    """Of a test's folder."""
    return TIERS[nodeid.split("/")[1]]


def together(nodeid: str) -> str:
    """What goes to one process."""
    path = nodeid.partition("::")[0]
    folder, _, file = path.rpartition("/")
    return folder if folder.endswith("/shared") else SAME_PLACE.get(file, path)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """pytest-xdist's own that keeps tests together, but for which, and for the order."""
    config.option.loadscopereorder = False  # tests/suite.py has put them in order
    scheduler = LoadScopeScheduling(config, log)
    scheduler._split_scope = together
    return scheduler

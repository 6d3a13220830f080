"""pytest plugin: a test's tier is its folder's; which tests go to one of several processes, and which begin first.

The tests of a file share what is dear to make, such as a guest, so a file goes to one process; a folder named `shared`
does as a whole. Files begin in the order of what they take, the longest first, so that all processes end together.
"""

from __future__ import annotations

from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

TIERS = {"unit": "unit", "runtime": "runtime", "image": "image"} | dict.fromkeys(
    ("boot", "provisioning", "end_to_end", "hosts"), "boot"
)
"""By folder. What is marked `nightly` is of that tier only."""
LONGEST = (
    "test_fleet.py",
    "shared",
    "test_boot_loader.py",
    "test_power_cuts_guest.py",
    "test_power_cuts.py",
    "test_bad_update.py",
    "test_update.py",
    "test_assigned_apps.py",
    "test_radio_cell.py",
    "test_bad_releases.py",
    "test_deploy.py",
    "test_accidents.py",
    "test_scenarios.py",
    "test_update_virtual.py",
    "test_latency.py",
    "test_verify.py",
    "test_build.py",
    "test_control_loop.py",
    "test_blocks_guest.py",
    "test_wheeled_live.py",
    "test_wheeled_virtual.py",
    "test_wire_flood.py",
    "test_virtual_loop.py",
    "test_boot_time.py",
)
"""Files and folders that take more than half a minute, as `--durations=0` shows."""
SAME_PLACE = {"test_manual.py": "test_fleet.py"}
"""Files that come after another in its process: both play fleet.yml, whose report lies at one place."""


def together(nodeid: str) -> str:
    """What goes to one process."""
    folder, _, file = nodeid.partition("::")[0].rpartition("/")
    return folder if folder.endswith("/shared") else SAME_PLACE.get(file, file)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """pytest-xdist's own that keeps tests together, but for which, and for the order."""
    config.option.loadscopereorder = False
    scheduler = LoadScopeScheduling(config, log)
    scheduler._split_scope = together
    return scheduler


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        marked = item.get_closest_marker("nightly")
        item.add_marker("nightly" if marked else TIERS[item.nodeid.split("/")[1]])
    items.sort(key=_rank)


def _rank(item: pytest.Item) -> tuple[int, bool]:
    """Of all that are not named, none before another: they stay as they were collected."""
    file = item.nodeid.partition("::")[0].rpartition("/")[2]
    name = together(item.nodeid).rpartition("/")[2]
    return LONGEST.index(name) if name in LONGEST else len(LONGEST), file in SAME_PLACE

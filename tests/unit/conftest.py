"""What several files of unit tests start from."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet import identity
from flotilla.fleet.model import Fleet


@pytest.fixture(scope="session")
def made_keys(fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of the fleet as they are made first."""
    directory = tmp_path_factory.mktemp("made") / "keys"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "KEYS", directory)
        identity.render(fleet, fleet.robots[3])
    return directory


@pytest.fixture
def own_keys(made_keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The test's own copy of them."""
    shutil.copytree(made_keys, tmp_path / "keys")
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")

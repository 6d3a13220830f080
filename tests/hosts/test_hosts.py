"""The README's first command on each supported host, as root and as an ordinary user: the same cards everywhere.

Each is a fresh clone in a tree of its own that `make` sets up. Keys are the same, because they are on the cards. The
pool is given along, so that little is downloaded.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from flotilla.common import cache, paths
from flotilla.debian import pool
from flotilla.debian.lock import Lock, read_lock
from flotilla.fleet.model import Fleet
from flotilla.images import build
from tests.figures import PROPERTY
from tests.hosts import tree
from tests.hosts.tree import SUPPORTED, USER, Host, Tree

pytestmark = pytest.mark.nightly
ROBOT = 3
KEYS = "/srv/keys"
IMITATED = {"ubuntu": "trixie"}
"""Hosts that are no Debian, and the Debian with a C library as new, which takes their os-release: so is all but the
kernel, whose refusals tests/unit imitates."""
FETCHED = "adduser"
"""A package that the pool lacks, so that the mirror has to be known."""
LEAN = "kernel: lean"


@dataclass(frozen=True)
class Somebody:
    """Who builds where, and how their account is set up."""

    host: Host
    user: str
    checkout: str
    umask: int
    locale: str

    def __str__(self) -> str:
        return f"{self.host.id}-{self.host.version}-{self.user}"


EVERYBODY = [
    Somebody(host, *account)
    for host in SUPPORTED
    for account in (
        ("root", "/srv/flotilla", 0o022, "C.UTF-8"),
        (USER, f"/home/{USER}/Müller/flotilla", 0o077, "de_DE"),  # which is ISO 8859-1
    )
]


class Checkout:
    """Somebody's clone, in a tree of its own."""

    first_s = 0.0
    """How long `make image` took after the clone."""

    def __init__(self, somebody: Somebody, layer: Path, log: Path) -> None:
        self._somebody, self._log = somebody, log
        host = somebody.host
        self.tree: Tree = tree.make(IMITATED.get(host.id, host.codename), layer)
        if host.id in IMITATED:
            release = self.tree.path("/usr/lib/os-release")
            release.parent.mkdir(parents=True)
            release.write_text(f'ID={host.id}\nVERSION_ID="{host.version}"\nVERSION_CODENAME={host.codename}\n')
        tree.clone(self.tree, somebody.checkout, somebody.user, somebody.umask)
        self.tree.give((file for file in paths.KEYS.iterdir() if file.is_file()), KEYS, somebody.user)
        packages = {package for lock in _locks() for package in lock.packages}
        given = {pool.file(package) for package in packages if package.name != FETCHED}
        self.tree.give(given, f"{somebody.checkout}/build/pool", somebody.user)

    def make(self, *words: str) -> float:
        """Run make; how many seconds it took."""
        begun = time.monotonic()
        done = self.tree.run(
            "make", "-C", self._somebody.checkout, f"KEYS={KEYS}", *words,
            user=self._somebody.user, umask=self._somebody.umask, variables={"LANG": self._somebody.locale},
        )  # fmt: skip
        with self._log.open("a") as log:
            log.write(f"make {' '.join(words)}: status {done.returncode}\n{done.stdout}\n")
        assert done.returncode == 0, f"{self._somebody}: make {' '.join(words)}: {done.stdout[-4000:]}"
        return time.monotonic() - begun

    def change(self, file: str, old: str, new: str) -> None:
        """Change a file of the checkout where it says `old`."""
        path = self.tree.path(f"{self._somebody.checkout}/{file}")
        text = path.read_text()
        assert re.search(old, text), file
        path.write_text(re.sub(old, new, text))

    def cards(self) -> dict[str, str]:
        """The SHA-256 of each image, by its name."""
        directory = self.tree.path(f"{self._somebody.checkout}/build/images")
        lines = [file.read_text().split() for file in directory.glob("*.sha256")]
        return {name: sha256 for sha256, name in lines}


Cards = Callable[[Somebody], tuple[Checkout, dict[str, str]]]


@pytest.fixture(scope="module")
def cards(fleet: Fleet, session_artefacts: Path) -> Iterator[Cards]:
    """`cards(somebody)`: their checkout, and the SHA-256 of all the fleet's cards made there, of robot 3's also with
    a kernel of our own; made when a test first asks."""
    made: dict[Somebody, tuple[Checkout, dict[str, str]]] = {}
    layers = paths.BUILD / "hosts"
    cache.discard(layers)
    with cache.exclusive():
        for board in fleet.boards.values():
            build.fill_pool(board)
        pool.fill(_locks())
    described = f"ansible/inventory/group_vars/board_{fleet.robots[ROBOT].board}.yml"

    def of(somebody: Somebody) -> tuple[Checkout, dict[str, str]]:
        if somebody not in made:
            checkout = Checkout(somebody, layers / str(somebody), session_artefacts / f"{somebody}.log")
            checkout.first_s = checkout.make("image", f"ROBOT={ROBOT}")
            checkout.make("images")
            found = checkout.cards()
            checkout.change(described, r"kernel: \w+", LEAN)
            checkout.make("image", f"ROBOT={ROBOT}")
            found["lean"] = checkout.cards()[f"{fleet.robots[ROBOT].name}.img"]
            checkout.change(described, LEAN, "kernel: debian")
            made[somebody] = checkout, found
        return made[somebody]

    yield of
    cache.discard(layers)


@pytest.mark.parametrize("somebody", EVERYBODY[1:], ids=str)
def test_cards_have_the_same_bytes_on_each_host_for_each_user(
    cards: Cards, fleet: Fleet, somebody: Somebody, record_property: Callable[[str, str], None]
) -> None:
    """Seen to fail: on Debian 13 no card could be made; in another locale than UTF-8 nothing was set up where the
    checkout's path has an umlaut."""
    _, first = cards(EVERYBODY[0])
    checkout, other = cards(somebody)
    record_property(PROPERTY, f"{somebody}: make image ROBOT={ROBOT} of a fresh clone: {checkout.first_s:.0f} s")
    assert len(first) == len(fleet.robots) + 1
    assert other == first


@pytest.mark.parametrize("host", [host for host in SUPPORTED if host.id not in IMITATED], ids="-".join)
def test_checks_pass_for_an_ordinary_user(cards: Cards, host: Host) -> None:
    """Unit tests alone were run so: those of what the host has to offer knew root and Python 3.11 alone."""
    (somebody,) = (each for each in EVERYBODY if (each.host, each.user) == (host, USER))
    checkout, _ = cards(somebody)
    checkout.make("check")


def _locks() -> list[Lock]:
    return [read_lock(file.stem) for file in paths.LOCKS.glob("*.lock")]

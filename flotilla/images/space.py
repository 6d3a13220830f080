"""How much disk a build takes at its peak, at least: what the pool and the cache have already counts as nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from flotilla.common import paths
from flotilla.debian import pool
from flotilla.debian.lock import Lock
from flotilla.images import card

_UNPACKED = 3.2
"""Bytes of a tree of tools for a byte of its packages: 3.1 of the build tools, 3.4 of the compilers."""
_SQUASHED = 0.65
"""Bytes of a root with its kernel and initramfs for a byte of its packages."""
_PACKED_ANEW = 3.8
"""Bytes of a repository without compression for a byte of its packages; it is there while a root is made."""
_WITH_ROOT = ("rootfs", "slot", "card")
"""Results that hold a board's root: each has it whole."""
_DATA = 8 * card.MIB
"""Blocks that the data partition of a card has, for the most part its journal."""


def needed(trees: Iterable[Lock], roots: Sequence[Lock], images: Sequence[Lock]) -> int:
    """Bytes for building `roots`, by the tools of the locks `trees`, and a card of each of `images`, a board's lock.

    Rather too little than too much: a result counts as missing where there are fewer of its kind, whatever their keys.
    """
    trees = {lock.name: lock for lock in trees}.values()
    packages = {package.sha256: package for lock in (*trees, *roots) for package in lock.packages}
    size = sum(package.size for package in packages.values() if not pool.file(package).exists())
    size += _missing("tools", [_packed(tree) * _UNPACKED for tree in trees])
    making = _missing("rootfs", [max((_packed(root) for root in roots), default=0) * (_PACKED_ANEW + _SQUASHED)])
    kept = sum(_missing(kind, [_packed(root) * _SQUASHED for root in roots]) for kind in _WITH_ROOT)
    kept += sum(int(_packed(root) * _SQUASHED) + _DATA for root in images)
    return size + max(making, kept)


def _missing(kind: str, sizes: Iterable[float]) -> int:
    """Of the results that a build makes of a kind, by their sizes: as many are there as the cache has of it."""
    there = len(list(paths.CACHE.glob(f"{kind}-" + "[0-9a-f]" * 16)))
    return int(sum(sorted(sizes, reverse=True)[there:]))


def _packed(lock: Lock) -> int:
    return sum(package.size for package in lock.packages)

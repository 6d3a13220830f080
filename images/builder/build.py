"""From the fleet's description to card images: the order of the steps, and what lies beside an image."""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

from images.builder import bmap, cache, card, identity, namespace, paths, pool, progress, rootfs, tools
from images.builder.errors import UserError
from images.builder.fleet import Board, Fleet, Robot
from images.builder.lock import Lock, read_lock


@dataclass(frozen=True)
class BoardBuild:
    """What all robots of a board share."""

    board: Board
    lock: Lock
    tools: tools.Tools
    root: Path
    base: Path


def image_of(robot: Robot) -> Path:
    return paths.IMAGES / f"{robot.name}.img"


def board_build(board: Board) -> BoardBuild:
    """Everything up to the identity; from the cache where nothing changed."""
    lock, tools_lock = read_lock(board.name), read_lock("tools")
    pool.fill([lock, tools_lock])
    toolset = tools.Tools(tools.tree(tools_lock), lock.epoch)
    root = rootfs.build(board, lock, tools_lock)
    return BoardBuild(board, lock, toolset, root, card.base(board, root, toolset, lock.epoch))


def build(fleet: Fleet, robots: list[Robot]) -> list[Path]:
    """Make the images of `robots`; each is replaced only when it is complete."""
    with cache.exclusive():
        boards: dict[str, BoardBuild] = {}
        for robot in robots:
            if robot.board not in boards:
                boards[robot.board] = board_build(fleet.boards[robot.board])
        return [_robot_image(fleet, robot, boards[robot.board]) for robot in robots]


def _robot_image(fleet: Fleet, robot: Robot, made: BoardBuild) -> Path:
    started = time.monotonic()
    final = image_of(robot)
    work = paths.IMAGES / f".{robot.name}.part"
    cache.discard(work)
    work.mkdir(parents=True)
    try:
        data = work / "data.img"
        data_extents = card.data_partition(made.tools, data, identity.nodes(fleet, robot), made.lock.epoch)
        new = work / final.name
        extents = card.image(made.base, data, data_extents, new)
        with new.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        bmap.write_bmap(new, extents, work / f"{robot.name}.bmap")
        (work / f"{robot.name}.sha256").write_text(f"{digest}  {final.name}\n")
        data.unlink()
        for made_file in sorted(work.iterdir()):
            made_file.rename(paths.IMAGES / made_file.name)
    finally:
        cache.discard(work)
    mapped = sum(length for _, length in extents)
    print(
        f"{paths.shown(final)}: {progress.size(card.SIZE)}, {progress.size(mapped)} to write, sha256 {digest[:16]}…, "
        f"{time.monotonic() - started:.1f} s"
    )
    return final

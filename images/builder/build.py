"""From the fleet's description to card images: the order of the steps, and what lies beside an image."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from images.builder import (
    bmap,
    cache,
    card,
    host,
    identity,
    manifest,
    namespace,
    paths,
    pool,
    progress,
    rootfs,
    runtime,
    tools,
)
from images.builder.errors import UserError
from images.builder.fleet import Board, Fleet, Robot
from images.builder.lock import Lock, read_lock


@dataclass(frozen=True)
class BoardBuild:
    """What all robots of a board share."""

    board: Board
    lock: Lock
    tools_lock: Lock
    tools: tools.Tools
    root: Path
    base: Path
    manifest: Path


def image_of(robot: Robot, directory: Path = paths.IMAGES) -> Path:
    return directory / f"{robot.name}.img"


def board_build(board: Board) -> BoardBuild:
    """Everything up to the identity; from the cache where nothing changed."""
    lock, tools_lock = read_lock(board.name), read_lock("tools")
    pool.fill([lock.without("kernel") if board.kernel == "lean" else lock, tools_lock])
    toolset = tools.Tools(tools.tree(tools_lock), lock.epoch)
    root = rootfs.build(board, lock, tools_lock)
    base = card.base(board, root, toolset, lock.epoch)
    return BoardBuild(board, lock, tools_lock, toolset, root, base, manifest.shared(board, lock, root, base, toolset))


def build(fleet: Fleet, robots: list[Robot], directory: Path = paths.IMAGES) -> list[Path]:
    """Make the images of `robots` in `directory`; each is replaced only when it is complete."""
    host.check()
    namespace.check()
    with cache.exclusive():
        check_tasks(fleet, robots)
        boards: dict[str, BoardBuild] = {}
        for robot in robots:
            if robot.board not in boards:
                boards[robot.board] = board_build(fleet.boards[robot.board])
        images = [_robot_image(fleet, robot, boards[robot.board], directory) for robot in robots]
        for made in boards.values():
            if missing := made.lock.missing_suites:
                print(missing_suites(made.lock.name, missing))
        return images


def missing_suites(board: str, missing: tuple[str, ...]) -> str:
    """What a build says of a board whose lock was made without some suites: it does not go unnoticed."""
    return (
        f"{board}: its packages are locked without {', '.join(missing)}, whose updates they lack; "
        "`make lock` takes them in as soon as the mirror has what is signed"
    )


def check_tasks(fleet: Fleet, robots: list[Robot]) -> None:
    """Refuse what the robots themselves would refuse, all of it at once."""
    problems = []
    for robot in robots:
        for name, task in identity.control_tasks(fleet, robot).items():
            try:
                runtime.check_task(paths.TASKS / f"{name}.yml", task)
            except UserError as error:
                problems.append(f"{robot.name}: {error}")
    if problems:
        raise UserError("\n".join(problems))


def _robot_image(fleet: Fleet, robot: Robot, made: BoardBuild, directory: Path) -> Path:
    """Hashing takes longest, and lets other threads work: the board's part is hashed while the robot's is made."""
    started = time.monotonic()
    final = image_of(robot, directory)
    work = directory / f".{robot.name}.part"
    cache.discard(work)
    directory.mkdir(parents=True, exist_ok=True)
    work.mkdir(0o700)  # private keys are in what is made here
    new = work / final.name
    try:
        with ThreadPoolExecutor() as threads:
            extents = card.begin(made.base, new)
            beginning = threads.submit(manifest.hash_range, new, 0, card.DATA.start)
            source = threads.submit(manifest.checkout)
            nodes = identity.nodes(fleet, robot)
            data = work / "data.img"
            extents += card.complete(new, data, card.data_partition(made.tools, data, nodes, made.lock.epoch))
            data.unlink()
            mapping = threads.submit(bmap.write_bmap, new, extents, bmap.bmap_of(new))
            data_part = manifest.part("data partition", new, card.DATA.start, card.DATA.size)
            whole = manifest.hash_range(new, card.DATA.start, card.DATA.size, beginning.result()).hexdigest()
            manifest.write(
                fleet, robot, (made.lock, made.tools_lock), made.manifest, nodes=nodes, source=source.result(),
                data=data_part, image=manifest.Part(name=final.name, bytes=card.SIZE, sha256=whole), extents=extents,
                beside=new,
            )  # fmt: skip
            mapped = mapping.result().mapped
        new.with_suffix(".sha256").write_text(f"{whole}  {final.name}\n")
        for made_file in sorted(work.iterdir()):
            made_file.rename(directory / made_file.name)
    finally:
        cache.discard(work)
    print(
        f"{paths.shown(final)}: {progress.size(card.SIZE)}, {progress.size(mapped)} to write, sha256 {whole[:16]}…, "
        f"{time.monotonic() - started:.1f} s"
    )
    return final

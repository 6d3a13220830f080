"""From the fleet's description to card images: the order of the steps, and what lies beside an image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from flotilla.common import cache, host, namespace, paths, progress
from flotilla.common.errors import UserError
from flotilla.fleet import identity, release_keys
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Board, Fleet, Releases, Robot
from images.builder import bmap, card, data_partition, manifest, pool, rootfs, runtime, slot, tools
from images.builder.lock import Lock, board_lock, read_lock


@dataclass(frozen=True)
class BoardBuild:
    """What all robots of a board share."""

    board: Board
    lock: Lock
    tools_lock: Lock
    tools: tools.Tools
    root: Path
    slot: Path
    base: Path
    manifest: Path


def image_of(robot: Robot, directory: Path = paths.IMAGES) -> Path:
    return directory / f"{robot.name}.img"


def board_build(board: Board, releases: Releases | None = None) -> BoardBuild:
    """Everything up to the identity; from the cache where nothing changed. `releases`: who signs them."""
    lock, tools_lock = board_lock(board), read_lock("tools")
    pool.fill([lock.without("kernel") if board.kernel == "lean" else lock, tools_lock])
    toolset = tools.Tools(tools.tree(tools_lock), lock.epoch)
    root = rootfs.build(board, lock, tools_lock)
    content = slot.build(board, root, release_keys.document(releases or Releases()), slot.release())
    base = card.base(board, content, toolset, lock.epoch)
    described = manifest.shared(board, (lock, tools_lock), root, content, base, toolset)
    return BoardBuild(board, lock, tools_lock, toolset, root, content, base, described)


def build(
    fleet: Fleet,
    robots: list[Robot],
    directory: Path = paths.IMAGES,
    apps: Mapping[str, Sequence[BuiltApp]] | None = None,
) -> list[Path]:
    """Make the images of `robots` in `directory`; each is replaced only when it is complete.

    `apps`: those of each robot that has any, by its name, built for its board (flotilla.apps.assigned).
    """
    host.check()
    namespace.check()
    with cache.exclusive():
        check_tasks(fleet, robots)
        boards: dict[str, BoardBuild] = {}
        for robot in robots:
            if robot.board not in boards:
                boards[robot.board] = board_build(fleet.boards[robot.board], fleet.releases)
        counted = [(robot, f", {n} of {len(robots)}" if len(robots) > 1 else "") for n, robot in enumerate(robots, 1)]
        images = [
            _robot_image(fleet, robot, boards[robot.board], directory, (apps or {}).get(robot.name, ()), count)
            for robot, count in counted
        ]
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


def _robot_image(
    fleet: Fleet, robot: Robot, made: BoardBuild, directory: Path, apps: Sequence[BuiltApp], count: str
) -> Path:
    with progress.step(f"card of {robot.name}{count}"):
        what = _make_robot_image(fleet, robot, made, directory, apps)
    print(what)
    return image_of(robot, directory)


def _make_robot_image(fleet: Fleet, robot: Robot, made: BoardBuild, directory: Path, apps: Sequence[BuiltApp]) -> str:
    """Make it; what it is.

    Hashing takes longest, and lets other threads work: the board's part is hashed while the robot's is made.
    """
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
            nodes = data_partition.nodes(fleet, robot, apps)
            data = work / "data.img"
            extents += card.complete(new, data, card.data_partition(made.tools, data, nodes, made.lock.epoch))
            data.unlink()
            mapping = threads.submit(bmap.write_bmap, new, extents, bmap.bmap_of(new))
            data_part = manifest.part("data partition", new, card.DATA.start, card.DATA.size)
            whole = manifest.hash_range(new, card.DATA.start, card.DATA.size, beginning.result()).hexdigest()
            manifest.write(
                fleet, robot, (made.lock, made.tools_lock), made.manifest, nodes=nodes, source=source.result(),
                data=data_part, image=manifest.Part(name=final.name, bytes=card.SIZE, sha256=whole), extents=extents,
                apps=apps, beside=new,
            )  # fmt: skip
            mapped = mapping.result().mapped
        new.with_suffix(".sha256").write_text(f"{whole}  {final.name}\n")
        for made_file in sorted(work.iterdir()):
            made_file.rename(directory / made_file.name)
    finally:
        cache.discard(work)
    return f"{paths.shown(final)}: {progress.size(card.SIZE)}, {progress.size(mapped)} to write, sha256 {whole[:16]}…"

"""From the fleet's description to card images: the order of the steps, and what lies beside an image."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from flotilla.common import cache, durable, host, namespace, paths, progress, together
from flotilla.common.errors import UserError
from flotilla.debian import pool, runtime, tools
from flotilla.debian.lock import Lock, board_lock, read_lock
from flotilla.fleet import identity, release_keys
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Board, Fleet, Releases, Robot
from flotilla.images import bmap, card, data_partition, manifest, rootfs, slot, space
from flotilla.images.filesystem import Node


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
    check_space([board])
    fill_pool(board)
    root = rootfs.build(board, lock, tools_lock)  # first: it unpacks the tools while the runtime is compiled
    toolset = tools.Tools(tools.tree(tools_lock), lock.epoch)
    content = slot.build(board, root, release_keys.document(releases or Releases()), slot.release())
    base = card.base(board, content, toolset, lock.epoch)
    described = manifest.shared(board, (lock, tools_lock), root, content, base, toolset)
    return BoardBuild(board, lock, tools_lock, toolset, root, content, base, described)


def fill_pool(board: Board) -> None:
    """Download what the build of a board lacks, all of it at once."""
    pool.fill([_root_lock(board), *_tree_locks(board)])


def _root_lock(board: Board) -> Lock:
    """What the pool needs of the board's lock: a kernel of our own is no package of Debian's."""
    lock = board_lock(board)
    return lock.without("kernel") if board.kernel == "lean" else lock


def _tree_locks(board: Board) -> list[Lock]:
    """Of the tools that a build of the board runs, and of the compilers if its runtime is to be built."""
    return [read_lock("tools"), *runtime.wanted(board.system)]


def check_space(boards: Iterable[Board], images: Sequence[Board] = ()) -> None:
    """Refuse a build of `boards`, and of cards of `images`, for which the disk has no room."""
    boards = list(boards)
    trees = [lock for board in boards for lock in _tree_locks(board)]
    host.check_space(space.needed(trees, list(map(_root_lock, boards)), list(map(_root_lock, images))))


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
    names = dict.fromkeys(robot.board for robot in robots)
    with host.explaining_a_full_disk(), cache.exclusive():
        boards: dict[str, BoardBuild] = {}
        check_space([fleet.boards[name] for name in names], [fleet.boards[robot.board] for robot in robots])
        for name in names:
            fill_pool(fleet.boards[name])

        def make_boards() -> None:
            for name in names:
                boards[name] = board_build(fleet.boards[name], fleet.releases)

        # At once, because the tasks wait for the runtime, beside which the root is made.
        together.run(lambda: check_tasks(fleet, robots), make_boards)
        images = _robot_images(fleet, robots, boards, directory, apps or {})
        for made in boards.values():
            if missing := made.lock.missing_suites:
                print(f"{missing_suites(made.lock.name, missing)}; the image is complete")
        return images


def missing_suites(board: str, missing: tuple[str, ...]) -> str:
    """A note on a board whose lock was made without some suites. Builds print it, and `make cve` fails with it."""
    return (
        f"{board}: note: the lock has no packages of {', '.join(missing)}, because the mirror had no signed index "
        "of it; run `make lock` later"
    )


def check_tasks(fleet: Fleet, robots: list[Robot]) -> None:
    """Refuse what the robots themselves would refuse, all of it at once."""
    problems = []
    for robot in robots:
        for name, task in identity.control_tasks(fleet, robot).items():
            try:
                system = fleet.boards[robot.board].system  # whose runtime is built anyway
                runtime.check_task(paths.TASKS / f"{name}.yml", task, system=system)
            except UserError as error:
                problems.append(f"{robot.name}: {error}")
    if problems:
        raise UserError("\n".join(problems))


@dataclass(frozen=True)
class _Common:
    """What is the same for all cards of a board, found once while the first is made."""

    ranges: Future[bmap.BlockMap]
    inputs: Future[str]
    source: Future[manifest.Source | str]
    fleet_source: Future[manifest.Source | str]

    @classmethod
    def of(cls, made: BoardBuild, source: Future[manifest.Source | str], threads: ThreadPoolExecutor) -> _Common:
        image = made.base / "card.img"
        return cls(
            threads.submit(bmap.block_map, image, card.extents(made.base)),
            threads.submit(manifest.inputs_of_board, made.board, (made.lock, made.tools_lock)),
            source,
            threads.submit(manifest.of_home),
        )


def _robot_images(
    fleet: Fleet,
    robots: Sequence[Robot],
    boards: Mapping[str, BoardBuild],
    directory: Path,
    apps: Mapping[str, Sequence[BuiltApp]],
) -> list[Path]:
    """Make them, several at once: programs that run and hashing let other threads work."""
    count = len(robots)
    directory.mkdir(parents=True, exist_ok=True)
    title = f"cards of {count} robots" if count > 1 else f"card of {robots[0].name}"
    with progress.step(title) as step, _threads() as threads:
        source = threads.submit(manifest.checkout)
        common = {name: _Common.of(made, source, threads) for name, made in boards.items()}
        coming = []
        for robot in robots:
            own = apps.get(robot.name, ())
            nodes = data_partition.nodes(fleet, robot, own)  # here, because keys that are missing are made
            made, same = boards[robot.board], common[robot.board]
            coming.append(threads.submit(_robot_image, fleet, robot, made, same, directory, own, nodes, many=count > 1))
        said = []
        for number, one in enumerate(coming):
            step.at(number, count, "cards")
            said.append(one.result())
    if isinstance(unknown := source.result(), str) and not paths.INSTALLED:
        said.append(f"the manifests name no commit: {unknown}")
    print("\n".join(said))
    return [image_of(robot, directory) for robot in robots]


@contextmanager
def _threads() -> Iterator[ThreadPoolExecutor]:
    """As many as there are processors. Whatever ends the body, what has not begun does not begin."""
    threads = ThreadPoolExecutor(os.cpu_count())
    try:
        yield threads
    finally:
        threads.shutdown(cancel_futures=True)


def _robot_image(
    fleet: Fleet, robot: Robot, made: BoardBuild, common: _Common, directory: Path, apps: Sequence[BuiltApp],
    nodes: list[Node], *, many: bool,
) -> str:  # fmt: skip
    """Make it; what it is. `many`: it is one of several that are made now."""
    final = image_of(robot, directory)
    work = directory / f".{robot.name}.part"
    cache.discard(work)
    work.mkdir(0o700)  # private keys are in what is made here
    new = work / final.name
    try:
        extents = card.begin(made.base, new, past_page_cache=many)
        extents += card.complete(made.board, made.tools, new, nodes, made.lock.epoch)
        same = card.without_identifier(common.ranges.result().ranges)
        mapped = bmap.write_bmap(new, extents, bmap.bmap_of(new), same).mapped
        boot_loader = manifest.part("boot loader", new, 0, card.STATE.start)
        data_part = manifest.part("data partition", new, card.DATA.start, card.DATA.size)
        whole = manifest.hash_range(new, 0, card.SIZE).hexdigest()
        manifest.write(
            fleet, robot, (made.lock, made.tools_lock), made.manifest, board_inputs=common.inputs.result(),
            nodes=nodes, source=common.source.result(),
            fleet_source=common.fleet_source.result(), boot_loader=boot_loader, data=data_part,
            image=manifest.Part(name=final.name, bytes=card.SIZE, sha256=whole), extents=extents,
            apps=apps, beside=new,
        )  # fmt: skip
        new.with_suffix(".sha256").write_text(f"{whole}  {final.name}\n")
        durable.rename_files(sorted(work.iterdir()), directory)
    finally:
        cache.discard(work)
    return f"{paths.shown(final)}: {progress.size(card.SIZE)}, {progress.size(mapped)} to write, sha256 {whole[:16]}…"

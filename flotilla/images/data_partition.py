"""What a card's data partition holds at first: the layers above the root with the robot's identity, and its apps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

from flotilla.common.errors import UserError
from flotilla.fleet import identity
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Fleet, Robot
from flotilla.images import card, filesystem
from flotilla.images.filesystem import Node

_DATA = PurePosixPath("/data")
_MOST = 0.4
"""Of the data partition: the journal has a share of it until the first boot, and the robot needs room to begin."""
_TOP = PurePosixPath("/")
_OF_SLOT = PurePosixPath("/A")
"""A new card has its release in slot A, and the layer above /etc is a release's."""


def nodes(fleet: Fleet, robot: Robot, apps: Sequence[BuiltApp] = ()) -> list[Node]:
    """The data partition: the layers above the root, with the robot's files in the one above /etc, and its apps.

    `apps`: each of the robot's, built for its board.
    """
    files = identity.render(fleet, robot, apps)
    for path in files:
        if path.parts[1] != "etc":
            raise UserError(
                f"rootfs_overlay{path}.j2: templates lie below etc/: the rest of the root is common to all robots"
            )
    tops = ["A", "A/etc", "var", "home", ".work", ".work/A", ".work/var", ".work/home"]
    directories = {_TOP / top for top in tops}
    made = [Node(_within(path), content, mode) for path, (content, mode) in files.items()]
    _check_size(robot, apps)
    for app in apps:
        place = _within(app.place)
        directories |= {place, *(place / directory for directory in app.directories)}
        made += [Node(place / path, content, mode) for path, (content, mode) in app.files.items()]
        made += [Node(_within(path), mode=0o777, target=target) for path, target in app.links.items()]
    directories |= {parent for node in made for parent in node.path.parents if parent != _TOP}
    directories |= {parent for directory in directories for parent in directory.parents if parent != _TOP}
    made += [Node(path) for path in directories]
    return sorted(made, key=lambda node: node.path.parts)


def _check_size(robot: Robot, apps: Sequence[BuiltApp]) -> None:
    """UserError where the robot's apps leave too little room."""
    sizes = {app.place / path: len(content) for app in apps for path, (content, _) in app.files.items()}
    size = sum(map(filesystem.taken, sizes.values())) + sum(filesystem.taken(0) * len(app.directories) for app in apps)
    if size > card.DATA.size * _MOST:
        largest = max(sizes, key=sizes.__getitem__)
        raise UserError(
            f"{robot.name}: its apps {', '.join(robot.apps)} take {size / card.MIB:.1f} MiB in {len(sizes)} files, "
            f"more than {_MOST:.0%} of the data partition as it is flashed, {card.DATA.size // card.MIB} MiB; the "
            f"largest file is {largest}, {sizes[largest] / card.MIB:.1f} MiB: give the robot less, or enlarge data_mib "
            "in images/boot/card.yml"
        )


def _within(path: PurePosixPath) -> PurePosixPath:
    """Where on the partition a path of the robot lies."""
    if path.is_relative_to("/etc"):
        return _OF_SLOT / path.relative_to(_TOP)
    return _TOP / path.relative_to(_DATA) if path.is_relative_to(_DATA) else path

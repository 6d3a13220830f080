"""What an image is, said beside it: `robotN.manifest.json`, and bills of materials in SPDX and CycloneDX.

All of it follows from the image's inputs, so the same inputs give the same bytes; only `source`, the state of the git
checkout, is about where it was built, and nothing of it is in the image. What a board's robots share is made once.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import uuid
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, Protocol
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, JsonValue

from flotilla.common import cache, paths, sources
from flotilla.common.errors import UserError
from flotilla.debian import mirror
from flotilla.debian.lock import Lock
from flotilla.debian.tools import Tools
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.model import Board, Fleet, Robot
from flotilla.images import card, compare, rootfs, slot
from flotilla.images.filesystem import Node

FORMAT: Literal[1] = 1
"""Rises when a reader of older manifests would misread a new one."""
SBOMS = ("spdx.json", "cdx.json")
"""Endings of the bills of materials: SPDX 2.3 and CycloneDX."""
_BOOT_LOADER = "grub-pc-bin"
"""Of the build tools: its code is on the card, before the first partition."""
_DPKG_STATUS = "var/lib/dpkg/status"
_ENTERING = (
    "ansible/boards", "ansible/control_tasks", "ansible/inventory", "apps", "flotilla", "images", "kernel",
    "rootfs_overlay", "runtime",
)  # fmt: skip
"""Folders of the project whose files images are made of, or by."""
_ENTERING_FROM_HOME = ("inventory", "control_tasks", "apps", "kernel", "overlay", "packages", "locks")
"""The same of a fleet's home."""
_SUBMODULE = "160000"
_SHA1 = 40
"""Digits of git's names of objects, where it names them by SHA-1."""
_CHUNK = 1 << 20
"""Bytes hashed at a time."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Package(_Model):
    """An installed Debian package, as dpkg on the robot knows it."""

    name: str
    version: str
    architecture: str
    source: str
    source_version: str
    installed_kib: int
    """As the package declares it: before documentation, translations and unused kernel modules are left out."""


class Part(_Model):
    """Something an image consists of."""

    name: str
    bytes: int
    sha256: str


class Partition(_Model):
    """One line of the partition table."""

    number: int
    name: str
    partuuid: str
    content: str
    start: int
    """Bytes from the start of the card."""
    bytes: int
    used: int
    """Bytes that hold anything, the file system's own included."""


class Suite(_Model):
    archive: str
    name: str
    released: datetime


class LockId(_Model):
    name: str
    sha256: str
    suites: list[Suite]
    missing_suites: list[str] = []
    """Those that the lock was made without: packages lack what these have, such as security updates."""


class App(_Model):
    """An app that the inventory gives to the robot."""

    name: str
    version: str
    bytes: int
    """Of its files."""
    sha256: str
    """Of its listing on the robot, which has the SHA-256 of each file: /etc/flotilla/apps/NAME."""


class Source(_Model):
    """The git checkout that built the image."""

    commit: str
    dirty: bool
    """Whether files differed from the commit, or others were among those that images are made of."""


class RobotId(_Model):
    number: int
    name: str
    board: str


class Shared(_Model):
    """What the manifests of a board's robots have in common."""

    kernel: str
    parts: list[Part]
    packages: list[Package]


class Manifest(_Model):
    format: Literal[1]
    robot: RobotId
    architecture: str
    kernel: str
    """Version."""
    lock: LockId
    tools: LockId
    """The lock of the build tools."""
    epoch: int
    """Seconds since 1970: every time inside the image."""
    inputs: str
    """SHA-256 over all that goes into the image. Equal inputs: equal image."""
    source: Source | None
    """None where nobody knows."""
    source_unknown: str = ""
    """Why."""
    fleet_source: Source | None = None
    """The git checkout of the fleet's home, where it is not the tool's own."""
    fleet_source_unknown: str = ""
    image: Part
    parts: list[Part]
    partitions: list[Partition]
    packages: list[Package]
    apps: list[App] = []
    hostvars: dict[str, JsonValue]
    """The robot's merged inventory variables, as the fleet model says them."""


def file_of(image: Path) -> Path:
    """Where the manifest of an image lies."""
    return image.with_suffix(".manifest.json")


def read(image: Path, remedy: str) -> Manifest:
    """The manifest beside an image."""
    path = file_of(image)
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise UserError(f"{paths.shown(path)} is missing; `{remedy}`") from None
    except ValueError as error:
        raise UserError(f"{paths.shown(path)}: not a manifest of format {FORMAT}; `{remedy}`") from error


# --- once per board ---


def shared(board: Board, locks: tuple[Lock, Lock], root: Path, content: Path, base: Path, tools: Tools) -> Path:
    """Directory with `shared.json` and the bills of materials of a board's robots.

    `locks`: the board's and the build tools'. `root`, `content`, `base`: what `rootfs.build`, `slot.build` and
    `card.base` made.
    """
    lock, tools_lock = locks
    key = cache.digest(
        board.name, lock.digest, tools_lock.digest, root.name, base.name, tools.directory.name,
        paths.PROJECT / "requirements/build.lock", Path(__file__),
    )  # fmt: skip

    def make(out: Path) -> None:
        status = tools.run("usr/bin/unsquashfs", "-cat", root / "root.squashfs", _DPKG_STATUS)
        made = Shared(
            kernel=json.loads((root / "contents.json").read_text())["kernel"],
            parts=board_parts(root, content, base),
            packages=packages(status),
        )
        lean = board.kernel == "lean"
        own = {"flotilla-runtime", *([f"linux-image-{made.kernel}"] if lean else [])}
        installed = {(package.name, package.version) for package in made.packages if package.name not in own}
        locked = {(package.name, package.version) for package in (lock.without("kernel") if lean else lock).packages}
        if installed != locked:  # a defect of the builder, not the user's
            raise RuntimeError(f"installed and locked packages differ: {sorted(installed ^ locked)}")
        (out / "shared.json").write_text(made.model_dump_json())
        sboms(board.name, locks, status, out)

    return cache.result("manifest", key, make)


def board_parts(root: Path, content: Path, base: Path) -> list[Part]:
    """What all cards of a board have in common, piece by piece."""
    state = part("boot state", base / "card.img", card.STATE.start, card.STATE.size)
    files = [root / name for name in ("vmlinuz", "initrd.img", "root.squashfs") if (root / name).exists()]
    files.append(content / "slot.img")
    return [state, *(part(file.name, file, 0, file.stat().st_size) for file in files)]


def packages(status: str) -> list[Package]:
    """The packages of a dpkg status file by name."""
    found = []
    for fields in mirror.stanzas(status):
        name, version = fields["Package"], fields["Version"]
        source = re.fullmatch(r"(\S+)(?: \((.+)\))?", fields.get("Source", name))
        assert source
        found.append(
            Package(
                name=name,
                version=version,
                architecture=fields["Architecture"],
                source=source[1],
                source_version=source[2] or version,
                installed_kib=int(fields.get("Installed-Size", 0)),
            )
        )
    return sorted(found, key=lambda package: package.name)


def sboms(board: str, locks: tuple[Lock, Lock], status: str, out: Path) -> None:
    """Write `sbom.spdx.json` and `sbom.cdx.json` about the packages of a dpkg status file, the boot loader, and the
    tools that made the card. `locks`: the board's and the build tools'.

    debsbom reads a root directory: the status, and for the packages' hashes an index as apt keeps it.
    """
    lock, tools_lock = locks
    hashes = {package.name: package.sha256 for package in lock.packages}
    root = out / "root"
    apt = root / "var/lib/apt/lists"
    apt.mkdir(parents=True)
    (root / _DPKG_STATUS).parent.mkdir(parents=True)
    (root / _DPKG_STATUS).write_text(status, encoding="utf-8")
    index = [
        f"Package: {fields['Package']}\nVersion: {fields['Version']}\nArchitecture: {fields['Architecture']}\n"
        f"Maintainer: {fields.get('Maintainer', '')}\nSHA256: {hashes[fields['Package']]}\n\n"
        for fields in mirror.stanzas(status)
        if fields["Package"] in hashes
    ]
    suite = lock.suites[0]
    (apt / "flotilla_Release").write_text(
        f"Origin: Debian\nCodename: {suite.name}\nArchitectures: {lock.architecture}\nComponents: main\n"
    )
    (apt / f"flotilla_main_binary-{lock.architecture}_Packages").write_text("".join(index), encoding="utf-8")
    content = hashlib.sha256(f"{tools_lock.digest} {status}".encode()).hexdigest()
    identity = uuid.uuid5(uuid.NAMESPACE_OID, f"flotilla {board} {lock.digest} {content}")
    program = Path(sys.executable).with_name("debsbom")
    argv = [
        str(program), "generate", "--root", str(root), "--out", str(out / "made"), "--distro-arch", lock.architecture,
        "--distro-name", f"flotilla-{board}", "--distro-version", lock.digest[:16],
        "--timestamp", datetime.fromtimestamp(lock.epoch, UTC).isoformat(),
        "--cdx-serialnumber", str(identity), "--spdx-namespace", f"urn:uuid:{identity}",
    ]  # fmt: skip
    environment = {"PATH": os.environ.get("PATH", ""), "LC_ALL": "C.UTF-8", "TZ": "UTC", "PYTHONHASHSEED": "0"}
    try:
        done = subprocess.run(argv, env=environment, capture_output=True, text=True, encoding="utf-8", check=False)
    except FileNotFoundError:
        raise UserError(f"{program}: not installed; run `make setup`") from None
    if done.returncode:
        raise UserError(f"debsbom failed (status {done.returncode}): {done.stderr.strip()}")
    for ending in SBOMS:
        made = out / f"made.{ending}"
        document = _with_missing_suites(json.loads(made.read_text(encoding="utf-8")), lock)
        document = _sorted(_with_tools(document, tools_lock))
        text = json.dumps(document, indent=1, ensure_ascii=False, sort_keys=True)
        (out / f"sbom.{ending}").write_text(text + "\n", encoding="utf-8")
        made.unlink()
    shutil.rmtree(root)


def _with_missing_suites(document: dict[str, Any], lock: Lock) -> dict[str, Any]:
    """The bill with the suites that its packages were not updated from, where each format has room for that."""
    missing = lock.missing_suites
    if missing and "spdxVersion" in document:
        document["comment"] = f"The packages were locked without the suites {', '.join(missing)}."
    elif missing:
        properties = document["metadata"].setdefault("properties", [])
        properties += [{"name": "flotilla:missing-suite", "value": name} for name in missing]
    return document


def _with_tools(document: dict[str, Any], lock: Lock) -> dict[str, Any]:
    """The bill with the packages that made the card. What is of the boot loader is a part of the system, too."""
    suite = lock.suites[0].name
    purls = {
        package.name: f"pkg:deb/debian/{package.name}@{quote(package.version, safe=':~')}?arch={package.architecture}"
        f"&distro={suite}"
        for package in lock.packages
    }
    if "spdxVersion" in document:
        system = _spdx_system(document)
        for package in lock.packages:
            reference = f"SPDXRef-tool-{package.name.replace('+', '.plus')}"
            purl = {
                "referenceCategory": "PACKAGE_MANAGER", "referenceType": "purl",
                "referenceLocator": purls[package.name],
            }  # fmt: skip
            document["packages"].append(_spdx_package(reference, package) | {"externalRefs": [purl]})
            kinds = ["BUILD_TOOL_OF", *(["PACKAGE_OF"] if package.name == _BOOT_LOADER else [])]
            document["relationships"] += [
                {"spdxElementId": reference, "relatedSpdxElement": system, "relationshipType": kind} for kind in kinds
            ]
        return document
    components = {
        package.name: _component(f"tool/{package.name}", package) | {"purl": purls[package.name]}
        for package in lock.packages
    }
    # CycloneDX, "formulation": what was used to make it, apart from what it consists of.
    document["formulation"] = [{"bom-ref": "tools", "components": list(components.values())}]
    if _BOOT_LOADER in components:
        loader = components[_BOOT_LOADER] | {"bom-ref": f"boot-loader/{_BOOT_LOADER}"}
        document["components"].append(loader)
        _cdx_parts(document).append(loader["bom-ref"])
    return document


class _Named(Protocol):
    """What a bill says of a package or an app."""

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> str: ...
    @property
    def sha256(self) -> str: ...


def _spdx_package(reference: str, named: _Named) -> dict[str, Any]:
    return {
        "SPDXID": reference, "name": named.name, "versionInfo": named.version,
        "checksums": [{"algorithm": "SHA256", "checksumValue": named.sha256}],
        "downloadLocation": "NOASSERTION", "filesAnalyzed": False, "primaryPackagePurpose": "APPLICATION",
        "licenseConcluded": "NOASSERTION", "licenseDeclared": "NOASSERTION", "copyrightText": "NOASSERTION",
    }  # fmt: skip


def _component(reference: str, named: _Named) -> dict[str, Any]:
    return {
        "type": "application", "bom-ref": reference, "name": named.name, "version": named.version,
        "hashes": [{"alg": "SHA-256", "content": named.sha256}],
    }  # fmt: skip


def _spdx_system(document: dict[str, Any]) -> str:
    """Identifier of the system that a bill describes."""
    (system,) = (it["relatedSpdxElement"] for it in document["relationships"] if it["relationshipType"] == "DESCRIBES")
    return str(system)


def _cdx_parts(document: dict[str, Any]) -> list[str]:
    """References of what the system consists of, to be added to."""
    system = document["metadata"]["component"]["bom-ref"]
    parts: list[str]
    (parts,) = (it["dependsOn"] for it in document["dependencies"] if it["ref"] == system)
    return parts


def _sorted(value: Any) -> Any:
    """The document with its lists in order: debsbom writes them as a set's hashes fall."""
    if isinstance(value, dict):
        return {key: _sorted(content) for key, content in value.items()}
    if isinstance(value, list):
        return sorted(map(_sorted, value), key=lambda item: json.dumps(item, sort_keys=True))
    return value


# --- per robot ---


def write(
    fleet: Fleet,
    robot: Robot,
    locks: tuple[Lock, Lock],
    common: Path,
    *,
    board_inputs: str,
    nodes: list[Node],
    apps: Sequence[BuiltApp],
    source: Source | str,
    fleet_source: Source | str = "",
    boot_loader: Part,
    data: Part,
    image: Part,
    extents: card.Extents,
    beside: Path,
) -> None:
    """Write the manifest and the bills of materials of `beside`, an image of which everything is known.

    `locks`: the board's and the build tools'. `common`: what `shared` made. `board_inputs`: what `inputs_of_board`
    said. `source`, `fleet_source`: what `checkout` returned for the tool and for the
    fleet's home.
    """
    board = fleet.boards[robot.board]
    lock, tools_lock = locks
    same = Shared.model_validate_json((common / "shared.json").read_bytes())
    manifest = Manifest(
        format=FORMAT,
        robot=RobotId(number=robot.number, name=robot.name, board=robot.board),
        architecture=board.architecture,
        kernel=same.kernel,
        lock=_lock_id(lock),
        tools=_lock_id(tools_lock),
        epoch=lock.epoch,
        inputs=inputs(board_inputs, nodes),
        source=None if isinstance(source, str) else source,
        source_unknown=source if isinstance(source, str) else "",
        fleet_source=None if isinstance(fleet_source, str) else fleet_source,
        fleet_source_unknown=fleet_source if isinstance(fleet_source, str) else "",
        image=image,
        parts=[boot_loader, *same.parts, data],
        partitions=partitions(board, card.disk_id(nodes), extents),
        packages=same.packages,
        apps=[entry_of(app) for app in apps],
        hostvars=hostvars(fleet, robot),
    )
    file_of(beside).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
    for ending in SBOMS:
        bill = common / f"sbom.{ending}"
        if manifest.apps:
            text = with_apps(bill.read_text(encoding="utf-8"), robot.name, manifest.apps)
            beside.with_suffix(f".{ending}").write_text(text, encoding="utf-8")
        else:
            shutil.copyfile(bill, beside.with_suffix(f".{ending}"))


def entry_of(app: BuiltApp) -> App:
    """An app in a manifest."""
    return App(name=app.name, version=app.version, bytes=app.bytes, sha256=app.sha256)


def with_apps(bill: str, robot: str, apps: Sequence[App]) -> str:
    """A board's bill of materials with the apps of a robot: another document, with an identity of its own."""
    document = json.loads(bill)
    words = [f"flotilla {robot}", cache.digest(bill), *(app.model_dump_json() for app in apps)]
    identity = uuid.uuid5(uuid.NAMESPACE_OID, " ".join(words))
    if "spdxVersion" in document:
        document["documentNamespace"] = f"urn:uuid:{identity}"
        relationships, system = document["relationships"], _spdx_system(document)
        for app in apps:
            reference = f"SPDXRef-app-{app.name}"
            document["packages"].append(_spdx_package(reference, app))
            of = {"spdxElementId": reference, "relatedSpdxElement": system, "relationshipType": "PACKAGE_OF"}
            relationships.append(of)
    else:
        document["serialNumber"] = f"urn:uuid:{identity}"
        depends = _cdx_parts(document)
        for app in apps:
            reference = f"app/{app.name}@{app.version}"
            document["components"].append(_component(reference, app))
            depends.append(reference)
    return json.dumps(_sorted(document), indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def inputs_of_board(board: Board, locks: tuple[Lock, Lock]) -> str:
    """One hash over all that goes into the images of a board's robots, but for what is a robot's own: rather too much
    (all of the builder) than too little."""
    rooms = [paths.PACKAGE / name for name in ("images", "debian", "fleet", "common")]
    return cache.digest(
        *(lock.digest for lock in locks), rootfs.key(board, *locks), *card.SOURCES, slot.RELEASE_FILE, *rooms,
        paths.PROJECT / "requirements/build.lock", board.model_dump_json(),
    )  # fmt: skip


def inputs(of_board: str, nodes: list[Node]) -> str:
    """One hash over all that goes into a robot's image."""
    identity = [
        part
        for node in nodes
        for part in (
            f"{node.path} {node.mode:o} {node.uid} {node.gid}{node.target and f' -> {node.target}'}",
            node.content or b"",
            str(node.content is None),
        )
    ]
    return cache.digest(of_board, *identity)


def partitions(board: Board, disk_id: int, extents: card.Extents) -> list[Partition]:
    """The partition table, with how much of each partition the extents of a card fill."""
    contents = {"system": "fat", "state": "raw", "A": "squashfs", "B": "empty", "data": "ext4"}
    return [
        Partition(
            number=partition.number,
            name=partition.name,
            partuuid=partition.partuuid(board, disk_id),
            content=contents[partition.name],
            start=partition.start,
            bytes=partition.size,
            used=sum(
                length for start, length in extents if partition.start <= start < partition.start + partition.size
            ),
        )
        for partition in card.partitions(board)
    ]


def hostvars(fleet: Fleet, robot: Robot) -> dict[str, JsonValue]:
    """The robot's variables as the fleet model says them, with those it shares."""
    own: dict[str, JsonValue] = robot.model_dump(mode="json", exclude={"board"})
    shared: dict[str, JsonValue] = {
        "fleet_name": fleet.name,
        "network": fleet.network.model_dump(mode="json"),
        "interface": fleet.interface(robot),
        "board": fleet.boards[robot.board].model_dump(mode="json"),
    }
    return own | shared


def of_home() -> Source | str:
    """What `checkout` returns for the fleet's home; nothing where that is the tool's own checkout."""
    return checkout(paths.HOME, _ENTERING_FROM_HOME) if paths.OWN_HOME else ""


def checkout(directory: Path = paths.PROJECT, entering: Sequence[str] = _ENTERING) -> Source | str:
    """Commit and cleanliness of the checkout that `directory` is the top of; why they are unknown otherwise. Of a tool
    that was installed: its version.

    Another user may own the checkout. So no command of git's reads more than its objects: the others run programs that
    the repository's configuration names (core.fsmonitor, filters). And git would leave out the files that it
    ignores, which are in the image all the same.
    """
    if directory == paths.PROJECT and paths.INSTALLED:
        return f"installed: flotilla {version('flotilla')}"
    try:
        top, commit = _git(directory, "rev-parse", "--show-toplevel", "HEAD").decode().splitlines()
        if Path(top).resolve() != directory.resolve():  # unpacked inside somebody else's repository
            return f"{directory} is not the top of a git checkout"
        return Source(commit=commit, dirty=_differs(directory, commit, entering))
    except subprocess.CalledProcessError as error:
        return error.stderr.decode(errors="replace").strip().partition("\n")[0] or f"git failed ({error.returncode})"
    except (OSError, ValueError) as error:
        return str(error)


def _differs(directory: Path, commit: str, entering: Sequence[str]) -> bool:
    """Whether the files of a checkout are others than those of the commit; in these folders, also whether there are
    more."""
    committed = _committed(directory, commit)
    if any(_blob(path, identity) != (mode, identity) for path, (mode, identity) in committed.items()):
        return True
    folders = (directory / name for name in entering)
    return any(path not in committed for each in folders if each.is_dir() for path in sources.files(each))


def _committed(directory: Path, commit: str) -> dict[Path, tuple[str, str]]:
    """Mode and identity of each file of a commit, those of submodules included. Format: git-ls-tree(1)."""
    found = {}
    for entry in _git(directory, "ls-tree", "-rz", "--full-tree", commit).split(b"\0")[:-1]:
        properties, _, name = entry.partition(b"\t")
        mode, _, identity = properties.decode().split()
        path = directory / os.fsdecode(name)
        if mode != _SUBMODULE:
            found[path] = mode, identity
        elif (path / ".git").exists():  # otherwise nobody asked for it
            found |= _committed(path, identity)
    return found


def _blob(path: Path, like: str) -> tuple[str, str]:
    """Mode and identity that git gives a file; hashed as the identity `like` is."""
    if path.is_symlink():
        mode, content = "120000", os.fsencode(path.readlink())
    elif path.is_file():
        mode, content = "100755" if sources.executable(path) else "100644", path.read_bytes()
    else:
        return "", ""
    algorithm = "sha1" if len(like) == _SHA1 else "sha256"
    return mode, hashlib.new(algorithm, b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def _git(directory: Path, *arguments: str) -> bytes:
    # The directory's owner gains nothing by being trusted: whoever builds here runs the owner's programs anyway.
    argv = ["git", "-c", f"safe.directory={directory.resolve()}", "-C", str(directory), *arguments]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    # Objects that a partial clone has not are not fetched: the repository says by which program.
    environment |= {"GIT_NO_LAZY_FETCH": "1", "GIT_ALLOW_PROTOCOL": "none", "LC_ALL": "C.UTF-8"}
    return subprocess.run(argv, env=environment, capture_output=True, check=True).stdout


def _lock_id(lock: Lock) -> LockId:
    suites = [Suite(archive=suite.archive, name=suite.name, released=suite.date) for suite in lock.suites]
    return LockId(name=lock.name, sha256=lock.digest, suites=suites, missing_suites=list(lock.missing_suites))


def part(name: str, file: Path, start: int, length: int) -> Part:
    """A range of a file as part of an image."""
    return Part(name=name, bytes=length, sha256=hash_range(file, start, length).hexdigest())


def hash_range(file: Path, start: int, length: int, before: hashlib._Hash | None = None) -> hashlib._Hash:
    """SHA-256 over a range of a file, going on from what came `before`. Lets other threads work meanwhile.

    Holes, most of an image, are not read: the kernel would fill as much memory with zeros.
    """
    total = before or hashlib.sha256()
    buffer, zeros = memoryview(bytearray(_CHUNK)), memoryview(bytes(_CHUNK))
    end = start + length
    with file.open("rb", buffering=0) as content:
        if (missing := end - os.fstat(content.fileno()).st_size) > 0:
            raise EOFError(f"{file} ends {missing} bytes early")
        for position in range(start, end, _CHUNK):
            size = min(end - position, _CHUNK)
            if compare.holds_data(content, position, size):
                content.seek(position)
                size = content.readinto(buffer[:size])
                total.update(buffer[:size])
            else:
                total.update(zeros[:size])
    return total

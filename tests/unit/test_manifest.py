"""The manifest and the bills of materials: what they say, and that the same inputs give the same bytes."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from shutil import which
from types import SimpleNamespace

import pytest
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from spdx_tools.spdx.parser.parse_anything import parse_file
from spdx_tools.spdx.validation.document_validator import validate_full_spdx_document

from flotilla.common.errors import UserError
from flotilla.debian.lock import Lock, Package, Suite, format_lock, parse_lock, read_lock
from flotilla.fleet import inventory
from flotilla.fleet.model import Fleet
from flotilla.images import build, card, manifest
from flotilla.images.filesystem import Node

STATUS = """Package: libone
Status: install ok installed
Architecture: i386
Source: one (1.2)
Version: 1.2+b1
Installed-Size: 40
Maintainer: A Developer <a@example.org>
Description: first
 Written by hand.

Package: beta
Status: install ok installed
Architecture: all
Version: 2:3-1
Maintainer: A Developer <a@example.org>
Depends: libone
Description: second

Package: gamma
Status: install ok installed
Architecture: i386
Source: one
Version: 1.2
Installed-Size: 7
Maintainer: A Developer <a@example.org>
Description: third
"""


def locked(name: str, version: str, sha256: str) -> Package:
    return Package(name, version, "i386", "userland", "debian", 1, sha256, f"pool/{name}.deb")


LOCK = Lock(
    "board",
    "i386",
    (Suite("debian", "bookworm", datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)),),
    (locked("beta", "2:3-1", "b" * 64), locked("gamma", "1.2", "c" * 64), locked("libone", "1.2+b1", "a" * 64)),
)
NODES = [
    Node(PurePosixPath("/etc")),
    Node(PurePosixPath("/etc/hostname"), b"robot3\n", 0o644),
    Node(PurePosixPath("/A/etc/machine-id"), b"%032x\n" % (0xF1 << 96), 0o644),
]


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    return inventory.load_fleet()


# --- packages and bills of materials ---


def test_packages_have_their_sources() -> None:
    assert [(package.name, package.source, package.source_version) for package in manifest.packages(STATUS)] == [
        ("beta", "beta", "2:3-1"),
        ("gamma", "one", "1.2"),
        ("libone", "one", "1.2"),
    ]
    assert [package.installed_kib for package in manifest.packages(STATUS)] == [0, 7, 40]


def sboms(status: str, out: Path) -> dict[str, bytes]:
    out.mkdir()
    manifest.sboms("board", (LOCK, read_lock("tools")), status, out)
    return {path.name: path.read_bytes() for path in out.iterdir()}


def test_bills_of_materials(tmp_path: Path) -> None:
    made = sboms(STATUS, tmp_path / "one")
    assert sorted(made) == ["sbom.cdx.json", "sbom.spdx.json"]
    assert made == sboms(STATUS, tmp_path / "elsewhere")
    spdx, cdx = json.loads(made["sbom.spdx.json"]), json.loads(made["sbom.cdx.json"])
    assert {"beta", "gamma", "libone"} <= {package["name"] for package in spdx["packages"]}
    assert {"beta", "gamma", "libone"} <= {component["name"] for component in cdx["components"]}
    assert spdx["creationInfo"]["created"] == "2026-01-02T03:04:05Z"
    assert cdx["metadata"]["timestamp"].startswith("2026-01-02T03:04:05")
    checksums = {package["name"]: package["checksums"] for package in spdx["packages"] if "checksums" in package}
    assert checksums["libone"] == [{"algorithm": "SHA256", "checksumValue": "a" * 64}]
    assert str(tmp_path).encode() not in b"".join(made.values())

    other = json.loads(sboms(STATUS.replace("Version: 1.2\n", "Version: 1.3\n"), tmp_path / "other")["sbom.cdx.json"])
    assert other["serialNumber"] != cdx["serialNumber"]


def test_bills_name_the_boot_loader_and_the_tools_that_made_the_card(tmp_path: Path) -> None:
    """By the readers of those who made the formats."""
    made = sboms(STATUS, tmp_path / "one")
    tools = {package.name: package for package in read_lock("tools").packages}
    spdx, cdx = json.loads(made["sbom.spdx.json"]), json.loads(made["sbom.cdx.json"])
    names = {package["SPDXID"]: package["name"] for package in spdx["packages"]}
    related = {(names.get(it["spdxElementId"]), it["relationshipType"]) for it in spdx["relationships"]}
    assert {(name, "BUILD_TOOL_OF") for name in tools} <= related
    assert ("grub-pc-bin", "PACKAGE_OF") in related
    assert ("squashfs-tools", "PACKAGE_OF") not in related
    document = parse_file(str(tmp_path / "one/sbom.spdx.json"))
    assert validate_full_spdx_document(document) == []
    used = {each["name"]: each for each in cdx["formulation"][0]["components"]}
    assert used.keys() == tools.keys()
    assert used["grub-pc-bin"]["hashes"][0]["content"] == tools["grub-pc-bin"].sha256
    assert "grub-pc-bin" in {each["name"] for each in cdx["components"]}
    judge = JsonStrictValidator(SchemaVersion.from_version(cdx["specVersion"]))
    wrong = judge.validate_str(made["sbom.cdx.json"].decode())
    assert wrong is None, wrong
    other = json.loads(bills_with_other_tools(tmp_path / "other")["sbom.cdx.json"])
    assert other["serialNumber"] != cdx["serialNumber"]


def bills_with_other_tools(out: Path) -> dict[str, bytes]:
    tools = read_lock("tools")
    out.mkdir()
    manifest.sboms("board", (LOCK, replace(tools, packages=tools.packages[1:])), STATUS, out)
    return {path.name: path.read_bytes() for path in out.iterdir()}


def test_a_lock_without_a_suite_is_told_everywhere(fleet: Fleet, tmp_path: Path) -> None:
    """A planted lock: i386's, with and without the suite of security updates."""
    names = ("bookworm", "bookworm-updates", "bookworm-security")
    suites = [Suite("debian-security" if "sec" in name else "debian", name, LOCK.suites[0].date) for name in names]
    whole = replace(LOCK, suites=tuple(suites))
    for lock, missing in ((whole, []), (replace(LOCK, suites=tuple(suites[:2])), ["bookworm-security"])):
        assert list(parse_lock(format_lock(lock), "board", "board.lock").missing_suites) == missing
        out = tmp_path / str(len(missing))
        out.mkdir()
        manifest.sboms("board", (lock, read_lock("tools")), STATUS, out)
        spdx, cdx = (json.loads((out / f"sbom.{ending}").read_text()) for ending in manifest.SBOMS)
        assert ("bookworm-security" in spdx.get("comment", "")) == bool(missing)
        told = [each["value"] for each in cdx["metadata"].get("properties", []) if each["name"].startswith("flotilla")]
        assert told == missing
        made = manifest.read(written(fleet, out / "image", lock=lock), "make image")
        assert made.lock.missing_suites == missing


def test_every_build_says_in_one_line_what_its_lock_lacks(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    locks = {"smartcoret3": replace(LOCK, name="smartcoret3"), "x86_64": read_lock("x86_64")}
    monkeypatch.setattr("flotilla.images.build.host.check", lambda: None)
    monkeypatch.setattr("flotilla.images.build.namespace.check", lambda: None)
    monkeypatch.setattr("flotilla.images.build.cache.exclusive", nullcontext)
    monkeypatch.setattr(build, "check_tasks", lambda *_: None)
    monkeypatch.setattr(build, "fill_pool", lambda _: None)
    monkeypatch.setattr(build, "board_build", lambda board, _: SimpleNamespace(lock=locks[board.name]))
    monkeypatch.setattr(build, "_robot_images", lambda *_: [])
    build.build(fleet, [fleet.robots[number] for number in (1, 2, 3)])
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(
        "smartcoret3: note: the lock has no packages of bookworm-updates, bookworm-security, because"
    )
    assert line.endswith("the image is complete")


def test_order_of_lists_does_not_matter() -> None:
    one, two = {"b": 1, "a": ["x", {"k": [2, 1]}]}, {"a": [{"k": [1, 2]}, "x"], "b": 1}
    assert json.dumps(manifest._sorted(one)["a"]) == json.dumps(manifest._sorted(two)["a"])
    assert manifest._sorted(one) != manifest._sorted({"a": ["x", {"k": [1, 3]}], "b": 1})


# --- hashes ---


def test_hash_of_ranges(tmp_path: Path) -> None:
    content = bytes(range(256)) * 9000
    file = tmp_path / "file"
    file.write_bytes(content)
    assert manifest.hash_range(file, 100, 2_000_000).digest() == hashlib.sha256(content[100:2_000_100]).digest()
    beginning = manifest.hash_range(file, 0, 1_500_000)
    whole = manifest.hash_range(file, 1_500_000, len(content) - 1_500_000, beginning)
    assert whole.digest() == hashlib.sha256(content).digest()
    with pytest.raises(EOFError):
        manifest.hash_range(file, 0, len(content) + 1)


def test_hash_of_a_file_with_holes(tmp_path: Path) -> None:
    file = tmp_path / "file"
    with file.open("wb") as sparse:
        for position in (5_000_000, 9_999_999):
            sparse.seek(position)
            sparse.write(b"data")
        sparse.truncate(20_000_000)
    assert file.stat().st_blocks * 512 < 1 << 20, "the file system has no holes"
    expected = hashlib.sha256(file.read_bytes()[77:19_000_077])
    assert manifest.hash_range(file, 77, 19_000_000).digest() == expected.digest()


def test_inputs_follow_everything(fleet: Fleet) -> None:
    board, locks = fleet.boards["smartcoret3"], (LOCK, LOCK)
    of_board = manifest.inputs_of_board(board, locks)
    same = manifest.inputs(of_board, NODES)
    assert same == manifest.inputs(manifest.inputs_of_board(board, locks), list(NODES))
    hostname = NODES[1]
    of_others = [
        manifest.inputs_of_board(fleet.boards["x86_64"], locks),
        manifest.inputs_of_board(board, (LOCK, replace(LOCK, packages=LOCK.packages[1:]))),
    ]
    own = [
        replace(hostname, content=b"robot4\n"),
        replace(hostname, content=b""),
        replace(hostname, content=None),
        replace(hostname, mode=0o600),
        replace(hostname, uid=1000),
    ]
    others = [manifest.inputs(other, NODES) for other in of_others]
    others += [manifest.inputs(of_board, [NODES[0], *changed]) for changed in ([], *([node] for node in own))]
    assert len({same, *others}) == 1 + len(others)


# --- git ---


def git(directory: Path, *arguments: str) -> str:
    author = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    argv = ["git", "-C", str(directory), *author, *arguments]
    return subprocess.run(argv, check=True, capture_output=True, text=True).stdout.strip()


def test_checkout(tmp_path: Path) -> None:
    project = tmp_path / "project"
    project.mkdir()
    (project / "file").write_text("1")
    assert "not a git repository" in str(manifest.checkout(project))
    git(project, "init", "-q")
    assert "HEAD" in str(manifest.checkout(project)), "no commit yet"
    git(project, "add", "file")
    git(project, "commit", "-qm", "first")
    clean = manifest.checkout(project)
    assert clean == manifest.Source(commit=git(project, "rev-parse", "HEAD"), dirty=False)
    (project / "file").write_text("2")
    dirty = manifest.checkout(project)
    assert dirty == manifest.Source(commit=clean.commit, dirty=True)
    (project / "inside").mkdir()
    assert "is not the top of a git checkout" in str(manifest.checkout(project / "inside")), "another's repository"


def committed(project: Path) -> manifest.Source:
    """A checkout with a file, a program and a link; its source."""
    overlay = project / "rootfs_overlay"
    overlay.mkdir(parents=True)
    (overlay / "file").write_text("1")
    (overlay / "program").touch(0o755)
    (overlay / "link").symlink_to("/nowhere")
    git(project, "init", "-q")
    git(project, "add", ".")
    git(project, "commit", "-qm", "first")
    source = manifest.checkout(project)
    assert source == manifest.Source(commit=git(project, "rev-parse", "HEAD"), dirty=False)
    return source


CHANGES: dict[str, Callable[[Path], object]] = {
    "content": lambda overlay: (overlay / "file").write_text("2"),
    "mode": lambda overlay: (overlay / "file").chmod(0o755),
    "link": lambda overlay: (overlay / "link").rename(overlay / "file"),
    "missing": lambda overlay: (overlay / "file").unlink(),
    "untracked": lambda overlay: (overlay / "new").touch(),
    "ignored": lambda overlay: (overlay / "new.local").touch(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_checkout_is_dirty_by_what_an_image_gets(tmp_path: Path, change: str) -> None:
    """Whatever git was told: seen to be called clean were a file that git ignores, an untracked one with
    status.showUntrackedFiles=no, a mode with core.fileMode=false, and content that is assumed to be unchanged."""
    source = committed(tmp_path)
    git(tmp_path, "config", "status.showUntrackedFiles", "no")
    git(tmp_path, "config", "core.fileMode", "false")
    git(tmp_path, "update-index", "--assume-unchanged", "rootfs_overlay/file")
    (tmp_path / ".git/info/exclude").write_text("*.local\n")
    CHANGES[change](tmp_path / "rootfs_overlay")
    assert manifest.checkout(tmp_path) == manifest.Source(commit=source.commit, dirty=True)


def test_what_enters_no_image_makes_no_checkout_dirty(tmp_path: Path) -> None:
    source = committed(tmp_path)
    (tmp_path / "rootfs_overlay/__pycache__").mkdir()
    (tmp_path / "rootfs_overlay/__pycache__/a.pyc").touch()
    (tmp_path / "rootfs_overlay/file~").touch()
    (tmp_path / "notes").touch()
    assert manifest.checkout(tmp_path) == source


def test_a_submodule_is_a_part_of_the_checkout(tmp_path: Path) -> None:
    project, one = tmp_path / "project", tmp_path / "one"
    committed(one)
    committed(project)
    git(project, "-c", "protocol.file.allow=always", "submodule", "add", "-q", str(one), "apps/one")
    git(project, "commit", "-qm", "second")
    clean = manifest.checkout(project)
    assert clean == manifest.Source(commit=git(project, "rev-parse", "HEAD"), dirty=False)
    (project / "apps/one/rootfs_overlay/file").write_text("2")
    assert manifest.checkout(project) == manifest.Source(commit=clean.commit, dirty=True)
    git(project, "submodule", "deinit", "-f", "apps/one")
    assert manifest.checkout(project) == clean


def test_the_commit_of_anothers_checkout_is_known_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen to fail: the manifest had no commit. `git status` ran the filter and what core.fsmonitor names."""
    project, ran = tmp_path / "project", tmp_path / "ran"
    source = committed(project)
    program = tmp_path / "program"
    program.write_text(f'#!/bin/sh\necho "$0" >>"{ran}"\n')
    program.chmod(0o755)
    for key in ("core.fsmonitor", "filter.own.clean", "filter.own.process", "core.sshCommand", "core.pager"):
        git(project, "config", key, str(program))
    git(project, "config", "core.hooksPath", str(tmp_path / "hooks"))
    (tmp_path / "hooks").mkdir()
    (tmp_path / "hooks/post-index-change").symlink_to(program)
    (project / ".git/info/attributes").write_text("* filter=own\n")
    os.utime(project / "rootfs_overlay/file")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/git").write_text(f'#!/bin/sh\nGIT_TEST_ASSUME_DIFFERENT_OWNER=1 exec {which("git")} "$@"\n')
    (tmp_path / "bin/git").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    refused = subprocess.run(["git", "-C", project, "status"], capture_output=True, text=True, check=False)
    assert "dubious ownership" in refused.stderr
    assert manifest.checkout(project) == source
    assert not ran.exists(), ran.read_text()


def test_without_git_the_manifest_says_so(fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    why = manifest.checkout()
    assert isinstance(why, str)
    assert "'git'" in why
    made = manifest.read(written(fleet, tmp_path / "made", source=why), "make image")
    assert (made.source, made.source_unknown) == (None, why)


# --- the whole ---


EXTENTS = [
    (0, 512 + 1000),
    (card.STATE.start, 4096),
    (card.STATE.start + 8192, 4096),
    (card.SLOTS[0].start, 5),
    (card.DATA.start, 9),
]


def written(
    fleet: Fleet, directory: Path, number: int = 3, source: manifest.Source | str = "", lock: Lock | None = None
) -> Path:
    common = directory / "common"
    common.mkdir(parents=True)
    same = manifest.Shared(
        kernel="6.1.0", parts=[manifest.Part(name="vmlinuz", bytes=1, sha256="0")], packages=manifest.packages(STATUS)
    )
    (common / "shared.json").write_text(same.model_dump_json())
    for ending in manifest.SBOMS:
        (common / f"sbom.{ending}").write_text(ending)
    image = directory / f"robot{number}.img"
    locks = lock or read_lock("smartcoret3"), read_lock("tools")
    manifest.write(
        fleet, fleet.robots[number], locks, common, board_inputs="0", nodes=NODES, source=source, apps=(),
        boot_loader=manifest.Part(name="boot loader", bytes=9, sha256="0"),
        data=manifest.Part(name="data partition", bytes=9, sha256="1"),
        image=manifest.Part(name=image.name, bytes=card.SIZE, sha256="2"), extents=EXTENTS, beside=image,
    )  # fmt: skip
    return image


def test_manifest(fleet: Fleet, tmp_path: Path) -> None:
    image = written(fleet, tmp_path)
    made = manifest.read(image, "make image")
    assert made.robot == manifest.RobotId(number=3, name="robot3", board="smartcoret3")
    assert made.lock.sha256 == read_lock("smartcoret3").digest
    assert made.hostvars["interface"] == fleet.interface(fleet.robots[3])
    assert made.hostvars["address"] == str(fleet.robots[3].address)
    assert [part.name for part in made.parts] == ["boot loader", "vmlinuz", "data partition"]
    assert {partition.name: partition.used for partition in made.partitions} == {
        "state": 8192,
        "A": 5,
        "B": 0,
        "data": 9,
    }
    assert (tmp_path / "robot3.spdx.json").read_text() == "spdx.json"
    assert (tmp_path / "robot3.cdx.json").read_text() == "cdx.json"


def test_same_inputs_same_bytes(fleet: Fleet, tmp_path: Path) -> None:
    one = manifest.file_of(written(fleet, tmp_path / "one")).read_bytes()
    assert one == manifest.file_of(written(fleet, tmp_path / "two")).read_bytes()
    assert one != manifest.file_of(written(fleet, tmp_path / "other", number=4)).read_bytes()
    source = manifest.Source(commit="0" * 40, dirty=False)
    assert one != manifest.file_of(written(fleet, tmp_path / "git", source=source)).read_bytes()
    assert str(tmp_path).encode() not in one


def test_no_private_key_in_the_manifest(fleet: Fleet, tmp_path: Path) -> None:
    text = manifest.file_of(written(fleet, tmp_path)).read_text()
    assert "PRIVATE" not in text
    assert "robot3" in text


def test_missing_and_foreign_manifests(fleet: Fleet, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is missing; `make image ROBOT=3`"):
        manifest.read(tmp_path / "robot3.img", "make image ROBOT=3")
    image = written(fleet, tmp_path)
    path = manifest.file_of(image)
    text = path.read_text()
    for old, new in (('"format": 1', '"format": 2'), ('"epoch"', '"other"'), ("{", "")):
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(UserError, match="not a manifest of format 1; `make image`"):
            manifest.read(image, "make image")

"""Apps of the inventory: what is on a card of them, what a robot says of its own, and what is made of that.

That they are built, and repaired on a robot: tests/provisioning/test_assigned_apps.py.
"""

from __future__ import annotations

import base64
import importlib.util
import io
import json
import os
import subprocess
import sys
import tarfile
from dataclasses import replace
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any

import pytest

from flotilla.apps import assigned
from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian.lock import read_lock
from flotilla.fleet import apps, identity
from flotilla.fleet.apps import BuiltApp
from flotilla.fleet.inventory import load_fleet
from flotilla.fleet.model import Fleet
from flotilla.images import card, data_partition, manifest
from flotilla.images.filesystem import Node
from flotilla.robot.apps import judge

SERVICE = "flotilla-app@hover.service"


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    """Robot 4 has an app."""
    described = load_fleet()
    robot = described.robots[4].model_copy(update={"apps": ["hover"]})
    return described.model_copy(update={"robots": described.robots | {4: robot}})


@pytest.fixture
def built(tmp_path: Path) -> Path:
    """What a build makes."""
    (tmp_path / "hover" / "unit.d").mkdir(parents=True)
    (tmp_path / "hover" / "blocks").mkdir()
    (tmp_path / "hover" / "task.yml").write_text("period: 10 ms\n")
    (tmp_path / "hover" / "blocks" / "hover.so").write_bytes(b"\x7fELF")
    (tmp_path / "hover" / "hover").write_bytes(b"program")
    (tmp_path / "hover" / "hover").chmod(0o700)
    return tmp_path / "hover"


@pytest.fixture
def hover(built: Path) -> BuiltApp:
    return apps.read("hover", built, "hover")


def test_an_app_is_its_files_however_they_were_made(built: Path, hover: BuiltApp, tmp_path: Path) -> None:
    """Seen to fail with the modes that a umask left."""
    assert hover.files[PurePosixPath("hover")] == (b"program", 0o755)
    assert hover.listing.decode().splitlines()[0] == f"version {apps.version(built)}"
    assert "755 " in hover.listing.decode()
    elsewhere = tmp_path / "elsewhere" / "hover"
    elsewhere.parent.mkdir()
    built.rename(elsewhere)
    (elsewhere / "hover").chmod(0o755)
    assert apps.read("hover", elsewhere, "hover") == hover
    (elsewhere / "task.yml").write_text("period: 20 ms\n")
    other = apps.read("hover", elsewhere, "hover")
    assert other.version != hover.version
    assert other.sha256 != hover.sha256
    (elsewhere / "empty").mkdir()  # seen to be left out of the version, and sent
    assert apps.version(elsewhere) != other.version


def test_a_card_has_its_apps_as_deploy_would_leave_them(fleet: Fleet, hover: BuiltApp) -> None:
    """Links, too: seen to fail without the one that starts the app, and with an empty directory left out."""
    nodes = {str(node.path): node for node in data_partition.nodes(fleet, fleet.robots[4], [hover])}
    version = f"/apps/.hover@{hover.version}"
    assert nodes[f"{version}/task.yml"].content == b"period: 10 ms\n"
    assert nodes[f"{version}/hover"].mode == 0o755
    assert nodes[f"{version}/unit.d"] == Node(PurePosixPath(f"{version}/unit.d"))
    system = "/A/etc/systemd/system"
    assert {path: node.target for path, node in nodes.items() if node.target} == {
        "/apps/hover": f".hover@{hover.version}",
        f"{system}/{SERVICE}.d": "/data/apps/hover/unit.d",
        f"{system}/multi-user.target.wants/{SERVICE}": "/usr/lib/systemd/system/flotilla-app@.service",
    }
    assert nodes["/A/etc/flotilla/apps/hover"].content == hover.listing
    seen = {PurePosixPath("/")}
    for node in nodes.values():
        assert node.path.parent in seen, node.path
        seen.add(node.path)
    plain = load_fleet()
    without = {str(node.path): node for node in data_partition.nodes(plain, plain.robots[4])}
    assert without.items() <= nodes.items()
    assert not [path for path in without if "app" in path]


def test_no_app_is_left_out_without_a_word(fleet: Fleet, hover: BuiltApp) -> None:
    for given in ([], [replace(hover, name="other")], [hover, hover]):
        with pytest.raises(ValueError, match="robot4 has the apps"):
            identity.render(fleet, fleet.robots[4], given)


def test_apps_that_leave_no_room_are_refused(fleet: Fleet, hover: BuiltApp) -> None:
    big = replace(hover, files={PurePosixPath("data"): (bytes(card.DATA.size // 2), 0o644)})
    with pytest.raises(UserError, match=r"robot4.*hover.*MiB.*data_mib in images/boot/card.yml"):
        data_partition.nodes(fleet, fleet.robots[4], [big])


def test_small_files_count_by_what_they_take(fleet: Fleet, hover: BuiltApp) -> None:
    """Seen to fail: five thousand bytes in as many files counted as 5 kB, and the card had inodes for some of them."""
    files = {PurePosixPath(f"data/{number}"): (b"x", 0o644) for number in range(5000)}
    many = replace(hover, files={**files, PurePosixPath("large"): (bytes(3 << 20), 0o644)})
    with pytest.raises(UserError, match=r"take \d+\.\d MiB in 5001 files, .*the largest file is .*/large, 3\.0 MiB"):
        data_partition.nodes(fleet, fleet.robots[4], [many])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (b"two\nlines", r"'two\\nlines': has a control character in its name; rename it"),
        (b"caf\xe9", r"'caf\\udce9': has a byte that is no UTF-8 in its name; rename it"),
        ("line\u2028end".encode(), r"'line\\u2028end': has a line end in its name; rename it"),
    ],
)
def test_an_apps_file_whose_name_no_robot_can_have_is_named(
    fleet: Fleet, built: Path, monkeypatch: pytest.MonkeyPatch, name: bytes, said: str
) -> None:
    """In the built app, and before that in its sources. Seen to fail with a UnicodeEncodeError, and with a listing
    whose lines were no files."""
    (Path(os.fsdecode(os.fsencode(built) + b"/" + name))).write_bytes(b"")
    with pytest.raises(UserError, match=f"^{said}$"):
        apps.read("hover", built)
    monkeypatch.setattr(paths, "APPS", built.parent)
    (built / "app.yml").write_text("kind: block\n")
    with pytest.raises(UserError, match=f"robot4.apps: hover: {said}$"):
        assigned.built(fleet, [fleet.robots[4]])


BILLS = {
    "spdx.json": {
        "spdxVersion": "SPDX-2.3", "documentNamespace": "urn:uuid:0", "packages": [],
        "relationships": [
            {"spdxElementId": "SPDXRef-DOCUMENT", "relatedSpdxElement": "SPDXRef-os", "relationshipType": "DESCRIBES"}
        ],
    },
    "cdx.json": {
        "serialNumber": "urn:uuid:0", "components": [], "dependencies": [{"ref": "os", "dependsOn": ["a"]}],
        "metadata": {"component": {"bom-ref": "os"}},
    },
}  # fmt: skip


def test_manifest_and_bills_name_the_apps(fleet: Fleet, hover: BuiltApp, tmp_path: Path) -> None:
    """Seen to fail with the board's bills copied, and with an identity that two robots share."""
    same = manifest.Shared(kernel="6.1.0", parts=[], packages=[])
    (tmp_path / "shared.json").write_text(same.model_dump_json())
    for ending, bill in BILLS.items():
        (tmp_path / f"sbom.{ending}").write_text(json.dumps(bill))
    image = tmp_path / "robot4.img"
    part = manifest.Part(name="some", bytes=1, sha256="0")
    manifest.write(
        fleet, fleet.robots[4], (read_lock("smartcoret3"), read_lock("tools")), tmp_path, board_inputs="0",
        nodes=[Node(PurePosixPath("/A/etc/machine-id"), b"%032x\n" % 1)],
        apps=[hover], source="no git", boot_loader=part, data=part, image=part, extents=[], beside=image,
    )  # fmt: skip
    (told,) = manifest.read(image, "make image").apps
    assert (told.name, told.version, told.sha256) == ("hover", hover.version, hover.sha256)
    made = {ending: json.loads(image.with_suffix(f".{ending}").read_text()) for ending in BILLS}
    (package,), (component,) = made["spdx.json"]["packages"], made["cdx.json"]["components"]
    assert (package["name"], package["checksums"][0]["checksumValue"]) == ("hover", hover.sha256)
    assert (component["name"], component["hashes"][0]["content"]) == ("hover", hover.sha256)
    assert len(made["spdx.json"]["relationships"]) == 2
    assert made["cdx.json"]["dependencies"][0]["dependsOn"] == ["a", component["bom-ref"]]
    assert "urn:uuid:0" not in (made["spdx.json"]["documentNamespace"], made["cdx.json"]["serialNumber"])
    other = json.loads(manifest.with_apps(json.dumps(BILLS["cdx.json"]), "robot3", [told]))
    assert other["serialNumber"] != made["cdx.json"]["serialNumber"]


# What a robot says, and what is made of it


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, hover: BuiltApp) -> ModuleType:
    """The module that runs on robots, on a robot whose places are below `robot` and that has the app as it should."""
    place = paths.PROJECT / "ansible" / "library" / "robot_state.py"
    spec = importlib.util.spec_from_file_location("library_robot_state", place)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    top = tmp_path / "robot"
    for name in ("APPS", "LISTINGS", "SYSTEM"):
        monkeypatch.setattr(module, name, str(top) + getattr(module, name))
    described = module.described

    def of_root(path: str) -> Any:
        found = described(path)
        if found:
            found.owner = (0, 0)  # whoever runs the tests
        return found

    monkeypatch.setattr(module, "described", of_root)
    for path, (content, mode) in hover.files.items():
        file = top / str(hover.place / path).lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
        file.chmod(mode)
    for link, target in hover.links.items():
        file = top / str(link).lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.symlink_to(str(top) + target if target.startswith("/data") else target)
    listing = top / "etc/flotilla/apps/hover"
    listing.parent.mkdir(parents=True)
    listing.write_bytes(hover.listing)
    return module


def state(module: ModuleType, wanted: list[BuiltApp], up: bool = True) -> dict[str, Any]:
    """What the robot says."""
    files = {
        app.name: {"files": {path: {"sha256": sha, "mode": mode} for path, (sha, mode) in app.hashes.items()}}
        for app in wanted
    }
    unit = {"Type": "notify", "ActiveState": "active" if up else "inactive", "SubState": "", "Result": "success"}
    said: dict[str, Any] = module.apps(files, {SERVICE: unit | {"ConditionResult": "yes", "RemainAfterExit": "no"}})
    return said


INSTALL = [("hover", "receive"), ("hover", "keep"), ("hover", "start")]
APP = "data/apps/hover"
WANTS = f"etc/systemd/system/multi-user.target.wants/{SERVICE}"
BROKEN: dict[str, tuple[str, str, str, list[tuple[str, str]]]] = {
    "file": (f"{APP}/task.yml", "another", "is not as built: task.yml has another content", INSTALL),
    "file gone": (f"{APP}/task.yml", "gone", "is not as built: task.yml is missing", INSTALL),
    "mode": (f"{APP}/hover", "mode", "is not as built: hover has mode 644 and owner 0", INSTALL),
    "more": (f"{APP}/more", "another", "is not as built: more does not belong to it", INSTALL),
    "all gone": (APP, "gone", "is missing", INSTALL),
    "drop-in": (f"etc/systemd/system/{SERVICE}.d", "gone", "does not have its unit.d", INSTALL),
    "not kept": (WANTS, "gone", "does not start with the robot", [("hover", "keep")]),
}


@pytest.mark.parametrize(("path", "how", "said", "actions"), BROKEN.values(), ids=BROKEN.keys())
def test_what_is_wrong_with_an_app_is_said_and_put_right(
    robot: ModuleType, hover: BuiltApp, tmp_path: Path, path: str, how: str, said: str, actions: list[tuple[str, str]]
) -> None:
    """Seen to fail with each of the looks at the robot left out."""
    assert judge(4, state(robot, [hover]), [hover]).faults == []
    file = tmp_path / "robot" / path
    if how == "gone":
        file.unlink()
    elif how == "mode":
        file.chmod(0o644)
    else:
        file.write_text("another\n")
    verdict = judge(4, state(robot, [hover]), [hover])
    assert verdict.faults == [f"app hover {said}"]
    assert verdict.actions == actions


def test_an_app_that_was_stopped_is_started(robot: ModuleType, hover: BuiltApp) -> None:
    verdict = judge(4, state(robot, [hover], up=False), [hover])
    assert (verdict.faults, verdict.actions) == (["app hover does not run"], [("hover", "start")])


def test_a_new_version_is_told_from_one_that_was_brought_by_hand(
    robot: ModuleType, hover: BuiltApp, tmp_path: Path
) -> None:
    """Seen to fail where both are said in the same words."""
    newer = replace(hover, version="0" * 16)
    (fault,) = judge(4, state(robot, [newer]), [newer]).faults
    assert fault == f"app hover is version {hover.version}, and the inventory's is {newer.version}"
    (tmp_path / "robot/etc/flotilla/apps/hover").write_text("version 1111111111111111\n")
    verdict = judge(4, state(robot, [newer]), [newer])
    assert f"is version {hover.version}, deployed manually, and the inventory's is {newer.version}" in verdict.faults[0]
    assert verdict.actions == INSTALL


def test_what_left_the_inventory_goes_and_what_was_brought_by_hand_stays(robot: ModuleType, tmp_path: Path) -> None:
    """Seen to fail with both removed, and with both kept."""
    verdict = judge(4, state(robot, []), [])
    assert (verdict.faults, verdict.actions) == (["app hover is not the robot's any more"], [("hover", "clear")])
    (tmp_path / "robot/etc/flotilla/apps/hover").unlink()
    verdict = judge(4, state(robot, []), [])
    assert (verdict.faults, verdict.actions) == ([], [])
    (note,) = verdict.notes
    assert note.endswith("make deploy ROBOT=4 APP=apps/hover RUN=remove")


def test_a_robot_is_sent_what_the_card_would_have(hover: BuiltApp) -> None:
    """Seen to fail without the empty directory."""
    receive, start = assigned.repairs([("hover", "receive"), ("hover", "start")], [hover])
    assert receive["argv"][3:6] == ["flotilla", "receive", "hover"]
    assert receive["argv"][6::2] == [hover.version, "hover"]
    assert start["argv"][3:] == ["flotilla", "start", "hover"]
    with tarfile.open(fileobj=io.BytesIO(base64.b64decode(receive["stdin"]))) as tar:
        members = {member.name: (member.isdir(), member.mode, member.uid, member.mtime) for member in tar}
    assert members == {
        "blocks": (True, 0o755, 0, 0),
        "blocks/hover.so": (False, 0o644, 0, 0),
        "hover": (False, 0o755, 0, 0),
        "task.yml": (False, 0o644, 0, 0),
        "unit.d": (True, 0o755, 0, 0),
    }


def test_an_app_that_a_robot_refuses_is_said_and_its_listing_stays_away(tmp_path: Path) -> None:
    """A listing without its app would be drift that nobody sees. Seen to fail with files written first."""
    source = (paths.PROJECT / "ansible" / "library" / "robot_files.py").read_text()
    listing = tmp_path / "listing"
    refusing = {
        "name": "hover",
        "argv": ["sh", "-c", "cat >&2; exit 3"],
        "stdin": base64.b64encode(b"no room").decode(),
    }
    written = {str(listing): {"content": "", "mode": 0o644}}
    arguments = {"before": [refusing], "write": written, "remove": [], "restore": [], "then": "true"}
    module = source.replace("<<INCLUDE_ANSIBLE_MODULE_JSON_ARGS>>", json.dumps(arguments))
    done = subprocess.run([sys.executable, "-c", module], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == {"failed": True, "msg": "hover: no room"}
    assert not listing.exists()


def test_what_needs_no_compiler_is_checked_at_once(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of it, each with the robot and the app. Seen to fail where the first problem ends the check."""
    monkeypatch.setattr(paths, "APPS", tmp_path / "apps")
    can = "blocks: {bus: {type: can-receive, parameters: {id: 1}}}\n"
    for name, description, task in (("wrong", "kind: blok\n", ""), ("bus", "kind: block\n", can)):
        (paths.APPS / name).mkdir(parents=True)
        (paths.APPS / name / "app.yml").write_text(description)
        (paths.APPS / name / "task.yml").write_text(task)
    robot = fleet.robots[4].model_copy(update={"apps": ["wrong", "bus"]})
    with pytest.raises(UserError) as refused:
        assigned.check(fleet, [robot])
    wrong, bus = str(refused.value).splitlines()
    assert "robot4.apps: wrong: " in wrong
    assert "blok: is no kind of app" in wrong
    assert "robot4.apps: bus: " in bus
    assert "apps/bus/task.yml: blocks.bus.parameters.interface: robot4 has no CAN interface can0" in bus

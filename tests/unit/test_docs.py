"""What documents name exists: paths, links, targets of make, messages. Links within docs/ are Sphinx's to check."""

from __future__ import annotations

import fnmatch
import functools
import re
import subprocess
from pathlib import Path, PurePosixPath

import pytest

from flotilla.cli import make
from flotilla.cli.main import commands
from flotilla.common import paths
from flotilla.debian import kernel
from flotilla.debian.lock import read_lock
from flotilla.fleet import identity, inventory, privileges
from flotilla.fleet.model import Fleet
from flotilla.images import build, space
from flotilla.reference.commands import MAKEFILES

TROUBLESHOOTING = paths.PROJECT / "docs" / "troubleshooting.md"
OUTPUTS = ("build/", "apps/", "ansible/keys/")
"""Where outputs, apps of one's own and keys go: not in git."""

HEADERS = "runtime/include/"
"""Where headers lie that are included as `flotilla/block.h`."""


@functools.cache
def tracked() -> tuple[str, ...]:
    """Files of the checkout that git knows or would add, and their folders."""
    argv = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(argv, cwd=paths.PROJECT, capture_output=True, text=True, check=True).stdout.splitlines()
    files = [file for file in listed if (paths.PROJECT / file).exists()]
    folders = {str(parent) for file in files for parent in Path(file).parents}
    return (*files, *sorted(folders))


def documents() -> list[str]:
    return sorted(file for file in tracked() if file.endswith(".md"))


def missing_paths(text: str) -> list[str]:
    """Paths below a folder of the checkout that name nothing there. NAME and other capitals stand for anything."""
    tops = {file.split("/", 1)[0] for file in tracked() if "/" in file}
    pattern = rf"(?<![\w./{{}}*-])(?:{'|'.join(map(re.escape, sorted(tops)))})/[\w./*@-]*[\w*/]"
    found = sorted(set(re.findall(pattern, text)))
    return [path for path in found if not path.startswith(OUTPUTS) and not _exists(path)]


def _exists(path: str) -> bool:
    wanted = re.sub(r"\b(NAME|BOARD|AREA|KIND|NNNN)\b", "*", path.rstrip("/")).replace("board_NAME", "board_*")
    return any(fnmatch.fnmatchcase(file, place + wanted) for place in ("", HEADERS) for file in tracked())


def dead_links(text: str, folder: Path) -> list[str]:
    """Relative targets of links and pictures that are not there."""
    targets = [target.split("#", 1)[0] for target in re.findall(r"\]\(([^)\s]+)\)", text)]
    relative = [target for target in targets if target and not re.match(r"[a-z]+:", target)]
    return [target for target in relative if not (paths.PROJECT / folder / target).exists()]


def unknown_targets(text: str) -> set[str]:
    """What stands in code as `make TARGET`, and is not in `make help`."""
    argv = ["make", "-C", str(paths.PROJECT), "help", "TARGET=all"]
    shown = subprocess.run(argv, capture_output=True, text=True, check=True).stdout
    return set(re.findall(r"(?:`|^)(?:sudo )?make (?:-C \S+ )?([a-z-]+)", text, re.MULTILINE)) - set(
        re.findall(r"^  ([a-z-]+) ", shown, re.MULTILINE)
    )


MAKE_CODE = re.compile(r"make ((?:-C \S+ )?)([a-z-]+(?: [a-z-]+)*)((?: [A-Z_0-9]+=(?:\"[^\"]*\"|'[^']*'|[^\s\"'`]+))+)")


def unknown_variables(text: str) -> list[str]:
    """Variables of targets in code that the target does not have: `make image ROBT=3`."""
    listed, found = make.targets(commands()), []
    for _, targets, given in MAKE_CODE.findall(text):
        ours = [listed[each] for each in targets.split() if each in listed]
        known = set(make.GLOBAL).union(*(make.variables(make.own_parser(command), of) for command, of in ours))
        names = re.findall(r" ([A-Z_0-9]+)=", given)
        found += [f"{targets} {name}" for name in names if ours and name not in known]
    return found


@functools.cache
def sources() -> str:
    """All that programs may say, in one text."""
    kinds = (".py", ".c", ".h", ".sh", ".yml", ".j2", "init", "preinit", "grub.cfg.j2", "check-host")
    files = [file for file in tracked() if file.endswith(kinds) and not file.startswith(("docs/", "tests/"))]
    return "\n".join((paths.PROJECT / file).read_text() for file in files if (paths.PROJECT / file).is_file())


def unsaid(text: str) -> list[str]:
    """Pieces of the messages in the first column of tables that no program says. Whatever differs is `…`."""
    messages = re.findall(r"^\| (`.*?`) +\|", text, re.MULTILINE)
    pieces = [piece.strip(" `:") for message in messages for piece in re.split(r"…|`", message)]
    return [piece for piece in pieces if len(piece) > 3 and piece not in sources()]


@pytest.mark.parametrize("document", documents())
def test_what_a_document_names_exists(document: str) -> None:
    text = (paths.PROJECT / document).read_text()
    assert missing_paths(text) == []
    assert dead_links(text, Path(document).parent) == []
    assert unknown_targets(text) == set()
    assert unknown_variables(text) == []


OF_OTHERS = {
    "docs/usb-redirection-protocol.md", "examples/*.logr", "examples/example_urg_04lx.logr", "kernel/time/timeconst.h",
}  # fmt: skip
"""Files of other projects that sources name."""


def test_what_a_source_names_exists() -> None:
    """Files in comments, docstrings and messages. Seen to fail: one had the number of another decision record."""
    sources = [
        file for file in tracked() if not file.startswith("tests/") and not file.endswith((".md", ".json", ".lock"))
    ]
    files = [paths.PROJECT / file for file in sources if (paths.PROJECT / file).is_file()]
    missing = {
        f"{file}: {path}"
        for file in files
        for path in missing_paths(file.read_text(errors="replace"))
        if Path(path).suffix and path not in OF_OTHERS
    }
    assert len(files) > len(documents())
    assert missing == set()


def test_messages_of_troubleshooting_are_the_programs() -> None:
    assert unsaid(TROUBLESHOOTING.read_text()) == []


def test_the_interface_of_blocks_has_the_documented_number() -> None:
    """Seen to fail with another number in the page."""
    header = (paths.PROJECT / HEADERS / "flotilla" / "block.h").read_text()
    page = (paths.PROJECT / "docs" / "reference" / "versions.md").read_text()
    assert re.findall(r"`FL_ABI`, a number that is (\d+) now", page) == re.findall(r"#define FL_ABI (\d+)u", header)


def test_each_check_sees_what_is_wrong() -> None:
    wrong = "`docs/style.md` `docs/stile.md` [a](docs/style.md) [b](docs/stile.md) `make image` `make imgae`"
    assert missing_paths(wrong) == ["docs/stile.md"]
    assert missing_paths("ansible/inventory/group_vars/board_NAME.yml, images/packages/*.list, /docs/x, build/x") == []
    assert missing_paths("kernel/fragments/NAME.confg") == ["kernel/fragments/NAME.confg"]
    assert dead_links(wrong, Path()) == ["docs/stile.md"]
    assert unknown_targets(wrong) == {"imgae"}
    assert unknown_variables("`make image ROBT=3`, `make images check-fleet FLEET=x`") == ["image ROBT"]
    assert unsaid("| `no slot left, … all again` | |\n| `no slot right` | |\n") == ["no slot right"]


# --- ports and threats ---

THREATS = paths.PROJECT / "docs" / "explanation" / "threats.md"
PORT = re.compile(r"^\| (ICMP echo|(?:TCP|UDP) [\d-]+) \|", re.MULTILINE)


def admitted(rules: str) -> set[str]:
    """What a robot's firewall lets in, in the words of the page."""
    found = re.findall(r"(tcp|udp) dport (?:\{ (.*?) \}|(\d+)) accept", rules)
    named = {f"{kind.upper()} {port}" for kind, several, one in found for port in (several or one).split(", ")}
    return named | ({"ICMP echo"} if "icmp type echo-request accept" in rules else set())


def test_the_page_of_ports_is_the_firewall(fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "KEYS", tmp_path / "keys")
    rules, _ = identity.render(fleet, fleet.robots[1])[PurePosixPath("/etc/nftables.conf")]
    assert set(PORT.findall(THREATS.read_text())) == admitted(rules.decode())
    assert "TCP 2323" in admitted(rules.decode().replace("tcp dport 22 accept", "tcp dport 2323 accept"))


def test_each_threat_has_a_test_or_is_not_defended() -> None:
    """In each direction. Seen to fail with tests of other names."""
    directions = THREATS.read_text().partition("## Threats")[2].split("\n### ")[1:]
    assert len(directions) == 9
    rows = [line.split(" | ") for each in directions for line in each.splitlines()[4:] if line]
    assert len(rows) > 60
    for who, attempt, result, test in rows:
        named = re.findall(r"`((?:runtime/)?tests/\S+)::(\w+)`", test)
        assert named or "**not defended**" in result, f"{who} | {attempt}"
        for file, name in named:
            language = "static void" if file.endswith(".c") else "def"
            assert f"\n{language} {name}(" in (paths.PROJECT / file).read_text(), f"{file}::{name}"


# --- the tutorial's requirements ---

TUTORIAL = paths.PROJECT / "docs" / "tutorial.md"


def prerequisites(target: str) -> set[str]:
    """Targets of make that install packages, and those that `target` runs before it, through any number of others."""
    makefiles = "".join((paths.PROJECT / name).read_text() for name in MAKEFILES)
    rules = re.findall(r"^([a-z-]+):([^#\n]*)", makefiles, re.MULTILINE)
    direct = {name: set(words.replace("|", " ").split()) for name, words in rules}
    direct |= {
        name: {"setup", *(f"setup-{each}" for each in command.host if each != "build")}
        for name, (command, _) in make.targets(commands()).items()
    }
    found: set[str] = set()
    todo = {target}
    while todo:
        found |= (todo := {each for name in todo for each in direct.get(name, set())} - found)
    return found


def unannounced_packages(page: str) -> list[str]:
    """Steps of a tutorial that are the first to install a group of Debian packages, and do not name `sudo`."""
    installed: set[str] = set()
    found = []
    for step in page.split("\n## ")[1:]:
        targets = set(re.findall(r"^make ([a-z-]+)", step, re.MULTILINE))
        groups = {"setup", "setup-lab", "setup-runtime", "setup-tests"}
        new = set().union(*(prerequisites(target) | {target} for target in targets)) & groups - installed
        installed |= new
        if new and "`sudo`" not in step:
            found.append(step.splitlines()[0])
    return found


def test_each_step_of_the_tutorial_that_installs_packages_says_so() -> None:
    """Seen to fail: step 4 and step 7 installed packages, and the page said that only the first step does."""
    assert unannounced_packages(TUTORIAL.read_text()) == []
    assert unannounced_packages("\n## 1\n`sudo`\nmake setup\n## 2\nmake image\n## 3\nmake boot\n") == ["3"]


def test_the_tutorial_names_the_download_and_the_disk_of_its_steps(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen to fail with 160 MB and 2 GB: 220 MB are downloaded, and the kernel of the last step alone needs 4 GiB."""
    monkeypatch.setattr(paths, "POOL", tmp_path / "pool")
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    page = " ".join(TUTORIAL.read_text().split())
    board = fleet.boards[fleet.robots[3].board]
    trees, root = build._tree_locks(board), build._root_lock(board)
    packages = {package.sha256: package.size for lock in (*trees, root) for package in lock.packages}
    assert re.findall(r"downloads about (\d+) MB", page) == [f"{round(sum(packages.values()) / 1e6, -1):.0f}"]
    compilers = sum(package.size for package in read_lock("toolchain").packages)
    assert re.findall(r"compilers, about (\d+) MB", page) == [f"{round(compilers / 1e6, -1):.0f}"]
    (disk,) = map(int, re.findall(r"(\d+) GB of free disk", page))
    installed = 1.0e9  # Python packages and QEMU, as the page says
    assert disk * 1e9 >= space.needed(trees, [root], [root]) + kernel._SPACE + installed


# --- additions ---


def test_an_addition_ends_in_the_image_of_what_was_added(fleet: Fleet) -> None:
    """Seen to fail: `Add a robot` and `Add a board` ended in `make image ROBOT=3`, a robot that the fleet has."""
    page = (paths.PROJECT / "docs" / "how-to" / "operations.md").read_text()
    for title in ("Add a robot", "Add a board"):
        section = page.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
        numbers = [int(number) for number in re.findall(r"^make image ROBOT=(\d+)$", section, re.MULTILINE)]
        assert len(numbers) == 1, title
        assert numbers[0] not in fleet.robots, f"{title}: the inventory has robot {numbers[0]} already"


def test_a_board_with_the_watchdog_of_qemu_says_so(fleet: Fleet) -> None:
    """Seen to fail: board_x86_64.yml named its ib700 a watchdog of any 64-bit PC."""
    simulated = [
        board for board in fleet.boards.values() if board.architecture == "amd64" and "ib700wdt" in board.modules
    ]
    assert simulated
    for board in simulated:
        text = (paths.INVENTORY / "group_vars" / f"board_{board.name}.yml").read_text()
        assert re.search(r"- ib700wdt #.*QEMU.*replace", text), board.name


# --- what the README promises ---

README = paths.PROJECT / "README.md"


def test_the_readme_names_each_board_and_shows_the_example_fleet(fleet: Fleet) -> None:
    """Seen to fail: the page named no board; and with another address in its output of `make check-fleet`."""
    page = README.read_text()
    described = {
        file.stem.removeprefix("board_") for file in (paths.PROJECT / "ansible").glob("*/group_vars/board_*.yml")
    }
    assert described >= set(fleet.boards)
    assert [board for board in sorted(described) if f"`{board}`" not in page] == []
    assert f"\n```text\n{inventory.summary(fleet).rstrip()}\n```\n" in page


def test_the_readme_has_the_tutorials_figures() -> None:
    """Seen to fail with another size of the download."""
    shown = [" ".join(page.read_text().split()) for page in (README, TUTORIAL)]
    assert len({tuple(re.findall(r"downloads about \d+ MB", page)) for page in shown}) == 1


USERS = {"root", "nobody", "robot", privileges.UPDATE_USER, *privileges.USERS}


@pytest.mark.parametrize("document", documents())
def test_users_that_a_document_names_exist(document: str) -> None:
    """Seen to fail with a user `controls` in SECURITY.md."""
    text = " ".join((paths.PROJECT / document).read_text().split())
    assert set(re.findall(r"\busers? `([a-z-]+)`", text)) <= USERS

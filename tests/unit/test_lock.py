"""Locks, package lists, apt as resolver against an archive made here, mirrors from fake apt configurations."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import os
import re
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.debian import lock, mirror
from flotilla.debian.lock import Lock, Package, Suite
from flotilla.debian.mirror import DEBIAN, SECURITY
from flotilla.fleet import inventory
from tests.unit.debian_archive import RELEASED, Archive, signing_keys, stanza
from tests.unit.fault_server import FaultServer, certificate

LIBC = Package(
    "libc6", "2.36-9+deb12u1", "i386", "required", DEBIAN, 7, "0" * 64, "pool/main/g/glibc/libc6_2.36_i386.deb"
)
LOCK = Lock("board", "i386", (Suite(DEBIAN, "bookworm", RELEASED),), (LIBC,))


# --- text ---


def test_text_round_trip() -> None:
    text = lock.format_lock(LOCK)
    assert lock.parse_lock(text, "board", "board.lock") == LOCK
    assert lock.format_lock(lock.parse_lock(text, "board", "board.lock")) == text


def test_digest_and_epoch_follow_the_content() -> None:
    other = dataclasses.replace(LOCK, packages=(dataclasses.replace(LIBC, sha256="1" * 64),))
    assert other.digest != LOCK.digest
    assert LOCK.epoch == 1767323045


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (" 7 ", " seven ", "size 'seven' is malformed"),
        (" 7 ", " ", "a package has 8 values"),
        ("0" * 64, "0" * 63, "sha256"),
        ("pool/main", "pool/../etc", "path"),
        (" required ", " essential ", "role"),
        ("package libc6", "packet libc6", "no architecture, suite or package"),
        ("package libc6", "package  libc6", "9"),
    ],
)
def test_malformed_line_is_named(old: str, new: str, message: str) -> None:
    text = lock.format_lock(LOCK)
    assert old in text
    with pytest.raises(UserError, match=rf"^locks/board\.lock:6: .*{message}"):
        lock.parse_lock(text.replace(old, new), "board", "locks/board.lock")


def test_malformed_date_and_twice_the_same_package_are_named() -> None:
    text = lock.format_lock(LOCK)
    with pytest.raises(UserError, match=r"^board\.lock:3: "):
        lock.parse_lock(text.replace("2026-01-02T", "2026-13-02T"), "board", "board.lock")
    with pytest.raises(UserError, match=r"^board\.lock:7: package libc6 is locked twice"):
        lock.parse_lock(text + text.splitlines()[-1], "board", "board.lock")


@pytest.mark.parametrize("missing", ["architecture", "suite", "package"])
def test_truncated_lock_is_an_error(missing: str) -> None:
    lines = [line for line in lock.format_lock(LOCK).splitlines() if not line.startswith(missing)]
    with pytest.raises(UserError, match=f"has no {missing} (debian )?line"):
        lock.parse_lock("\n".join(lines), "board", "board.lock")


def test_missing_lock_says_how_to_make_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(paths, "LOCKS", tmp_path)
    with pytest.raises(UserError, match="make lock"):
        lock.read_lock("tools")


def test_difference() -> None:
    newer = dataclasses.replace(LIBC, version="2.37")
    added = dataclasses.replace(LIBC, name="adduser", version="3.1")
    assert lock.difference([LIBC], [added, newer]) == ["+ adduser 3.1", "~ libc6 2.36-9+deb12u1 -> 2.37"]
    assert lock.difference([LIBC, added], [LIBC]) == ["- adduser 3.1"]
    assert lock.difference([LIBC], [LIBC]) == []


@pytest.mark.parametrize("line", ["sudo", "sudo less # two", "Sudo # capital", "seed sudo # unknown word"])
def test_list_line_without_reason_or_form_is_named(line: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(paths, "PACKAGES", tmp_path)
    (tmp_path / "robot.list").write_text(f"# all\n\nkmod # modules\n{line}\n")
    with pytest.raises(UserError, match=r"robot\.list:4: "):
        lock.read_list("robot")


# --- the project's own lists and locks ---

RECIPES = lock.recipes(inventory.load_fleet().boards.values())


def unmet(name: str, locked: Lock) -> set[str]:
    """Packages that the lists ask for and the lock lacks."""
    have = {package.name for package in locked.packages}
    kernels = {re.sub(r"[0-9.]+(-[0-9]+|\+deb[0-9.]+)-", "", package.name) for package in locked.having("kernel")}
    return {
        wish.package for wish in lock.requests(RECIPES[name]) if wish.package not in (kernels if wish.kernel else have)
    }


@pytest.mark.parametrize("name", RECIPES)
def test_locks_hold_what_the_lists_ask_for(name: str) -> None:
    locked = lock.read_lock(name)
    assert unmet(name, locked) == set(), "the lists changed: make lock"
    assert unmet(name, dataclasses.replace(locked, packages=())) == {
        wish.package for wish in lock.requests(RECIPES[name])
    }


@pytest.mark.parametrize("name", RECIPES)
def test_locks_are_as_written_and_name_no_host(name: str) -> None:
    text = lock.lock_file(name).read_text()
    assert lock.format_lock(lock.read_lock(name)) == text
    for line in text.splitlines():
        assert "://" not in line
        assert not re.search(r"\b[a-z0-9-]+\.(org|com|net|io|de)\b", line)


@pytest.mark.parametrize("name", [name for name in RECIPES if name != "tools"])
def test_initramfs_generators_stay_out(name: str) -> None:
    assert not {package.name for package in lock.read_lock(name).packages} & {"initramfs-tools", "dracut"}


# --- resolution, against an archive made here ---

BOARD = {"x86_64": lock.Recipe("bookworm", "amd64", ("robot", "x86_64"))}


@pytest.fixture(scope="module")
def keys() -> Iterator[Path]:
    with signing_keys() as home:
        yield home


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with one board and a list of its own."""
    for name in ("BUILD", "PACKAGES", "LOCKS"):
        monkeypatch.setattr(paths, name, tmp_path / name.lower())
    paths.PACKAGES.mkdir()
    (paths.PACKAGES / "robot.list").write_text("tool # needed\n")
    (paths.PACKAGES / "x86_64.list").write_text("kernel linux-image-rt # real time\n")
    return tmp_path


@pytest.fixture
def signed(project: Path, keys: Path, monkeypatch: pytest.MonkeyPatch) -> Archive:
    monkeypatch.setattr(lock, "_KEYRINGS", (keys / "trusted.gpg",))
    return Archive(project / "archive", keys)


def test_resolution(signed: Archive) -> None:
    summary = lock.update_locks(BOARD, signed.write())
    locked = lock.read_lock("x86_64")
    assert {(package.name, package.version, package.role, package.archive) for package in locked.packages} == {
        ("apt", "1.0", "userland", DEBIAN),
        ("libc6", "1.0", "required", DEBIAN),
        ("sed", "1.0", "required", DEBIAN),
        ("tool", "1.0", "userland", DEBIAN),
        ("helper", "1.0+deb12u1", "userland", SECURITY),
        ("linux-image-6.1.0-9-rt", "6.1", "kernel", DEBIAN),
    }
    assert locked.epoch == int(RELEASED.timestamp())
    assert [suite.name for suite in locked.suites] == ["bookworm", "bookworm-updates", "bookworm-security"]
    assert "+ helper 1.0+deb12u1" in summary

    text = lock.lock_file("x86_64").read_text()
    assert lock.update_locks(BOARD, signed.write()) == "x86_64: unchanged"
    assert lock.lock_file("x86_64").read_text() == text

    lock.update_locks(BOARD, signed.write(), without=["bookworm-security"])
    reduced = lock.read_lock("x86_64")
    assert {package.archive for package in reduced.packages} == {DEBIAN}
    assert {suite.archive for suite in reduced.suites} == {DEBIAN}


def test_unchanged_packages_are_noted_with_the_time(signed: Archive) -> None:
    """By which `make cve` knows how old a lock is; nothing that is made from it changes.

    Seen to fail where nothing was written, and where the digest covered the note.
    """
    lock.update_locks(BOARD, signed.write())
    before = lock.read_lock("x86_64")
    signed.released = RELEASED + timedelta(days=40)
    assert lock.update_locks(BOARD, signed.write()) == "x86_64: unchanged"
    after = lock.read_lock("x86_64")
    assert (after.checked, after.current, before.current) == (signed.released, signed.released, RELEASED)
    assert (after.epoch, after.digest, after.suites) == (before.epoch, before.digest, before.suites)


def test_a_suite_that_is_back_is_taken_in_without_a_package_of_it(signed: Archive) -> None:
    """Seen to fail, by an `unchanged` that left the suite missing for ever."""
    signed.suites[SECURITY, "bookworm-security"] = stanza("extra", "1.2")
    lock.update_locks(BOARD, signed.write(), without=["bookworm-security"])
    reduced = lock.read_lock("x86_64")
    lock.update_locks(BOARD, signed.write())
    whole = lock.read_lock("x86_64")
    assert (reduced.missing_suites, whole.missing_suites) == (("bookworm-security",), ())
    assert whole.packages == reduced.packages


def test_unknown_package_is_named(signed: Archive) -> None:
    (paths.PACKAGES / "robot.list").write_text("misspelt # needed\n")
    with pytest.raises(UserError, match="misspelt"):
        lock.update_locks(BOARD, signed.write())


def test_package_that_is_no_meta_package_is_no_kernel(signed: Archive) -> None:
    (paths.PACKAGES / "x86_64.list").write_text("kernel extra # real time\n")
    with pytest.raises(UserError, match="extra is no meta package"):
        lock.update_locks(BOARD, signed.write())


def test_unsigned_archive_is_refused(project: Path) -> None:
    with pytest.raises(UserError, match="not signed"):
        lock.update_locks(BOARD, Archive(project / "archive").write())
    assert not lock.lock_file("x86_64").exists()


def test_signature_of_a_stranger_is_refused(project: Path, keys: Path) -> None:
    with pytest.raises(UserError, match=r"NO_PUBKEY|Missing key"):  # gpgv's words; sqv's, which newer apts ask
        lock.update_locks(BOARD, Archive(project / "archive", keys).write())


def test_index_that_the_signature_does_not_cover_is_refused(signed: Archive) -> None:
    mirrors = signed.write()
    index = signed.directory / SECURITY / "dists/bookworm-security/main/binary-amd64/Packages"
    index.write_text(index.read_text().replace("+deb12u1", "+deb12u2"))
    with pytest.raises(UserError, match=r"Hash Sum mismatch|unexpected size"):
        lock.update_locks(BOARD, mirrors)


def test_expired_archive_is_refused(signed: Archive) -> None:
    signed.expires = RELEASED + timedelta(days=7)
    with pytest.raises(UserError, match="expired"):
        lock.update_locks(BOARD, signed.write())


def test_missing_keyring_names_the_package(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "_KEYRINGS", (project / "none.gpg",))
    with pytest.raises(UserError, match="debian-archive-keyring"):
        lock.update_locks(BOARD, Archive(project / "archive").write())


def test_certificates_and_passwords_of_this_computers_apt(
    signed: Archive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind a proxy that inspects TLS. Seen to fail: of apt's settings, proxies alone were taken over."""
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    server = FaultServer(certificate(tmp_path))
    (tmp_path / "auth").write_text(f"machine {server.base} login user password secret\n")
    (tmp_path / "apt.conf").write_text(
        f'Acquire::https::CAInfo "{tmp_path}/ca.pem";\nDir::Etc::netrc "{tmp_path}/auth";\n'
    )
    monkeypatch.setenv("APT_CONFIG", str(tmp_path / "apt.conf"))
    signed.write()
    server.files = {f"/{path.relative_to(signed.directory)}": path.read_bytes() for path in files(signed.directory)}
    try:
        lock.update_locks(BOARD, server.mirrors)
    finally:
        server.close()
    assert lock.read_lock("x86_64").packages
    assert {each.get("Authorization") for each in server.headers} == {
        f"Basic {base64.b64encode(b'user:secret').decode()}"
    }


def files(directory: Path) -> list[Path]:
    return [path for path in directory.rglob("*") if path.is_file()]


# --- mirrors ---

DEB822 = """\
# one of Debian's own
Types: deb
# http://comment/debian
URIs: http://first/debian/
Suites: trixie trixie-updates
Components: main

Types: deb
URIs: http://first/security
Suites: trixie-security
Components: main
"""
ONE_LINE = """\
# deb http://comment/debian trixie main
deb-src http://source/debian trixie main
deb http://vendor/linux/debian trixie stable
deb [arch=amd64 signed-by=/k.gpg] http://first/debian trixie main contrib # near
deb http://second/debian trixie main
deb http://first/security trixie-security main
"""
BOTH = {DEBIAN: "http://first/debian", SECURITY: "http://first/security"}
TEMPLATE = """\
ChangelogURI: http://changelogs/%s

Suite: {{series}}
RepositoryType: deb
BaseURI: http://first/debian/
MatchURI: ((http|https)[0-9]*\\.([a-z]*\\.){{{{0,1}}}}|deb\\.)first
MirrorsFile: debian.mirrors
Component: main
CompDescription: Officially supported
X-Version: ge 12

Suite: {{series}}
RepositoryType: deb
BaseURI: http://first/debian/
Component: main
X-Version: le 11

Suite: {{series}}-security
BaseURI: http://first/security/
ParentSuite: {{series}}
X-Version: ge 11

Suite: {{series}}/updates
BaseURI: http://old/security/
X-Version: le 10

Suite: {{series}}-updates
ParentSuite: {{series}}

Suite: sid
BaseURI: http://unstable/debian/
Component: main
""".format()
"""As python-apt-common has it in its versions 2.6 to 3.0, with other addresses."""


@pytest.mark.parametrize(
    ("files", "os_id", "environment", "expected"),
    [
        ({"sources.list.d/debian.sources": DEB822}, "debian", {}, BOTH),
        ({"sources.list": ONE_LINE}, "debian", {}, BOTH),
        (
            {"sources.list": ONE_LINE},
            '"debian"',
            {"MIRROR": "http://mine/debian/"},
            BOTH | {DEBIAN: "http://mine/debian"},
        ),
        ({"sources.list.d/debian.sources.disabled": DEB822}, "debian", {}, {}),
        ({"sources.list.d/debian.sources": DEB822.replace("Types", "Enabled: no\nTypes")}, "debian", {}, {}),
        ({"sources.list.d/debian.sources": DEB822.replace("trixie", "duke")}, "debian", {}, {}),
        ({"sources.list.d/debian.sources": DEB822.replace("trixie", "stable")}, "debian", {}, BOTH),
        ({"sources.list": ONE_LINE}, "ubuntu", {}, {}),
        ({"sources.list": "deb http://first/ubuntu noble main\n"}, "debian", {}, {}),
        ({"sources.list": "deb cdrom:[Debian]/ trixie main\n"}, "debian", {}, {}),
        ({}, "debian", {}, {}),
        ({}, "ubuntu", {"MIRROR": BOTH[DEBIAN], "SECURITY_MIRROR": BOTH[SECURITY]}, BOTH),
    ],
)
def test_mirrors(
    tmp_path: Path, files: dict[str, str], os_id: str, environment: dict[str, str], expected: dict[str, str]
) -> None:
    (tmp_path / "sources.list.d").mkdir()
    (tmp_path / "os-release").write_text(f"NAME=x\nVERSION_CODENAME=trixie\nID={os_id}\n")
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    found = mirror.resolve(environment, tmp_path, tmp_path / "os-release", tmp_path / "templates")
    assert found.archives == expected
    for archive in set(mirror.ARCHIVES) - set(expected):
        with pytest.raises(UserError, match=r"make image .*SECURITY_MIRROR=http://MIRROR/debian-security"):
            found.of(archive)


@pytest.mark.parametrize("name", ["Debian.info", "debian.info"])
@pytest.mark.parametrize(
    ("os_id", "environment", "expected"),
    [
        ("ubuntu", {}, BOTH),
        ("ubuntu", {"MIRROR": "http://mine/debian"}, BOTH | {DEBIAN: "http://mine/debian"}),
        ("linuxmint", {}, BOTH),
        ("debian", {}, {}),  # its apt knows better: a mirror near by, or none for a reason
    ],
)
def test_another_distribution_says_where_debian_is(
    tmp_path: Path, name: str, os_id: str, environment: dict[str, str], expected: dict[str, str]
) -> None:
    """Seen to fail: on Ubuntu no mirror was known, and the remedy named was `make lock`, which replaces the locks."""
    (tmp_path / "os-release").write_text(f"ID={os_id}\nVERSION_CODENAME=trixie\nID_LIKE=debian\n")
    (tmp_path / "sources.list").write_text("deb http://first/ubuntu noble main\n")
    (tmp_path / name).write_text(TEMPLATE)
    assert mirror.resolve(environment, tmp_path, tmp_path / "os-release", tmp_path).archives == expected


def test_a_release_is_known_by_this_computer_alone(tmp_path: Path) -> None:
    """Seen to fail with a list of releases in the code: no mirror known, on a Debian newer than the list."""
    (tmp_path / "os-release").write_text('ID=debian\nVERSION_CODENAME="duke"\n')
    (tmp_path / "sources.list").write_text(ONE_LINE.replace("trixie", "duke"))
    assert mirror.resolve({}, tmp_path, tmp_path / "os-release").archives == BOTH


def test_list_of_mirrors(tmp_path: Path) -> None:
    (tmp_path / "os-release").write_text("ID=debian\nVERSION_CODENAME=bookworm\n")
    (tmp_path / "mirrors.list").write_text("http://first/debian\nhttp://second/debian\n")
    (tmp_path / "sources.list").write_text(f"deb mirror+file://{tmp_path}/mirrors.list bookworm main\n")
    assert mirror.resolve({}, tmp_path, tmp_path / "os-release").archives == {DEBIAN: "http://first/debian"}


def resolved(directory: Path, sources: str) -> dict[str, str]:
    """The mirrors of a trixie with these sources."""
    (directory / "os-release").write_text("ID=debian\nVERSION_CODENAME=trixie\n")
    (directory / "sources.list").write_text(sources)
    return dict(mirror.resolve({}, directory, directory / "os-release").archives)


VENDORS = """\
deb https://dl.browser.example/stable stable main
deb https://apt.tool.example/ trixie main
"""


def test_source_of_a_vendor_is_no_mirror(tmp_path: Path) -> None:
    """Whose suite is called `stable`, or as Debian's. Seen to be taken for Debian's mirror."""
    assert resolved(tmp_path, VENDORS) == {}
    assert resolved(tmp_path, VENDORS + ONE_LINE) == BOTH


def test_source_of_a_vendor_at_an_address_like_debians(tmp_path: Path) -> None:
    """The mirror has a suite of updates, too, which no vendor has. Seen to fail: the first was taken."""
    vendor = "deb https://pkgs.vendor.example/stable/debian trixie main\n"
    mirrors = [f"deb http://files.company.example/remote {suite} main\n" for suite in ("trixie", "trixie-updates")]
    assert resolved(tmp_path, "".join([vendor, *mirrors])) == {DEBIAN: "http://files.company.example/remote"}


def test_what_apt_has_fetched_says_who_publishes_a_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever addresses and suites are called. Seen to fail: the vendor's was taken, the company's was not."""
    lists = tmp_path / "lists"
    lists.mkdir()
    (tmp_path / "apt.conf").write_text(f'Dir::State::lists "{lists}";')
    monkeypatch.setenv("APT_CONFIG", str(tmp_path / "apt.conf"))

    def fetched(place: str, suite: str, origin: str, label: str) -> None:
        index = lists / f"{place}_dists_{suite}_main_binary-amd64_Packages"
        index.write_text("")
        release = f"Origin: {origin}\nLabel: {label}\nCodename: {suite}\nArchitectures: amd64\nComponents: main\n"
        listing = f"SHA256:\n {hashlib.sha256(b'').hexdigest()} 0 main/binary-amd64/Packages\n"
        (lists / f"{place}_dists_{suite}_Release").write_text(release + listing)

    fetched("pkgs.vendor.example_debian", "trixie", "Vendor", "Debian")
    fetched("files.company.example_one", "stock", "Debian", "Debian")
    fetched("files.company.example_two", "fixes", "Debian", "Debian-Security")
    sources = """\
deb [arch=amd64] http://pkgs.vendor.example/debian trixie main
deb [arch=amd64] http://files.company.example/one stock main
deb [arch=amd64] http://files.company.example/two fixes main
"""
    assert resolved(tmp_path, sources) == {
        DEBIAN: "http://files.company.example/one",
        SECURITY: "http://files.company.example/two",
    }


def test_sources_that_apt_cannot_read(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"sources\.list"):
        resolved(tmp_path, "nonsense\n")


def test_mirror_variable_must_be_an_address() -> None:
    with pytest.raises(UserError, match="MIRROR=deb12"):
        mirror.resolve({"MIRROR": "deb12"})


def test_snapshot_comes_from_the_environment(tmp_path: Path) -> None:
    assert mirror.resolve({"SNAPSHOT": "http://old/archive/"}, tmp_path, tmp_path).snapshot == "http://old/archive"
    assert mirror.resolve({"SNAPSHOT": ""}, tmp_path, tmp_path).snapshot is None


def test_no_file_of_the_builder_names_a_mirror() -> None:
    """The apt configuration of this computer knows a mirror; nothing in the project may."""
    hosts = {base.split("/")[2] for base in mirror.resolve(os.environ).archives.values()} - {""}
    for path in [*paths.LOCKS.iterdir(), *paths.PACKAGES.iterdir(), *Path(mirror.__file__).parent.glob("*.py")]:
        assert not [host for host in hosts if host in path.read_text()], path

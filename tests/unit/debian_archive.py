"""A small Debian archive for tests: apt resolves and verifies against it, without network."""

from __future__ import annotations

import hashlib
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from pathlib import Path

from flotilla.debian import mirror
from flotilla.debian.mirror import DEBIAN, SECURITY, Mirrors

RELEASED = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


class Archive:
    """A small Debian archive in a folder: three suites, signed or not."""

    def __init__(self, directory: Path, home: Path | None = None, architecture: str = "amd64") -> None:
        self.directory = directory
        self.home = home
        self.architecture = architecture
        self.released = RELEASED
        self.expires = datetime.now(UTC) + timedelta(days=1)
        self.suites: dict[tuple[str, str], str] = {
            (DEBIAN, "bookworm"): stanza("libc6", "1.0", Priority="required")
            + stanza("sed", "1.0", Essential="yes", Depends="libc6")
            + stanza("apt", "1.0", Priority="important")
            + stanza("tool", "1.0", Depends="helper", Recommends="extra")
            + "".join(stanza(name, "1.0") for name in ("helper", "extra", "initramfs-tools"))
            + stanza("linux-image-rt", "6.1", Depends="linux-image-6.1.0-9-rt (= 6.1)")
            + stanza("linux-image-6.1.0-9-rt", "6.1", Depends="initramfs-tools"),
            (DEBIAN, "bookworm-updates"): stanza("extra", "1.1"),
            (SECURITY, "bookworm-security"): stanza("helper", "1.0+deb12u1"),
        }

    def write(self) -> Mirrors:
        for (archive, suite), of_all in self.suites.items():
            text = of_all.replace("amd64", self.architecture)
            root = self.directory / archive / "dists" / suite
            listing = ""
            for component, content in {"main": text, "non-free-firmware": ""}.items():
                index = root / component / f"binary-{self.architecture}" / "Packages"
                index.parent.mkdir(parents=True, exist_ok=True)
                index.write_text(content)
                listing += f" {hashlib.sha256(content.encode()).hexdigest()} {len(content)} {index.relative_to(root)}\n"
            (root / "Release").write_text(
                f"Origin: Debian\nSuite: {suite}\nCodename: {suite}\nArchitectures: {self.architecture}\n"
                f"Components: main non-free-firmware\nDate: {format_datetime(self.released)}\n"
                f"Valid-Until: {format_datetime(self.expires)}\nSHA256:\n{listing}"
            )
            if self.home:
                gpg(self.home, "--clearsign", "-o", str(root / "InRelease"), str(root / "Release"))
        return Mirrors({archive: f"file://{self.directory}/{archive}" for archive in mirror.ARCHIVES})


def stanza(name: str, version: str, **fields: str) -> str:
    values = {
        "Package": name,
        "Version": version,
        "Architecture": "amd64",
        "Maintainer": "Nobody <nobody@localhost>",
        "Priority": "optional",
        "Filename": f"pool/main/{name}_{version}_amd64.deb",
        "Size": "8",
        "SHA256": hashlib.sha256(name.encode()).hexdigest(),
        "Description": name,
    }
    return "".join(f"{key}: {value}\n" for key, value in (values | fields).items()) + "\n"


def gpg(home: Path, *arguments: str) -> None:
    subprocess.run(
        ["gpg", "--homedir", str(home), "--batch", "--yes", "--quiet", *arguments], check=True, capture_output=True
    )


@contextmanager
def signing_keys() -> Iterator[Path]:
    """A GnuPG home with one key, and the keyring that trusts it; a short path, for the agent's socket."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as directory:
        home = Path(directory)
        gpg(home, "--passphrase", "", "--quick-gen-key", "test@localhost", "ed25519", "sign", "never")
        gpg(home, "-o", str(home / "trusted.gpg"), "--export")
        yield home
        subprocess.run(["gpgconf", "--homedir", directory, "--kill", "all"], check=False, capture_output=True)

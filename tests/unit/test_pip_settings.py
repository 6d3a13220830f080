"""pip and uv by the settings of pip, against a package index on this computer."""

from __future__ import annotations

import base64
import hashlib
import io
import os
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flotilla.common import paths
from images import pip_settings
from tests.unit.fault_server import PAGE, Answer, FaultServer, certificate

NAME = "flotilla_sample-1.0-py3-none-any.whl"
BIN = Path(sys.executable).parent
UV = [str(BIN / "uv"), "pip", "install", "--no-cache", "--quiet", "--python", sys.executable]
PIP = [sys.executable, "-m", "pip", "install", "--no-cache-dir", "--quiet"]
both = pytest.mark.parametrize("program", [PIP, UV], ids=["pip", "uv"])


def wheel() -> bytes:
    """A package of one module."""
    information = "flotilla_sample-1.0.dist-info"
    files = {
        "flotilla_sample.py": "",
        f"{information}/METADATA": "Metadata-Version: 2.1\nName: flotilla-sample\nVersion: 1.0\n",
        f"{information}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = "".join(
        f"{name},sha256={base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).decode().rstrip('=')},{len(text)}\n"
        for name, text in files.items()
    )
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, text in (files | {f"{information}/RECORD": record}).items():
            archive.writestr(name, text)
    return content.getvalue()


WHEEL = wheel()


def serve(server: FaultServer) -> None:
    server.files = {
        "/simple/flotilla-sample/": f'<a href="/{NAME}">{NAME}</a>'.encode(),
        f"/{NAME}": WHEEL,
    }
    server.kinds = {"/simple/flotilla-sample/": "text/html"}


@pytest.fixture
def index() -> Iterator[FaultServer]:
    running = FaultServer()
    serve(running)
    yield running
    running.close()


@pytest.fixture(autouse=True)
def nobodys_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nothing of whoever runs the tests."""
    of_networks = ("PIP_", "UV_", "SSL_CERT", "REQUESTS_", "CURL_")
    for name in os.environ:
        if name.startswith(of_networks) or name.lower().endswith("_proxy"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_DIRS", str(tmp_path))
    monkeypatch.setenv("PIP_CONFIG_FILE", str(tmp_path / "pip.conf"))
    monkeypatch.setenv("UV_HTTP_RETRIES", "0")
    monkeypatch.setenv("PIP_RETRIES", "1")
    (tmp_path / "pip.conf").write_text("")


def install(program: list[str], directory: Path) -> subprocess.CompletedProcess[str]:
    """As `make setup` does, into a directory."""
    (directory / "wanted").write_text(f"flotilla-sample==1.0 --hash=sha256:{hashlib.sha256(WHEEL).hexdigest()}\n")
    argv = [sys.executable, str(paths.PROJECT / "images/pip_settings.py"), *program]
    argv += ["--require-hashes", "--target", str(directory / "there"), "-r", str(directory / "wanted")]
    return subprocess.run(argv, capture_output=True, text=True, cwd=directory)


def assert_installed(done: subprocess.CompletedProcess[str], directory: Path) -> None:
    assert done.returncode == 0, done.stderr
    assert (directory / "there/flotilla_sample.py").is_file()


def test_index_of_a_variable(index: FaultServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen to be ignored by uv."""
    monkeypatch.setenv("PIP_INDEX_URL", f"{index.base}/simple")
    assert_installed(install(UV, tmp_path), tmp_path)


@pytest.mark.parametrize("section", ["global", "install"])
def test_index_of_a_file(section: str, index: FaultServer, tmp_path: Path) -> None:
    """Seen to be ignored by uv. It is the second index that has the package."""
    more = f"\n  {index.base}/nothing\n  {index.base}/simple"
    (tmp_path / "pip.conf").write_text(f"[{section}]\nindex-url = {index.base}/none\nextra-index-url ={more}\n")
    assert_installed(install(UV, tmp_path), tmp_path)


def test_directory_of_wheels(tmp_path: Path) -> None:
    """One that is missing does no harm."""
    (tmp_path / "wheels").mkdir()
    (tmp_path / "wheels" / NAME).write_bytes(WHEEL)
    links = f"{tmp_path}/none {tmp_path}/wheels"
    (tmp_path / "pip.conf").write_text(f"[global]\nno-index = true\nfind-links = {links}\n")
    assert_installed(install(UV, tmp_path), tmp_path)


def test_proxy_of_a_file(index: FaultServer, tmp_path: Path) -> None:
    (tmp_path / "pip.conf").write_text(
        f"[global]\nindex-url = http://index.invalid/simple\nproxy = {index.base}\ntrusted-host = index.invalid\n"
    )
    assert_installed(install(UV, tmp_path), tmp_path)
    assert all(each.startswith("http://index.invalid/") for each in index.requests)


@pytest.fixture
def inspected(tmp_path: Path) -> Iterator[FaultServer]:
    """An index whose certificate is of an authority of its own."""
    running = FaultServer(certificate(tmp_path))
    serve(running)
    yield running
    running.close()


def test_certificate_of_an_inspecting_proxy(
    inspected: FaultServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen to fail: uv has certificates of its own."""
    monkeypatch.setenv("PIP_INDEX_URL", f"{inspected.base}/simple")
    monkeypatch.setenv("PIP_CERT", str(tmp_path / "ca.pem"))
    assert_installed(install(UV, tmp_path), tmp_path)


@pytest.mark.parametrize("variable", ["REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "SSL_CERT_FILE", ""])
def test_certificates_are_the_same_for_both(variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever program they were set for; the system's where nothing is set."""
    (tmp_path / "ca.pem").write_text("")
    if not variable:
        monkeypatch.setattr(pip_settings, "_SYSTEM_CERTIFICATES", tmp_path / "ca.pem")
    made = pip_settings.variables({variable: str(tmp_path / "ca.pem")} if variable else {}, {})
    assert (made["PIP_CERT"], made["SSL_CERT_FILE"]) == (str(tmp_path / "ca.pem"),) * 2


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode != 0
    (line,) = done.stderr.splitlines()
    assert "PIP_INDEX_URL=" in line
    assert "https_proxy=" in line
    return line


def test_certificate_that_nobody_knows(inspected: FaultServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_INDEX_URL", f"{inspected.base}/simple")
    assert "certificate" in one_line(install(UV, tmp_path)).partition(";")[0]


@both
def test_index_that_cannot_be_reached(
    program: list[str], index: FaultServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen to end in a resolver's own words."""
    monkeypatch.setenv("PIP_INDEX_URL", "http://user:secret@127.0.0.1:1/simple")
    line = one_line(install(program, tmp_path))
    assert line.startswith("error: Python packages from 127.0.0.1: ")
    assert "refused" in line
    assert "secret" not in line


@both
def test_captive_portal(
    program: list[str], index: FaultServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index.fault = lambda path, number: Answer(200, PAGE, "text/html")
    monkeypatch.setenv("PIP_INDEX_URL", f"{index.base}/simple")
    assert "captive portal" in one_line(install(program, tmp_path))


def test_what_is_set_for_uv_stays() -> None:
    made = pip_settings.variables({"UV_DEFAULT_INDEX": "mine", "PATH": "x"}, {"index-url": "pips", "timeout": "7"})
    assert (made["UV_DEFAULT_INDEX"], made["UV_HTTP_TIMEOUT"], made["PATH"]) == ("mine", "7", "x")
    assert "PIP_DEFAULT_TIMEOUT" not in made


def test_configuration_that_pip_cannot_read(tmp_path: Path) -> None:
    (tmp_path / "pip.conf").write_text("nonsense")
    done = install(PIP, tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("error: pip cannot read its configuration: ")

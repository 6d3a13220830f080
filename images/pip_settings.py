"""Run pip or uv by the settings of pip: the package index, the proxy and the certificates of this computer.

uv reads neither pip's configuration nor, by itself, the system's certificates; pip reads the latter by itself in newer
versions alone. What is set for uv in the environment stays. This runs in a new environment, before any package of the
project's is there.

Usage: python pip_settings.py PROGRAM ARGUMENT...
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import urlsplit

_OF_UV = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "trusted-host": "UV_INSECURE_HOST",
    "proxy": "ALL_PROXY",
    "cert": "SSL_CERT_FILE",
    "client-cert": "SSL_CLIENT_CERT",
    "timeout": "UV_HTTP_TIMEOUT",
}
"""Variables of uv, by the option of pip that means the same."""
_SEPARATORS = {"UV_FIND_LINKS": ","}
"""Between several values; a blank elsewhere."""
_SECTIONS = ("global", "install", ":env:")
"""Of pip's configuration, the strongest last."""
_SYSTEM_CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")
_CERTIFICATES = ("REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "SSL_CERT_FILE")
"""Variables that name certificates. pip knows the first two, uv the last."""
_PATIENCE = {"retries": ("PIP_RETRIES", "2"), "timeout": ("PIP_DEFAULT_TIMEOUT", "10")}
"""Where nothing else is set: some 40 s behind a firewall that answers nothing; pip alone takes twice that or more."""
_REMEDY = (
    "check the network (a captive portal, a firewall?); another index is set by PIP_INDEX_URL= or in pip.conf, a proxy "
    "by https_proxy=, the certificate of a proxy that inspects TLS by PIP_CERT= or `sudo update-ca-certificates`"
)


def configured(environment: Mapping[str, str]) -> dict[str, str]:
    """pip's settings by the names of its options, from its files and its variables."""
    argv = [sys.executable, "-m", "pip", "config", "list"]
    done = subprocess.run(argv, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"error: pip cannot read its configuration: {done.stderr.strip().splitlines()[-1]}")
    listed = re.findall(r"^(\S+?)\.(?:default-)?(\S+?)=(.*)$", done.stdout, re.MULTILINE)
    found: dict[str, str] = {}
    for section in _SECTIONS:
        found |= {option: str(ast.literal_eval(value)) for of, option, value in listed if of == section}
    return found


def variables(environment: Mapping[str, str], settings: Mapping[str, str]) -> dict[str, str]:
    """The environment in which pip and uv do as pip's settings say."""
    certificates = [settings.get("cert"), *map(environment.get, _CERTIFICATES), str(_SYSTEM_CERTIFICATES)]
    certificate = next((each for each in certificates if each and Path(each).is_file()), None)
    found = {"UV_SYSTEM_CERTS": "1", "UV_INDEX_STRATEGY": "unsafe-best-match"}  # as pip; hashes decide what is taken
    found |= {"PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    found |= dict(variable for option, variable in _PATIENCE.items() if option not in settings)
    if certificate:
        found |= {"PIP_CERT": certificate, "SSL_CERT_FILE": certificate}
    for option, variable in _OF_UV.items():
        if option in settings and variable != "SSL_CERT_FILE":
            values = settings[option].split()
            if option == "find-links":  # uv fails where one is missing, pip does not
                values = [each for each in values if "://" in each or Path(each).exists()]
            found[variable] = _SEPARATORS.get(variable, " ").join(values)
    of_user = {name: value for name, value in environment.items() if name.startswith("UV_") or name not in found}
    return {name: value for name, value in (found | of_user).items() if value}


def reason(output: str) -> str:
    """What kept pip or uv from an index, in its own words."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    causes = [line for line in lines if line.startswith("cause: ")][-1:]  # uv's last one is the first cause
    broken = [
        re.sub(r".*(0x\w+>[:,] '?|broken by ')|'?\)*'?: /\S*$", "", line) for line in lines if "broken by '" in line
    ]
    errors = [line for line in lines if line.startswith(("ERROR: ", "error: "))]
    return re.sub(r"^(ERROR|error|cause): ", "", next(iter(causes + broken + errors + lines), "no reason given"))


def main(argv: Sequence[str]) -> int:
    settings = configured(os.environ)
    environment = variables(os.environ, settings)
    done = subprocess.run(argv, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if os.environ.get("V", "0") not in ("", "0") or not done.returncode:
        sys.stderr.write(done.stdout)
    if done.returncode:
        parts = urlsplit(settings.get("index-url", ""))
        host = parts.hostname or "the Python package index"
        sys.stderr.write(f"error: Python packages from {host}: {reason(done.stdout)}; {_REMEDY}; V=1 shows all\n")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

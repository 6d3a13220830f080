"""Private keys of a fleet, and the commands that read each: the one declaration of that.

Commands that are not named read no private key. tests/runtime/test_key_access.py compares the declaration with the
files that commands read.
"""

from __future__ import annotations

from dataclasses import dataclass

_CARDS = ("image", "provision", "verify")
"""Commands that render robots' files."""


@dataclass(frozen=True)
class PrivateKey:
    """A file in `paths.KEYS`."""

    name: str
    """Of the file; `robotN_ed25519` for each robot, `NAME_ed25519` for each name in `releases: keys:`."""
    use: str
    commands: tuple[str, ...]
    """These read it, besides `backup-keys` and `restore-keys`, which read all."""
    in_agent: bool = False
    """Whether an ssh-agent may have it instead, and with it a hardware token or another computer."""


PRIVATE_KEYS = (
    PrivateKey(
        "operator_authority", "signs certificates that let people into all robots", ("admit-operator",), in_agent=True
    ),
    PrivateKey("NAME_ed25519", "signs releases", ("bundle", "power-cuts"), in_agent=True),
    PrivateKey(
        "operator_ed25519", "logs in to all robots; signs acceptance reports",
        ("accept", "deploy", "fetch", "fleet", "hwcheck", "param", "provision", "releases", "rotate-key", "scope",
         "ssh", "station", "top"),
        in_agent=True,
    ),
    PrivateKey(
        "fleet_secret", "derives the keys of all messages, and of time",
        (*_CARDS, "drive", "live", "positions", "record", "station", "station-time", "top"),
    ),
    PrivateKey("robotN_ed25519", "authenticates a robot to SSH", _CARDS),
    PrivateKey("dds_authority", "with `dds_security`: signs permissions of DDS messages", _CARDS),
)  # fmt: skip

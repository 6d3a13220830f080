"""The keys that releases are signed by: as a release carries them for the robots that run it.

A signature is one of SSH's (`ssh-keygen -Y sign`, PROTOCOL.sshsig of OpenSSH), so a key may be in a file, in an agent
or on a hardware token.
"""

from __future__ import annotations

import json
import re

from flotilla.common.errors import UserError
from flotilla.fleet import keys as fleet_keys
from flotilla.fleet.model import Releases

NAMESPACE = "flotilla-release"
"""What signatures are for (`ssh-keygen -Y sign -n`): one for anything else is none of a release."""
_KEY = re.compile(r"((?:sk-)?ssh-\S+|(?:sk-)?ecdsa-\S+) ([A-Za-z0-9+/=]+) (\S+)")


def document(releases: Releases) -> bytes:
    """What the slot of a release holds: JSON with `signatures`, and `keys` of `name` and `key` each.

    A multiple of 512 bytes, filled up with spaces. Keys that are named and not there are made.
    """
    keys = []
    for each in releases.keys:
        if given := _KEY.fullmatch(each):
            keys.append({"name": given[3], "key": f"{given[1]} {given[2]}"})
        elif re.fullmatch(r"[a-z0-9][a-z0-9-]*", each):
            keys.append({"name": each, "key": fleet_keys.public(fleet_keys.make(f"{each}_ed25519", each))})
        else:
            raise UserError(
                f"group_vars/all.yml: releases: keys: {each!r} is neither the name of a key, of small letters, digits "
                "and hyphens, nor a public SSH key with a name behind it"
            )
    names = [key["name"] for key in keys]
    if len(set(names)) < len(names) or len({key["key"] for key in keys}) < len(keys):
        raise UserError(
            f"group_vars/all.yml: releases: keys: {', '.join(names)}: one is there twice; it would sign for two"
        )
    text = json.dumps({"signatures": releases.signatures, "keys": keys}, sort_keys=True).encode()
    return text.ljust(-(-len(text) // 512) * 512)

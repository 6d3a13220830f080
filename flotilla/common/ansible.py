"""What Ansible's programs are started with: this project's configuration, and nothing of the user's."""

from __future__ import annotations

import os

from flotilla.common import paths

CONFIGURATION = paths.PROJECT / "ansible" / "ansible.cfg"


def environment() -> dict[str, str]:
    """Without the user's `ANSIBLE_*`, and in a language whose characters Ansible takes.

    The configuration is named: from a directory that others may write to, Ansible reads none.
    """
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("ANSIBLE_")}
    return inherited | {"ANSIBLE_CONFIG": str(CONFIGURATION), "LC_ALL": "C.UTF-8"}

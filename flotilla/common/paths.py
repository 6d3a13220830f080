"""Where things lie. Every other module asks here; `FLEET`, `BUILD`, `KEYS`, `APPS` and `INVENTORY` come from the
environment.

A fleet has a home: a directory that its owner keeps in a repository of its own. `FLEET` names it. Without `FLEET` it is
this checkout, with the example fleet; a tool that was installed as a package has no such fleet, and takes the current
directory.

| in a home | in the checkout |
|---|---|
| `inventory/`, `control_tasks/` | `ansible/inventory/`, `ansible/control_tasks/` |
| `apps/`, `build/` | `apps/`, `build/` |
| `keys/` | `ansible/keys/` |
| `overlay/`, `packages/`, `locks/`, `kernel/` | `rootfs_overlay/`, `images/packages/`, `images/locks/`, `kernel/` |

The folders of the last row contain only files that differ: `flotilla.common.sources.find` takes all other files from
the checkout."""

from __future__ import annotations

import os
import unicodedata
from pathlib import Path

from flotilla.common.errors import UserError

PACKAGE = Path(__file__).resolve().parents[1]
"""The modules of this tool."""
IMPORTS = PACKAGE.parent
"""The directory from which Python imports them."""
INSTALLED = (PACKAGE / "tool").is_dir()
"""Whether the tool was installed as a package. Otherwise it runs from its checkout."""
PROJECT = PACKAGE / "tool" if INSTALLED else IMPORTS
"""The files of the tool that are no modules: those of its checkout; pyproject.toml has the list for a package."""
HOME = Path(os.environ.get("FLEET") or ("." if INSTALLED else PROJECT)).resolve()
"""The fleet's home."""
OWN_HOME = HOME != PROJECT
"""Whether the fleet lies outside of this tool."""
WORKPLACE = HOME if INSTALLED else PROJECT
"""The directory in which a user works: the checkout, or the home where the tool was installed."""
HOME_FILE = "fleet.yml"
"""The file that makes a directory a home; a home that is this checkout has none."""


def _place(variable: str, in_home: str, in_checkout: str) -> Path:
    """The path that the environment names, or else the usual place."""
    return Path(os.environ.get(variable) or HOME / (in_home if OWN_HOME else in_checkout)).resolve()


BUILD = _place("BUILD", "build", "build")
"""All outputs. Removing it loses nothing that cannot be made again."""
KEYS = _place("KEYS", "keys", "ansible/keys")
"""Private keys: made once, never in git, never removed by `make clean`."""

POOL = BUILD / "pool"
"""Debian packages by SHA-256, shared by all boards."""
CACHE = BUILD / "cache"
"""Results of build steps, named by the hash of what went into them."""
IMAGES = BUILD / "images"
"""Card images with what belongs to them."""
BUNDLES = BUILD / "bundles"
"""Update bundles, `BOARD.bundle`."""
OPERATORS = BUILD / "operators"
"""Certificates to hand out, a folder for each person."""
GUESTS = BUILD / "fleet" / "guests.yml"
"""Ansible's inventory of the virtual fleet, while it runs."""

INVENTORY = _place("INVENTORY", "inventory", "ansible/inventory")
"""The fleet's description, of every command that is about robots."""
BOARDS = PROJECT / "ansible" / "boards"
"""The boards that come with this tool, as an inventory without hosts."""
TASKS = HOME / "control_tasks" if OWN_HOME else PROJECT / "ansible" / "control_tasks"
"""Control tasks that the inventory gives to robots."""
MESSAGES = "messages.yml"
"""The file there that is no task: what tasks send each other and the stations."""
APPS = _place("APPS", "apps", "apps")
"""Apps of one's own, a directory each: those that the inventory names."""
OVERLAY = PROJECT / "rootfs_overlay"
PACKAGES = PROJECT / "images" / "packages"
LOCKS = PROJECT / "images" / "locks"
KERNELS = PROJECT / "kernel"
"""Kernels of our own: a file each, and `fragments/` that they are made of."""


UNFIT = " \t\n;&|<>()'\"`\\*?[]{}!$:%=#"
"""Characters that none of these paths may have, the same as in the Makefile: shells, make, lists of directories and
SSH's options read something else in them, and not all of these have a way to quote them."""


def check() -> None:
    """Refuse places where some program of a build or of a playbook would take another path than the one meant."""
    given = {"": PROJECT, "FLEET=": HOME, "BUILD=": BUILD, "KEYS=": KEYS, "APPS=": APPS, "INVENTORY=": INVENTORY}
    unfit = {name: path for name, path in given.items() if _unfit(path)}
    if "" in unfit:  # then all that is inside is, too
        unfit = {name: path for name, path in unfit.items() if not name or not path.is_relative_to(PROJECT)}
    if "FLEET=" in unfit:
        unfit = {name: path for name, path in unfit.items() if name in ("", "FLEET=") or not path.is_relative_to(HOME)}
    if unfit:
        raise UserError("\n".join(f"{name}{str(path)!a}: {_REMEDY[not name]}" for name, path in unfit.items()))


_REMEDY = [
    "is a path with blanks or with a character that means something to a shell; take another directory",
    "this checkout lies on a path with blanks or with a character that means something to a shell; move it",
]


def _unfit(path: Path) -> bool:
    return any(each in UNFIT for each in str(path)) or any(map(name_fault, path.parts))


def shown(path: Path) -> str:
    """The path as a message should show it: relative to `WORKPLACE` where it lies inside."""
    try:
        return str(path.relative_to(WORKPLACE))
    except ValueError:
        return str(path)


_CATEGORIES = {"Cc": "a control character", "Cs": "a byte that is no UTF-8", "Zl": "a line end", "Zp": "a line end"}
"""Unicode's general categories (UAX #44) of what no file's name on a robot may have."""


def name_fault(name: str, most: int = 255) -> str:
    """Why no file on a robot may have the name, empty where one may: names are lines of listings, in UTF-8."""
    if found := next((kind for each in name if (kind := _CATEGORIES.get(unicodedata.category(each)))), ""):
        return f"has {found} in its name; rename it"
    size = len(name.encode())
    return f"has a name of {size} bytes, more than {most}; give it a shorter one" if size > most else ""

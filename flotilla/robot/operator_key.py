"""The end of a rotation of the operator's key: the former one goes once every robot lets the new one in."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

from flotilla.common.errors import UserError
from flotilla.fleet import keys
from flotilla.fleet.model import Fleet, Robot
from flotilla.robot import ssh

_AT_ONCE = 32


def retire(fleet: Fleet, *, force: bool) -> None:
    """Remove the former key. UserError, and nothing is removed, where a robot does not let the new one in; `force`:
    such robots need a new card then."""
    if not keys.former_operator():
        raise UserError("there is no former operator's key to retire; `make rotate-key KEY=operator` makes a new one")
    keys.host_keys(fleet)  # with what pins them
    if not force and (problems := list(_refusals(fleet.robots.values()))):
        remedy = "bring the new key there by `make provision`; FORCE=1 gives up these robots until they get a new card"
        raise UserError("\n".join([*problems, f"the former operator's key is kept: {remedy}"]))
    keys.retire_operator_key()


def _refusals(robots: Iterable[Robot]) -> Iterable[str]:
    def refusal(robot: Robot) -> str | None:
        try:
            ssh.output(robot, ["true"], ssh.command(robot, former=False))
        except UserError as error:
            return str(error)
        return None

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        yield from filter(None, pool.map(refusal, robots))

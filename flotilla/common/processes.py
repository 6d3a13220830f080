"""Processes that this computer starts."""

from __future__ import annotations

DIE_WITH_PARENT = ["setpriv", "--pdeathsig", "KILL"]
"""Prefix of a command that must not outlive the thread that starts it, however that ends."""

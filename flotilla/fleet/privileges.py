"""What the service of a control task or an app may do beyond files: privileges for the devices that its blocks drive.

Services have none (runtime/systemd/), because who drives I/O ports can do whatever the computer can.
"""

from __future__ import annotations

_PORT_BLOCKS = ("ir104-pbf",)
"""Blocks that drive I/O ports (ioperm(2))."""
DROP_IN = "io-ports.conf"
"""Name of the file that has `IO_PORTS`, in the folder of a service's drop-ins."""
IO_PORTS = """\
# It drives I/O ports.
[Service]
AmbientCapabilities=CAP_SYS_RAWIO
CapabilityBoundingSet=CAP_SYS_RAWIO
SystemCallFilter=@raw-io
"""


def drives_io_ports(description: object) -> bool:
    """Whether a task, as parsed, has a block that does. What is no task in other ways is the runtime's to say."""
    blocks = description.get("blocks") if isinstance(description, dict) else None
    found = blocks.values() if isinstance(blocks, dict) else ()
    return any(isinstance(block, dict) and block.get("type") in _PORT_BLOCKS for block in found)

"""The QEMU test lab: guests, their consoles, networks and shells, behind protocols that real robots can serve too."""

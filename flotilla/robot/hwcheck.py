"""What a robot's hardware is and does, in one file to send with a bug report. It asks; it changes nothing."""

from __future__ import annotations

import re
import shlex

from flotilla.common import durable, paths, progress
from flotilla.common.processes import bounded
from flotilla.common.text import shown
from flotilla.fleet.model import Robot
from flotilla.robot import ssh

CHECKS = {
    "system": "cat /etc/hostname; uname -a; cat /proc/cmdline; uptime",
    "computer": "cd /sys/class/dmi/id && grep . sys_vendor product_name bios_vendor bios_version bios_date",
    "processor": "cat /proc/cpuinfo",
    "clock sources": "cd /sys/bus/clocksource/devices/clocksource0 && grep . available_clocksource current_clocksource",
    "memory": "cat /proc/meminfo",
    "interrupts": "cat /proc/interrupts",
    "I/O ports": "cat /proc/ioports",
    "PCI devices": "cat /proc/bus/pci/devices",
    "serial ports": "ls -l /dev/robot; cat /proc/tty/driver/serial",
    "disks": "lsblk -o NAME,SIZE,MODEL,FSTYPE,MOUNTPOINTS",
    "network": "ip -s address",
    "failed units": "systemctl --failed --no-pager",
    "kernel messages": "dmesg",
    "hardware latency": "hwlatdetect --duration={seconds} --threshold=10",
}
"""What to ask, as shell commands for root. The last one looks for moments when the BIOS takes the processor away (SMI):
no kernel can do anything about those. It stops everything else half of the time, and fails when it finds one."""
_MARK = "=== flotilla hwcheck:"
_FLAGS = {
    "pae": "Debian's RT kernel for i386 needs it; `kernel: lean` does not",
    "cmov": "Debian's i386 programs need it",
    "nopl": "some programs for i686 use it",
    "tsc": "without it, time comes from a slow clock",
    "apic": "without it, timers are as coarse as the 8254",
    "constant_tsc": "without it, the time stamp counter may change its rate",
}


def script(seconds: int) -> str:
    """All checks; each says its name, then its status."""
    lines = []
    for name, command in CHECKS.items():
        run = shlex.join(["sh", "-c", command.format(seconds=seconds)])
        lines += [f"echo '{_MARK} {name}'", f"{run} 2>&1", f"echo '{_MARK} status' $?"]
    return "\n".join(lines) + "\n"


def parse(output: str) -> dict[str, tuple[int, str]]:
    """Status and text of each check."""
    pattern = rf"^{_MARK} (?!status)(.+)\n((?:.*\n)*?){_MARK} status (\d+)$"
    return {name: (int(status), text) for name, text, status in re.findall(pattern, output, re.MULTILINE)}


def summary(found: dict[str, tuple[int, str]]) -> str:
    """What matters most for hard real time, a line each."""
    _, processor = found["processor"]
    match = re.search(r"^flags\s*: (.*)$", processor, re.MULTILINE)
    flags = match[1].split() if match else []
    lines = [f"{flag}: {'yes' if flag in flags else f'no ({meaning})'}" for flag, meaning in _FLAGS.items()]
    status, latency = found["hardware latency"]
    largest = re.search(r"Max Latency: (.*)", latency)
    lines.append(f"hardware latency: {largest[1] if largest else f'not measured (status {status})'}")
    uarts = re.findall(r"^(\d+): uart:(\S+) (.*)$", found["serial ports"][1], re.MULTILINE)
    lines += [f"ttyS{number}: {kind} {where}" for number, kind, where in uarts if kind != "unknown"]
    return "\n".join(lines)


def check(robot: Robot, seconds: int) -> str:
    """Ask the robot, or its guest when one runs; the summary, and where all of it is."""
    with progress.step(f"hardware of {robot.name}, {seconds} s for its latency"):
        done = bounded([*ssh.command(robot), "sudo", "sh"], script(seconds).encode())
    found = parse(done.stdout)
    if done.returncode or found.keys() != CHECKS.keys():
        raise ssh.no_answer(robot, done.stderr.strip() or "it ended in between")
    file = paths.BUILD / "reports" / f"hwcheck-{robot.name}.txt"
    file.parent.mkdir(parents=True, exist_ok=True)
    text = shown(summary(found))
    sections = [
        f"== {name}{f' (status {status})' if status else ''}\n{output}" for name, (status, output) in found.items()
    ]
    durable.write(file, "\n".join([f"== summary\n{text}\n", *sections]))
    return f"{text}\n{paths.shown(file)}: send it with your report"

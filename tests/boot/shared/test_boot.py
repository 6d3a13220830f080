"""Up through the real boot loader, with nothing to complain about."""

from __future__ import annotations

import re
import shlex

from flotilla.fleet.model import Board
from flotilla.images import card
from flotilla.images.manifest import Manifest
from tests.boot.guests import SECONDS, boot_state, label, nothing_failed, sh, tries
from tests.boot.shared.conftest import Report
from tests.conftest import RobotGuest

MEMORY_LIMIT_MB = {"i386": 40, "amd64": 70}
"""In use after boot: MemTotal - MemAvailable, in 10^6 bytes. 64-bit programs and a larger kernel take more."""
PROCESSOR = {"pentium3": "Pentium III"}
"""What QEMU's processors call themselves, where that is not their name in QEMU."""
HARMLESS = {
    r"Module iTCO_wdt is blacklisted": "by the board x86_64: QEMU's computer has two watchdogs",
    r"irqpoll boot option not supported with PREEMPT_RT": "the board asks for it; only a kernel without RT obeys",
    r"ACPI: setting ELCR to [0-9a-f]{4} \(from [0-9a-f]{4}\)": "by acpi=noirq: ACPI's own interrupt becomes a level",
    r"tsc: Unable to calibrate against PIT": "QEMU's timers on a busy host",
    r"MP-BIOS bug: 8254 timer not connected to IO-APIC": "QEMU's timers on a busy host",
    r"tsc: PIT calibration deviates from (PMTIMER|HPET)": "QEMU's timers on a busy host",
    r"clocksource: Long readout interval, skipping watchdog check": "QEMU's timers on a busy host",
    r"tsc: Fast TSC calibration failed": "QEMU's timers on a busy host",
    r"clocksource: .*'(tsc|tsc-early|refined-jiffies|acpi_pm|hpet)'": "QEMU's timers on a busy host",
    r"TSC found unstable after boot": "QEMU's timers on a busy host",
    r"Unstable clock detected, switching default tracing clock": "QEMU's timers on a busy host",
    r"^ *(If you want to keep using the local clock, then add:|\"trace_clock=local\"|on the kernel command line)$": (
        "its next lines"
    ),
    r"hrtimer: interrupt took \d+ ns": "QEMU's timers on a busy host; how late timers are is judged in virtual time",
    r"APIC calibration not consistent with PM-Timer": "QEMU's timers on a busy host",
    r"acpi resource window .* ignored, not CPU addressable": "QEMU's i440FX offers addresses beyond 32 bits",
    r"Model 'QEMU HARDDISK'.* applying quirks: bridgeok": "QEMU's disk has an old revision number",
    r"Kernel compiled without mitigations": "our 32-bit kernel has none; the board would switch them off",
    r"L1TF: Kernel not compiled for PAE": "of later processors than such boards have",
    r"fail to add MMCONFIG information": "QEMU's i440FX has no extended PCI configuration",
    r"ata\d.*: LPM support broken, forcing max_power": "QEMU's disk saves no power",
    r"mtrr: your CPUs had inconsistent": "UEFI in QEMU sets those of the first processor only",
    r"GPT: ?(Primary|\d|Alternate|Use GNU)": "a new card, which is larger than its image: flotilla-grow corrects it",
    r"Firmware left e100 interrupts enabled; disabling": "QEMU's BIOS leaves the wired port so",
}
"""Kernel messages of level warning and above that mean nothing, with the reason."""


def test_boots_the_card_through_grub(robot: RobotGuest, board: Board) -> None:
    argv = shlex.split((robot.machine.directory / "qemu.command").read_text())
    assert "-kernel" not in argv, "QEMU loaded the kernel past the boot loader"
    assert argv[argv.index("-cpu") + 1] == board.qemu.cpu
    assert re.search(rf"^{robot.robot.name} login: ", robot.machine.console.text, re.MULTILINE)
    model = sh(robot, "grep -m1 'model name' /proc/cpuinfo")
    assert PROCESSOR.get(board.qemu.cpu, board.qemu.cpu) in model, f"the processor is {model}"


def test_kernel_command_line(robot: RobotGuest, board: Board) -> None:
    words = sh(robot, "cat /proc/cmdline").split()
    slot = card.SLOTS[0]
    described = Manifest.model_validate_json(robot.image.with_suffix(".manifest.json").read_bytes())
    (uuid,) = (each.partuuid for each in described.partitions if each.name == slot.name)
    expected = [f"root=PARTUUID={uuid}", *card.kernel_arguments(board), f"flotilla.slot={slot.name}"]
    table = {"bios": "msdos", "uefi": "gpt"}[board.firmware]
    assert words[0].startswith(f"BOOT_IMAGE=(hd0,{table}{slot.number})")
    assert words[1:] == expected


def test_a_break_on_the_console_is_no_command(robot: RobotGuest) -> None:
    """Seen to fail: BREAK and `b` restarted the robot."""
    before = sh(robot, "cat /proc/sys/kernel/random/boot_id")
    robot.machine.execute("chardev-send-break", id="console")
    robot.machine.console.send("bbb-no-login")
    robot.machine.console.expect("bb-no-login", SECONDS)
    assert sh(robot, "cat /proc/sys/kernel/random/boot_id") == before


def test_kernel_is_real_time(robot: RobotGuest) -> None:
    """Each robot has the kernel that it should have."""
    version, release = sh(robot, "uname -v"), sh(robot, "uname -r")
    assert ("-flotilla-rt" in release) == (robot.board.kernel == "lean"), f"the kernel is {release}"
    assert "PREEMPT_RT" in version, f"the kernel is {version}"


def test_scheduler_keeps_no_task_that_sleeps(robot: RobotGuest) -> None:
    """It would take them out later, all at once with interrupts off. Seen to fail without preinit's: DELAY_DEQUEUE."""
    assert sh(robot, "findmnt /sys/kernel/debug", check=False) == "", "it stays mounted"
    mounted = "mount -t debugfs debug /sys/kernel/debug; {}; umount /sys/kernel/debug"
    features = sh(robot, mounted.format("cat /sys/kernel/debug/sched/features")).split()
    assert "NEXT_BUDDY" in features or "NO_NEXT_BUDDY" in features, features
    assert "DELAY_DEQUEUE" not in features
    release = tuple(map(int, re.findall(r"\d+", sh(robot, "uname -r"))[:2]))
    assert ("NO_DELAY_DEQUEUE" in features) == (release >= (6, 12)), "Debian's kernel, 6.1, has no such feature"


def test_slot_is_marked_good(robot: RobotGuest) -> None:
    state = boot_state(robot)
    assert (state["running"], state["trial"], tries(robot)) == ("A", None, [0, 0])
    assert {name: (each["ok"], each["release"]) for name, each in state["slots"].items()} == {
        "A": (True, "1"),
        "B": (False, None),
    }
    assert "/boot" not in sh(robot, "cut -d ' ' -f 2 /proc/mounts").split(), "/boot stays mounted"
    # GRUB counts the try before the kernel starts, so a system that does not confirm would show 1 here.
    assert "flotilla-mark-good.service" in sh(robot, "systemctl list-units --state=active flotilla-*")


def test_nothing_failed(robot: RobotGuest) -> None:
    nothing_failed(robot)


def test_kernel_has_nothing_to_complain_about(robot: RobotGuest) -> None:
    lines = sh(robot, "dmesg --level emerg,alert,crit,err,warn").splitlines()
    assert not (found := _alarming(lines)), "\n".join(found)
    sh(robot, "echo '<4>a test: trouble' >/dev/kmsg")
    lines = sh(robot, "dmesg --level emerg,alert,crit,err,warn").splitlines()
    assert len(_alarming(lines)) == 1, f"a warning was not seen in {lines}"


def test_ports_that_appear_disturb_no_others(robot: RobotGuest) -> None:
    """While a port of the first serial board is open, the second is looked for again, on the same interrupt.

    Debian's kernel loses the interrupt by that, but has looked for all boards before any port is open. Seen to fail
    there: "irq 11: nobody cared".
    """
    if robot.board.kernel != "lean" or robot.board.ports.keys().isdisjoint({"COM9"}):
        return
    first, second = (robot.board.ports[name].tty for name in ("COM5", "COM9"))
    assert sh(robot, f"cat /sys/class/tty/{first}/irq") == sh(robot, f"cat /sys/class/tty/{second}/irq")
    shown = sh(
        robot,
        f"""
        set -e
        warnings() {{ dmesg --level emerg,alert,crit,err,warn; }}
        before=$(warnings | wc -l)
        exec 3<>/dev/{first}
        board=$(readlink -f /sys/class/tty/{second}/device | grep -oE '0000:[0-9a-f]+:[0-9a-f]+[.][0-7]' | tail -1)
        echo "$board" >/sys/bus/pci/drivers/serial/unbind
        [ "$(cat /sys/class/tty/{second}/type 2>/dev/null || echo 0)" = 0 ]
        echo "$board" >/sys/bus/pci/drivers/serial/bind
        cat /sys/class/tty/{second}/type
        warnings | tail -n "+$((before + 1))"
        """,
    ).splitlines()
    assert shown[0] == "4", f"{second} is no 16550A any more"
    assert not (found := _alarming(shown[1:])), "\n".join(found)


def _alarming(lines: list[str]) -> list[str]:
    return [line for line in lines if not any(re.search(pattern, line) for pattern in HARMLESS)]


def test_memory_after_boot(robot: RobotGuest, report: Report) -> None:
    shown = sh(robot, "cat /proc/meminfo")
    kib = {name: int(value) for name, value in re.findall(r"^(\w+): +(\d+) kB", shown, re.MULTILINE)}
    used = (kib["MemTotal"] - kib["MemAvailable"]) * 1024 / 1e6
    report.add(label(robot), memory_used_mb=used)
    limit = MEMORY_LIMIT_MB[robot.board.architecture]
    processes = sh(robot, "ps -e -o rss=,comm= --sort=-rss | head")
    assert used <= limit, f"{used:.1f} MB in use (MemTotal - MemAvailable), {limit} allowed; largest:\n{processes}"

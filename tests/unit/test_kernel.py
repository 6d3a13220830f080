"""Kernel configuration: what a fragment may say, and that nothing asked for is dropped silently.

Seen to fail: each message by leaving out the check it comes from.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.common.errors import ProblemsError, UserError
from flotilla.debian import kernel, kernel_stage
from flotilla.debian.kernel import Option
from flotilla.debian.lock import read_lock

KCONFIG = """\
config PREEMPT_RT
\tbool "Fully Preemptible Kernel (Real-Time)"
\tdepends on EXPERT && ARCH_SUPPORTS_RT

menuconfig SERIAL_8250
\ttristate "8250/16550"

config E100
\ttristate "Intel(R) PRO/100+ support"
\tdepends on PCI
\tselect MII
"""


def option(name: str, value: str = "y", place: str = "kernel/fragments/a.config:1") -> Option:
    return Option(name, value, "because", place)


@pytest.fixture
def fragment(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "some.config"
        path.write_text(text)
        return path

    return write


def test_fragment(fragment: Callable[[str], Path]) -> None:
    path = fragment('# About.\n\nCONFIG_A=y # needed\nCONFIG_B="x # y" # named\nCONFIG_C=16 # many\n')
    found = [(each.name, each.value, each.reason) for each in kernel.read_fragment(path)]
    assert found == [("A", "y", "needed"), ("B", '"x # y"', "named"), ("C", "16", "many")]


def test_every_malformed_line_is_reported(fragment: Callable[[str], Path]) -> None:
    path = fragment("CONFIG_A=y\nCONFIG_B=y # good\nB=y # no prefix\n")
    with pytest.raises(ProblemsError) as caught:
        kernel.read_fragment(path)
    assert [problem.file for problem in caught.value.problems] == [f"{path}:1", f"{path}:3"]
    assert "write `CONFIG_NAME=value # reason`" in str(caught.value)


def test_missing_fragment_names_those_that_exist(fragment: Callable[[str], Path]) -> None:
    path = fragment("")
    with pytest.raises(UserError, match=r"other\.config: no such fragment; there are some"):
        kernel.read_fragment(path.with_name("other.config"))


PATCH = """\
About it.

diff --git a/drivers/tty.c b/drivers/tty.c
--- a/drivers/tty.c
+++ b/drivers/tty.c
@@ -1,3 +1,3 @@
 one
-two
+second
 three
"""


def test_a_patch_is_applied_exactly_or_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Inside a repository, too, where a build lies. Seen to fail without the ceiling: git then changes nothing."""
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    source, patch = tmp_path / "build" / "source", tmp_path / "some.patch"
    (source / "drivers").mkdir(parents=True)
    patch.write_text(PATCH)
    (source / "drivers" / "tty.c").write_text("one\ntwo\nthree\n")
    kernel_stage.apply([str(patch)], source, "linux 6")
    assert (source / "drivers" / "tty.c").read_text() == "one\nsecond\nthree\n"
    with pytest.raises(SystemExit, match=r"some\.patch: does not apply to linux 6; bring it up to date"):
        kernel_stage.apply([str(patch)], source, "linux 6")
    assert "drivers/tty.c" in capfd.readouterr().err


def test_a_patch_decides_what_a_kernel_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(paths.KERNELS, tmp_path / "kernel")
    monkeypatch.setattr(paths, "KERNELS", tmp_path / "kernel")
    patch, *_ = kernel.patches("smartcoret3")
    key = kernel.key("smartcoret3")
    assert kernel.key("smartcoret3-no-rt") != key
    patch.write_text(patch.read_text() + "\n")
    assert kernel.key("smartcoret3") != key
    patch.rename(patch.with_name("other.patch"))
    with pytest.raises(UserError, match=r"tty-flip-realtime\.patch: no such patch; there are other, "):
        kernel.patches("smartcoret3")


def test_contradiction_names_both_places() -> None:
    first, second = option("SMP", "y"), option("SMP", "n", "kernel/fragments/b.config:7")
    with pytest.raises(ProblemsError) as caught:
        kernel.merge([first, second])
    assert str(caught.value) == (
        "kernel/fragments/b.config:7: CONFIG_SMP: n: contradicts kernel/fragments/a.config:1, which has y; "
        "keep one of them"
    )


def test_same_option_twice_is_no_contradiction() -> None:
    assert kernel.merge([option("SMP"), option("SMP", place="kernel/fragments/b.config:7")]) == {"SMP": option("SMP")}


def test_request() -> None:
    options = [option("SMP", "n"), option("NR", "16")]
    assert kernel.request(options) == "CONFIG_NR=16\n# CONFIG_SMP is not set\n"


def test_final_configuration_as_asked() -> None:
    config = "CONFIG_SERIAL_8250=y\nCONFIG_E100=m\n# CONFIG_PREEMPT_RT is not set\n"
    options = [option("SERIAL_8250"), option("E100", "m"), option("PREEMPT_RT", "n"), option("ABSENT", "n")]
    assert kernel.compare(options, config, KCONFIG) == []


def test_misspelt_option() -> None:
    (problem,) = kernel.compare([option("PREEMPT_TR")], "", KCONFIG)
    assert str(problem) == (
        "kernel/fragments/a.config:1: CONFIG_PREEMPT_TR: y: is no option of this kernel; "
        "perhaps CONFIG_PREEMPT_RT is meant"
    )


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("PREEMPT_RT", "", "is changed by kconfig to n; it depends on EXPERT && ARCH_SUPPORTS_RT"),
        ("E100", "CONFIG_E100=m\n", "is changed by kconfig to m; it depends on PCI"),
        ("SERIAL_8250", "", "is changed by kconfig to n; another option selects or forbids it"),
    ],
)
def test_refused_option(name: str, config: str, message: str) -> None:
    (problem,) = kernel.compare([option(name)], config, KCONFIG)
    assert message in str(problem)


def test_missing_source() -> None:
    packages = [package for package in read_lock("toolchain").packages if not package.name.startswith("linux-source")]
    with pytest.raises(UserError, match=r"no package linux-source-….*make lock"):
        kernel.source(packages)


def test_unknown_kernel() -> None:
    with pytest.raises(
        UserError, match=r"kernel/smartcore\.yml: there is no such kernel; there are geode-lx, smartcoret3, "
    ):
        kernel.wanted("smartcore")


@pytest.mark.parametrize("name", kernel.names())
def test_fragments_of_every_kernel_agree(name: str) -> None:
    options = kernel.wanted(name)
    assert options["SQUASHFS"].value == "y", "a boot without initramfs mounts its root by itself"

"""The measurement of other update engines: whose memory it counts. The rest of it needs root and the archive."""

from __future__ import annotations

from pathlib import Path

from evidence.engines import Memory


def test_only_processes_of_the_tree_count(tmp_path: Path) -> None:
    """Seen to fail where every process counts, and where none does."""
    nobody = Memory(tmp_path)
    assert (nobody.look(), nobody.peak, nobody.programs) == (0, 0, {})

    lines = Path("/proc/self/status").read_text().splitlines()
    (resident,) = (int(line.split()[1]) for line in lines if line.startswith("RssAnon:"))
    everybody = Memory(Path("/proc/self/root").readlink())
    assert everybody.look() == everybody.peak > resident
    assert everybody.anonymous >= resident * 0.9  # some may be freed in between
    assert Path("/proc/self/exe").readlink().name in everybody.programs


def test_the_peak_stays(tmp_path: Path) -> None:
    """Seen to fail where the last look counts."""
    memory = Memory(Path("/proc/self/root").readlink())
    memory.look()
    peak = memory.peak
    memory._tree = str(tmp_path)
    assert memory.look() == 0
    assert memory.peak == peak

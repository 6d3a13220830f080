"""A page of recordings: paths, commands, hops and latency, and every other signal against time. `make report`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2
import numpy as np

from flotilla.common import durable, paths
from flotilla.common.errors import UserError
from flotilla.station import hops, mcap_reader, pictures, segments
from flotilla.station.recording import Array
from flotilla.station.topic import Topic


@dataclass(frozen=True)
class Account:
    """Of a topic's messages."""

    name: str
    count: int
    rate_hz: float
    longest_gap_s: float
    lost: int | None
    """Steps without a message, as far as the messages before and after tell; None: the steps are not numbered."""


@dataclass(frozen=True)
class Section:
    """What the page says of a topic, after what it says of robots."""

    name: str
    states: list[pictures.State]
    constants: dict[str, str]
    pictures: list[str]


def page_of(given: Sequence[Path]) -> Path:
    """Where the report of these files goes unless told otherwise."""
    stem = (
        re.sub(r"-\d+$", "", given[0].resolve().stem) if given[0].suffix == segments.SUFFIX else given[0].resolve().stem
    )
    return paths.BUILD / "reports" / f"{re.sub('[*?]', '', stem).strip('-') or 'recording'}.html"


def read(given: Sequence[Path]) -> tuple[list[Topic], list[str]]:
    """Topics of one MCAP file, or of files of recorders, and what is missing of them. UserError for what is neither."""
    files = segments.files(given)
    if len(files) == 1 and files[0].suffix != segments.SUFFIX:
        damage = mcap_reader.Damage()
        return mcap_reader.read(files[0], damage), damage.notes(files[0])
    if others := [file for file in files if file.suffix != segments.SUFFIX]:
        raise UserError(
            f"{paths.shown(others[0])}: is no file of a recorder, *{segments.SUFFIX}; name one MCAP file alone, or "
            "files of a recorder"
        )
    recorded = segments.find(files)
    return [each.whole() for each in recorded], [note for each in recorded for note in each.notes()]


def write(given: Sequence[Path], page: Path) -> Path:
    """The page of these recordings. UserError where one cannot be read, or the page not be written."""
    topics, notes = read(given)
    begin_ns = min(int(topic.times_ns.min()) for topic in topics)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), undefined=jinja2.StrictUndefined, autoescape=True,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    text = environment.get_template("report.html.j2").render(
        name=f"{given[0].name}{f' and {len(given) - 1} more' if len(given) > 1 else ''}",
        seconds=(max(int(topic.times_ns.max()) for topic in topics) - begin_ns) / 1e9,
        begin=np.datetime64(begin_ns, "ns").astype("datetime64[s]"),
        notes=notes,
        accounts=[account(topic) for topic in topics],
        hops={topic.name: found for topic in topics if (found := hops.hops(topic))},
        percentiles=hops.PERCENTILES,
        pictures=list(pictures.of_robots(topics, begin_ns)),
        sections=[_section(topic, begin_ns) for topic in topics if topic.signals],
    )
    try:
        page.parent.mkdir(parents=True, exist_ok=True)
        durable.write(page, text)
    except OSError as error:
        raise UserError(f"{paths.shown(page)}: {error.strerror}; name another file: OUT=") from error
    return page


def _section(topic: Topic, begin_ns: int) -> Section:
    return Section(
        topic.name,
        pictures.states(topic, (topic.times_ns - begin_ns) / 1e9),
        pictures.constants(topic),
        list(pictures.of_topic(topic, begin_ns)),
    )


def account(topic: Topic) -> Account:
    span_s = float(topic.times_ns[-1] - topic.times_ns[0]) / 1e9
    gaps = np.diff(topic.times_ns)
    return Account(
        topic.name,
        len(topic.times_ns),
        (len(topic.times_ns) - 1) / span_s if span_s else 0.0,
        float(gaps.max()) / 1e9 if len(gaps) else 0.0,
        None if topic.counter is None else _lost(topic.counter[topic.came]),
    )


def _lost(steps: Array) -> int:
    """A message comes each so many steps as most do. Where numbers start again, nothing is known to be lost."""
    ahead = np.diff(steps)
    ahead = ahead[ahead > 0]
    every = int(np.median(ahead)) if len(ahead) else 1
    return int((ahead // every - 1).sum())

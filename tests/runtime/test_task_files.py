"""Task files that are refused and those that are right, and plug-ins: nothing here has to keep step."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from flotilla.common import paths
from flotilla.fleet import identity, messages
from flotilla.fleet.inventory import load_fleet
from flotilla.lab.latency import virtual_loop
from flotilla.lab.scenarios import virtual
from flotilla.lab.wheeled.by_wires import INVENTORY as WHEELED
from tests.runtime.tasks import HEADERS, PLUGIN, Tasks, compile_shared, task

REFUSED = {
    "no YAML": ("period: [", "2: did not find expected node content"),
    "empty": ("", "the file is empty"),
    "no period": ("blocks:\n  a: {type: gain, in: {in: 1}}", "task: period is missing: the time between two steps"),
    "period 0": (
        task("a: {type: gain, in: {in: 1}}", "period: 0 ms"),
        "1: period: 0 ms is not a time such as 10 ms, from 50 us",
    ),
    "period without unit": (task("a: {type: gain, in: {in: 1}}", "period: 10"), "10 is not a time such as 10 ms"),
    "period twice": (
        task("a: {type: gain, in: {in: 1}}", "period: 1 ms\nperiod: 2 ms"),
        "2: task: period is given twice",
    ),
    "unknown key": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\nrate: 1"), "2: task: unknown key rate; known"),
    "phase": (
        task("a: {type: gain, in: {in: 1}}", "period: 1 ms\nphase: 1 ms"),
        "1: task: phase must be less than the period",
    ),
    "phase without unit": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\nphase: 0"), "2: phase: 0 is not a time"),
    "trigger": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\ntrigger: b"), "2: trigger: there is no block b"),
    "trigger that waits for nothing": (
        task("a: {type: gain, in: {in: 1}}", "period: 1 ms\ntrigger: a"),
        "2: trigger: block a is a gain, which cannot trigger a task; use a block that can, such as udp-receive",
    ),
    "trigger with a phase": (
        task("a: {type: udp-receive, parameters: {port: 9, length: 1}}", "period: 2 ms\nphase: 1 ms\ntrigger: a"),
        "3: trigger: a triggered task has no phase; remove one of the two",
    ),
    "trigger now and then": (
        task("a: {type: udp-receive, every: 2, parameters: {port: 9, length: 1}}", "period: 1 ms\ntrigger: a"),
        "4: block a: the trigger runs in every step",
    ),
    "priority": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\npriority: 99"), "2: priority: 99 is not a whole"),
    "priority 1": (
        task("a: {type: gain, in: {in: 1}}", "period: 1 ms\npriority: 1"),
        "priority: 1 leaves no priority for driver threads",
    ),
    "processor": (task("a: {type: gain, in: {in: 1}}", "period: 1 ms\ncpu: -1"), "2: cpu: -1 is not a whole number"),
    "policy": (
        task("a: {type: gain, in: {in: 1}}", "period: 1 ms\noverrun: ignore"),
        "2: overrun: ignore is not one of",
    ),
    "no blocks": ("period: 1 ms\nblocks: {}", "2: blocks: the task has none; give at least one"),
    "no type": (task("a: {in: {in: 1}}"), "3: block a: type is missing"),
    "unknown block": (task("a: {type: gian, in: {in: 1}}"), "3: block a: there is no block gian, the nearest is gain;"),
    "block's name": (task("a.b: {type: gain, in: {in: 1}}"), "3: block a.b: a name begins with a letter"),
    "every 0": (task("a: {type: gain, every: 0, in: {in: 1}}"), "3: every: 0 is not a whole number from 1"),
    "offset": (
        task("a: {type: gain, every: 2, offset: 2, in: {in: 1}}"),
        "3: block a: offset 2 must be less than every 2",
    ),
    "unknown parameter": (
        task("a: {type: gain, in: {in: 1}, parameters: {faktor: 2}}"),
        "3: block a: gain has no parameter faktor; it has",
    ),
    "value": (task("a: {type: gain, in: {in: 1}, parameters: {factor: two}}"), "parameter factor: two is not a number"),
    "list": (
        task("a: {type: gain, in: {in: 1}, parameters: {factor: [1]}}"),
        "the list beginning with 1 is not a number",
    ),
    "mapping": (task("a: {type: gain, in: {in: 1}, parameters: {factor: {b: 1}}}"), "factor is a mapping, not a value"),
    "missing parameter": (task("a: {type: trace}"), "3: block a: parameter device of trace is missing"),
    "relative device": (task("a: {type: trace, parameters: {device: gyro}}"), "gyro is not a device's path"),
    "choice": (task("a: {type: misbehave, parameters: {manner: sulk}}"), "sulk is not one of fail|hang|late|allocate"),
    "no wire": (task("a: {type: gain}"), "3: block a: input in has no wire: any signal"),
    "unknown input": (task("a: {type: gain, in: {in: 1, on: 2}}"), "3: block a: gain has no input on; it has in"),
    "unknown source": (
        task("a: {type: gain, in: {in: b.out}}"),
        "3: block a: input in: b.out: the task has no block b",
    ),
    "unknown output": (task("a: {type: gain, in: {in: a.aut}}"), "a.aut: gain has no output aut; it has out"),
    "no port": (task("a: {type: gain, in: {in: b}}"), "b is neither a wire (block.port) nor a number"),
    "element": (
        task("a: {type: gain, in: {in: 'b.out[1]'}}\nb: {type: gain, in: {in: 1}}"),
        "its elements are [0] to [0]",
    ),
    "wrong type": (
        task("a: {type: gain, in: {in: b.step}}\nb: {type: clock}"),
        "input in takes double[1], b.step is uint64[1]",
    ),
    "wrong width": (
        task("a: {type: gain, in: {in: b.out}}\nb: {type: constant, parameters: {value: [1, 2]}}"),
        "input in takes double[1], b.out is double[2]",
    ),
    "too many constants": (task("a: {type: gain, in: {in: [1, 2]}}"), "input in has 1 elements, not 2"),
    "cycle": (
        task("a: {type: gain, in: {in: b.out}}\nb: {type: gain, in: {in: a.out}}"),
        "3: cycle without delay: a → b → a; put a block delay into one of its wires",
    ),
    "cycle beside a delayed input": (
        task(
            "g: {type: gain, in: {in: i.out}}\n"
            "s: {type: schmitt-trigger, in: {in: i.out}, parameters: {on: 1, off: 0}}\n"
            "i: {type: integrator, in: {in: g.out, reset: s.on}}"
        ),
        "5: cycle without delay: i → s → i; put a block delay into one of its wires",
    ),
    "a frame twice": (
        task("a: {type: can-send, in: {data: 1, age: 0}, parameters: {id: 9, length: 1}}\n" * 2).replace("a:", "b:", 1),
        '4: block a: interface "can0", id 9, extended false is block b\'s; only one block may use a device',
    ),
    "a device twice": (
        task("a: {type: trace, parameters: {device: /dev/x}}\nb: {type: trace, parameters: {device: /dev/x}}"),
        '4: block b: device "/dev/x" is block a\'s; only one block may use a device',
    ),
    "a board twice": (
        task("a: {type: ir104-pbf}\nb: {type: ir104-pbf, parameters: {base: 0x300}}"),
        "4: block b: base 0x300 is block a's; only one block may use a device",
    ),
}


@pytest.mark.parametrize(("text", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_a_wrong_task_is_refused_with_file_line_and_remedy(tasks: Tasks, text: str, said: str) -> None:
    (line,) = tasks.refusal(text)
    assert said in line


def test_all_errors_at_once(tasks: Tasks) -> None:
    text = task("a: {type: gain}\nb: {type: gain, in: {in: x.y}, parameters: {factor: z}}", "period: 1 ms\npriority: x")
    assert len(tasks.refusal(text)) == 4


def test_a_plugin_of_another_interface_is_refused(tasks: Tasks, tmp_path: Path) -> None:
    compile_shared(PLUGIN / "misbehave.c", tmp_path / "old.so", f"-I{HEADERS}", "-DMISBEHAVE_ABI=999")
    older = Tasks(tasks.program, tmp_path, tmp_path)
    lines = older.refusal(task("a: {type: misbehave, parameters: {manner: fail}}"))
    assert "built for block interface 999, this runtime has 3; rebuild it" in lines[0]
    assert "there is no block misbehave" in lines[-1]


COUNTING = """#include <flotilla/block.h>

static const struct fl_port outputs[] = {{.name = "count", .flags = FL_REFUSALS, PORT}};

__attribute__((unused)) static int configure(struct fl_block *block)
{
    return fl_add_output(block, outputs[0]);
}

static int step(struct fl_block *block)
{
    (void)block;
    return FL_OK;
}

FL_BLOCK(counting) = {.abi = FL_ABI, .name = "counting", .step = step, OUTPUTS};
"""


@pytest.mark.parametrize("port", [".type = FL_UINT64, .width = 1", ".type = FL_UINT32, .width = 2"])
@pytest.mark.parametrize(
    ("outputs", "said"),
    [
        ("FL_TABLE(output, outputs)", "block counting: an output that counts refusals is not one uint32"),
        (".configure = configure", "block a: output count counts refusals and is not one uint32"),
    ],
)
def test_what_counts_refusals_is_one_uint32(tasks: Tasks, tmp_path: Path, port: str, outputs: str, said: str) -> None:
    """The status reads four bytes. Seen to fail without the check of the table, and without that of what is added."""

    def plugin(port: str) -> None:
        (tmp_path / "counting.c").write_text(COUNTING.replace("PORT", port).replace("OUTPUTS", outputs))
        compile_shared(tmp_path / "counting.c", tmp_path / "counting.so", f"-I{HEADERS}")

    own = Tasks(tasks.program, tmp_path, tmp_path)
    plugin(port)
    assert said in own.refusal(task("a: {type: counting}"))[0]
    plugin(".type = FL_UINT32, .width = 1")
    assert own.run(task("a: {type: counting}"), "--steps", "1").status == 0


def test_plugins_come_from_several_directories_where_one_may_be_missing(tasks: Tasks, tmp_path: Path) -> None:
    """Seen to fail when only the first directory is read."""
    own = tmp_path / "own"
    own.mkdir()
    compile_shared(virtual_loop.PLUGIN, own / "loopback.so", f"-I{HEADERS}")
    file = tasks.write(task("bad: {type: misbehave, parameters: {manner: fail}}"))
    for directories in (f"{own}:{tasks.plugins}", f"{tmp_path / 'missing'}:{tasks.plugins}:{own}"):
        argv = [str(tasks.program), "--check", "--blocks", directories, str(file)]
        done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stderr) == (0, "")


OWN_NAMES = """
#include <flotilla/block.h>
#include <stdio.h>
size_t parameter_size(int);
size_t parameter_size(int kind) { return 40 + (size_t)kind; }
double json_number(double);
double json_number(double value) { return value / 2; }
static const struct fl_port out = {"out", FL_DOUBLE, 1, 0, "", ""};
static int step(struct fl_block *block)
{
    FL_OUT(block, 0, double) = (double)parameter_size(2) + json_number(1);
    return FL_OK;
}
FL_BLOCK(named) = {.abi = FL_ABI, .name = "named", .summary = "", .source = "", .outputs = &out, .output_count = 1,
                   .step = step};
"""


def test_a_plugin_gets_its_own_functions(tasks: Tasks, tmp_path: Path) -> None:
    """Of names that are also those of private functions of the program."""
    (tmp_path / "named.c").write_text(OWN_NAMES)
    own = Tasks(tasks.program, tmp_path, tmp_path)
    compile_shared(tmp_path / "named.c", tmp_path / "named.so", f"-I{HEADERS}")
    assert [row["a.out"] for row in own.run(task("a: {type: named}"), "--steps", "1", "--watch", "a.out").rows] == [
        42.5
    ]


def test_the_graph_names_blocks_and_wires(tasks: Tasks) -> None:
    text = task("a: {type: gain, every: 2, in: {in: 1}}\nb: {type: gain, in: {in: a.out}}")
    drawn = subprocess.run(tasks.argv(text, "--dot"), capture_output=True, text=True, check=True).stdout
    assert '"a" -> "b" [label="out → in"]' in drawn
    assert "every 2" in drawn


def test_the_worked_example_is_a_block(tasks: Tasks, tmp_path: Path) -> None:
    """What docs/how-to/blocks.md shows compiles without a warning and does what it says."""
    source = tmp_path / "deadband.c"
    source.write_text((paths.PROJECT / "docs" / "how-to" / "blocks.md").read_text().split("```c\n")[1].split("```")[0])
    compile_shared(source, tmp_path / "deadband.so", f"-I{HEADERS}")
    made = Tasks(tasks.program, tmp_path, tmp_path)
    text = task(
        "small: {type: deadband, in: {in: 0.5}, parameters: {width: 1}}\n"
        "large: {type: deadband, in: {in: -1.5}, parameters: {width: 1}}"
    )
    ended = made.run(text, "--steps", "1", "--watch", "small.out,large.out")
    assert [(row["small.out"], row["large.out"]) for row in ended.rows] == [(0, -1.5)]


def test_the_example_tasks_are_right(tasks: Tasks) -> None:
    """As robots get them. Those that talk to others are of the scenarios' fleet, or of the wheeled robot."""
    alone = load_fleet()
    single = alone.robots[1].model_copy(update={"control_tasks": ["heading", "heartbeat"]})
    several = virtual.fleet("udp")
    wheeled = load_fleet(WHEELED)
    seen = set()
    fleets = [(fleet, robot) for fleet in (several, wheeled) for robot in fleet.robots.values()]
    for fleet, robot in [(alone, single), *fleets]:
        for name, content in identity.control_tasks(fleet, robot).items():
            argv = tasks.argv(content.decode(), "--check")
            done = subprocess.run(argv, capture_output=True, text=True, check=False)
            assert (done.returncode, done.stderr) == (0, ""), name
            seen.add(name)
    assert seen == set(messages.task_names())

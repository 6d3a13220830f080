"""How late a real-time thread wakes up, measured in QEMU's virtual time: `python -m flotilla.lab.latency`.

The board's own root and kernel run from memory in a machine whose clock counts instructions. Nothing outside reaches
the guest, so a run repeats to the byte, on a busy host as on an idle one, and any difference is a difference of the
software: `gate` compares the short plan exactly, `limits` judges the long one. What that says about hardware, and what
it does not, stands in the report.

| module | what |
|---|---|
| `scenarios` | what is measured, under what load: a table |
| `subject`, `machine` | the board's system packed for a run from memory; the machine that runs it |
| `measure`, `init`, `serial_latency.c` | what runs in the guest |
| `results`, `gate`, `limits`, `report` | figures and histograms; exact comparison with a baseline; limits; the page |
| `controls` | what the gate has to refuse |
| `virtual_loop`, `flood` | control loops in that machine; bursts of recorded messages at one of them |
"""

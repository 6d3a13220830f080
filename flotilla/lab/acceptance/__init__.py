"""One command that accepts a robot: what its computer is and does, beside what its board's file asks of it.

| file | what |
|---|---|
| `on_robot.py` | runs on the robot: asks, tries, measures; judges nothing |
| `facts.py` | asks a robot, by SSH |
| `relays.py` | switches relays while a person watches |
| `checks.py` | judges what it answered |
| `outcome.py` | what a robot was found to be: a signed file |
| `report.py` | the page, beside earlier ones of its board |
| `command.py` | `make accept` |
"""

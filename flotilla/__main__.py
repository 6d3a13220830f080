"""`python -m flotilla`: the command line where the command `flotilla` is not on the path."""

import sys

from flotilla.cli.main import main

sys.exit(main())

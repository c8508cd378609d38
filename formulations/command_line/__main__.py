"""``python -m formulations.command_line`` is ``ssp-lp``."""

import sys

from formulations.command_line import main

sys.exit(main())

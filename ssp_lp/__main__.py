"""``python -m ssp_lp`` is ``ssp-lp``."""

import sys

from ssp_lp.formulations.command_line import main

sys.exit(main())

"""Run the command line as ``python -m fpcal_bayes``."""

import sys

from fpcal_bayes.cli.main import main

sys.exit(main())

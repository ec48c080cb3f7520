"""``python -m ipjax`` is the ``ipjax`` command."""

import sys

from ipjax.cli import main

sys.exit(main())

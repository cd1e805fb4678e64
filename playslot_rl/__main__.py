"""`python -m playslot_rl` is `playslot`."""

from __future__ import annotations

import sys

from playslot_rl.cli import main

if __name__ == "__main__":
    sys.exit(main())

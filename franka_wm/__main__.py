"""``python -m franka_wm VERB …``: the same as ``franka-wm VERB …``."""

from franka_wm.commands.main import main

raise SystemExit(main())

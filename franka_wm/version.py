"""Version of the package: pyproject.toml and ``franka-wm --version`` read it here."""

__version__ = "0.1.0"

"""``python -m pgexcite``."""

from pgexcite.cli import main

main()

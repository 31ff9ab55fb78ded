"""A plugin that raises when it is imported."""

raise RuntimeError("its licence has run out")

"""Built-in models, one family to a folder and one model to a file; each registers through an entry point."""

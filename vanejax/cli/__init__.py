"""The commands of ``vanejax``: each adds its arguments to a parser, and runs."""

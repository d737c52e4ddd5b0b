"""The commands of ``vanejax``: each adds its arguments to a parser, and runs.

Heavy imports stand inside the functions that need them, so that ``vanejax --help`` is instant.
"""

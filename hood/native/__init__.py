"""C++ sources, and how they are compiled where the package runs.

Needs the standard library alone, but for :mod:`hood.native.features` and :mod:`hood.native.arguments`. Never knows what the
functions it compiles are for.
"""

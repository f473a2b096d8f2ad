"""What commands and the Python API do: settings become objects, objects become results.

Below the command line: what it has to say is returned or given to :mod:`hood.app.notices`.
"""

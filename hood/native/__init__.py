"""C++ parts of the library: their sources, and how they are compiled where they run."""

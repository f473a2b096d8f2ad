"""hood: learned clothing dynamics. One graph network dresses moving bodies (HOOD, CVPR 2023)."""

__version__ = "0.1.0"

"""The Newton solver in C++.

The same steps as in torch; where no compiler is found, torch takes over.
"""

"""The linear system of a Newton step: sparsity, assembly, conjugate gradients, line search.

Written in torch; :mod:`hood.solver.compiled` does the same in C++.
"""

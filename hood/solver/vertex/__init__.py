"""Steps of one vertex at a time: block Jacobi, coloured Gauss-Seidel, and conjugate gradients without a matrix.

They are the local corrections of networks.
"""

"""How good a method is: distance from the minimum, spectra, validation rollouts, the paper's Table 1.

It runs rollouts and compares them. It never trains.
"""

"""The incremental potential of implicit Euler, one energy a module, and the sum of them.

An energy gives a value, by torch also its gradient. Who minimises it is the solver's or the network's business.
"""

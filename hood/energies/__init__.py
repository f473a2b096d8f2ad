"""The incremental potential of implicit Euler, one energy a module, and the sum of them.

An energy returns a value, and torch its gradient. The laws of contact and friction, with slope and curvature, stand in
:mod:`~hood.energies.laws`, and in ``hood/native/laws.h`` for C++; gradients and curvatures for the solver are gathered in
:mod:`hood.solver.derivatives`.
Never minimises: that is the solver's or the network's part.
"""

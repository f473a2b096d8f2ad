"""The incremental potential of implicit Euler, one energy a module, and the sum of them.

An energy returns a value, and torch its gradient. The laws of contact and friction, with slope and curvature, stand in
:mod:`~hood.energies.laws`, and in ``hood/native/laws.h`` for C++, where those of membrane and bending are in
``hood/native/element_laws.h``; gradients and curvatures for the solver are gathered in :mod:`hood.solver.derivatives`.

========================================  =====================================================
:mod:`~hood.energies.mass_points`         inertia, gravity, springs between vertices
:mod:`~hood.energies.membrane`            stretching (St. Venant-Kirchhoff, woven cloth)
:mod:`~hood.energies.bending`             bending of hinges
:mod:`~hood.energies.damping`             viscosity of both
:mod:`~hood.energies.contact`             contact with the body
:mod:`~hood.energies.friction`            friction on the body
:mod:`~hood.energies.self_contact`        contact and friction of cloth with cloth
:mod:`~hood.energies.wind`                drag of the air
:mod:`~hood.energies.pressure`            air inside the cloth
:mod:`~hood.energies.potential`           their sum
:mod:`~hood.energies.problem`             what they read of a step
:mod:`~hood.energies.term`                what the solver asks of an energy
:mod:`~hood.energies.compiled_elements`   stretching and bending in C++, with gradients for training
========================================  =====================================================

Never minimises: that is the solver's or the network's part.
"""

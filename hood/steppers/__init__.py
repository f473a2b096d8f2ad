"""Ways to take a step, behind one interface: network, solver, network and solver, published weights.

- :mod:`~hood.steppers.newton`: what a stepper is, and the one that solves the step
- :mod:`~hood.steppers.network`: the network takes the step; ``protocol`` says how a state enters and leaves it
- :mod:`~hood.steppers.refined`: iterations of the solver after another stepper; :mod:`~hood.steppers.stopping` ends them
- :mod:`~hood.steppers.watched`: a model without some of its energies, and the full one where they would matter
- :mod:`~hood.steppers.checkpoint`, :mod:`~hood.steppers.published`: weights of this library, and published ones
- :mod:`~hood.steppers.ranges`: what weights were trained on

A stepper knows one step; :mod:`hood.rollouts` calls it frame after frame.
"""

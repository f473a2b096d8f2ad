"""Simulates clothing on characters of Blender with hood, which runs as a process of its own.

Nothing of Blender is imported before :func:`register`: the modules that need no Blender are usable and tested without it.
"""

from __future__ import annotations


def register() -> None:
    """What Blender calls when the add-on is switched on."""
    from . import operators, panel, preferences, properties

    for module in (preferences, properties, operators, panel):
        module.register()


def unregister() -> None:
    """What Blender calls when it is switched off: a bake that runs is cancelled, its frames stay."""
    from . import job, operators, panel, preferences, properties

    job.cancel_all()
    for module in (panel, operators, properties, preferences):
        module.unregister()

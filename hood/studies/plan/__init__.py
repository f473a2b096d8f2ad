"""``hood plan``: which parts of a model a scene needs, measured, and what each costs."""

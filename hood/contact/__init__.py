"""Contact of cloth with a body and with cloth: which points touch, where, and from how far.

The rules in the order in which a step asks them:

1. :mod:`~hood.contact.contact`: every vertex takes the closest point of the body; its tangent plane is the obstacle.
2. :mod:`~hood.contact.sample_points`: points inside faces and edges, where the body is curved between vertices.
3. :mod:`~hood.contact.sample_points`: from how far a plane acts.
4. :mod:`~hood.contact.further`: a second plane, where a vertex lies between two sides of the body, as in an armpit; planes that
are added after a step that ended in the body, and triangles that still cut it.
5. :mod:`~hood.contact.self_contact`: pairs of vertices and faces of cloth.

It finds contact and never computes a force; forces are :mod:`hood.energies`.
"""

"""The kernel behind :func:`hood.mesh.closest_point.vertices.nearest_three`; importing this module needs Triton.

No annotations from the future here: Triton reads the annotations of a kernel's constants.
"""
# mypy: disable-error-code="no-untyped-def, misc"

import triton
import triton.language as tl


@triton.jit
def _axis(pointer, rows, present, AXIS: tl.constexpr):
    return tl.load(pointer + 3 * rows + AXIS, mask=present, other=0.0)


@triton.jit
def _first_of(scenes, number, scene):
    """The first entry of ``scenes``, ascending, that is at least ``scene``."""
    low, high = number * 0, number
    while low < high:
        middle = (low + high) // 2
        if tl.load(scenes + middle) < scene:
            low = middle + 1
        else:
            high = middle
    return low


@triton.jit
def nearest_pass(
    points, point_scene, vertices, vertex_scene, usable, index, away, count, number, TILE: tl.constexpr, CHUNK: tl.constexpr
):
    """Of TILE points the three nearest usable vertices of their scene, ascending, the first of equals first, and distances;
    where there is none, the nearest again and an infinite one. No distance but these is kept. Scenes are ascending: vertices
    of other ones than those of the points are passed over."""
    rows = tl.program_id(0) * TILE + tl.arange(0, TILE)
    inside = rows < count
    x, y, z = _axis(points, rows, inside, 0), _axis(points, rows, inside, 1), _axis(points, rows, inside, 2)
    scene = tl.load(point_scene + rows, mask=inside, other=-1)
    far = float("inf")
    first, second, third = x * 0.0 + far, x * 0.0 + far, x * 0.0 + far
    here, next_one, last = rows * 0, rows * 0, rows * 0
    begin = _first_of(vertex_scene, number, tl.load(point_scene + tl.program_id(0) * TILE))
    end = _first_of(vertex_scene, number, tl.load(point_scene + tl.minimum(tl.program_id(0) * TILE + TILE, count) - 1) + 1)
    while begin < end:
        others = begin + tl.arange(0, CHUNK)
        present = others < end
        counts = tl.load(usable + others, mask=present, other=0) != 0
        apart = x[:, None] - _axis(vertices, others, present, 0)[None, :]
        total = apart * apart
        apart = y[:, None] - _axis(vertices, others, present, 1)[None, :]
        total += apart * apart
        apart = z[:, None] - _axis(vertices, others, present, 2)[None, :]
        total += apart * apart
        same = scene[:, None] == tl.load(vertex_scene + others, mask=present, other=-2)[None, :]
        total = tl.where(same & counts[None, :] & (total < far), total, far)  # what is no number is not less either
        if tl.min(tl.min(total, axis=1) - third, axis=0) < 0:
            for _ in tl.static_range(3):
                least, place = tl.min(total, axis=1), tl.argmin(total, axis=1)
                total = tl.where(tl.arange(0, CHUNK)[None, :] == place[:, None], far, total)
                place = begin + place
                # Earlier vertices stay before equally near ones.
                nearer = least < third
                third, last = tl.where(nearer, least, third), tl.where(nearer, place, last)
                nearer = third < second
                second, third = tl.where(nearer, third, second), tl.where(nearer, second, third)
                next_one, last = tl.where(nearer, last, next_one), tl.where(nearer, next_one, last)
                nearer = second < first
                first, second = tl.where(nearer, second, first), tl.where(nearer, first, second)
                here, next_one = tl.where(nearer, next_one, here), tl.where(nearer, here, next_one)
        begin += CHUNK
    tl.store(index + 3 * rows, here.to(tl.int64), mask=inside)
    tl.store(index + 3 * rows + 1, tl.where(second < far, next_one, here).to(tl.int64), mask=inside)
    tl.store(index + 3 * rows + 2, tl.where(third < far, last, here).to(tl.int64), mask=inside)
    tl.store(away + 3 * rows, tl.sqrt(first), mask=inside)
    tl.store(away + 3 * rows + 1, tl.sqrt(second), mask=inside)
    tl.store(away + 3 * rows + 2, tl.sqrt(third), mask=inside)

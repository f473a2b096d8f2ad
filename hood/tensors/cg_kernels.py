"""The kernels behind :func:`hood.tensors.conjugate_gradients.block_cg`; importing this module needs Triton.

No annotations from the future here: Triton reads the annotations of a kernel's constants.
"""
# mypy: disable-error-code="no-untyped-def, misc"

import triton
import triton.language as tl


@triton.jit
def _total(parts, first, last, CHUNK: tl.constexpr):
    """What the tiles ``first`` … ``last`` − 1 have found, added in their order."""
    places = tl.arange(0, CHUNK)
    total = tl.zeros([CHUNK], dtype=parts.dtype.element_ty)
    for begin in range(first, last, CHUNK):
        total += tl.load(parts + begin + places, mask=begin + places < last, other=0.0)
    return tl.sum(total, axis=0)


@triton.jit
def _rows_of(tile_rows, tile_ends, tile, TILE: tl.constexpr):
    rows = tl.load(tile_rows + tile) + tl.arange(0, TILE)
    return rows, rows < tl.load(tile_ends + tile)


@triton.jit
def _vectors(pointer, rows, present):
    """The three columns of some rows of (N, 3)."""
    x = tl.load(pointer + 3 * rows, mask=present, other=0.0)
    y = tl.load(pointer + 3 * rows + 1, mask=present, other=0.0)
    return x, y, tl.load(pointer + 3 * rows + 2, mask=present, other=0.0)


@triton.jit
def _keep(pointer, rows, present, x, y, z):
    tl.store(pointer + 3 * rows, x, mask=present)
    tl.store(pointer + 3 * rows + 1, y, mask=present)
    tl.store(pointer + 3 * rows + 2, z, mask=present)


@triton.jit
def _preconditioned(inverse, rows, present, x, y, z):
    a, b, c = _vectors(inverse, 3 * rows, present)
    u = a * x + b * y + c * z
    a, b, c = _vectors(inverse, 3 * rows + 1, present)
    v = a * x + b * y + c * z
    a, b, c = _vectors(inverse, 3 * rows + 2, present)
    return u, v, a * x + b * y + c * z


@triton.jit
def begin_pass(right, inverse, x, r, z, p, parts, stopped, indefinite, tile_rows, tile_ends, tile_scene, TILE: tl.constexpr):
    """x = 0, r = b, z = P r, and r·z of every tile."""
    tile = tl.program_id(0)
    rows, present = _rows_of(tile_rows, tile_ends, tile, TILE)
    r0, r1, r2 = _vectors(right, rows, present)
    z0, z1, z2 = _preconditioned(inverse, rows, present, r0, r1, r2)
    _keep(r, rows, present, r0, r1, r2)
    _keep(z, rows, present, z0, z1, z2)
    _keep(x, rows, present, r0 * 0.0, r1 * 0.0, r2 * 0.0)
    _keep(p, rows, present, r0 * 0.0, r1 * 0.0, r2 * 0.0)
    tl.store(parts + tile, tl.sum(r0 * z0 + r1 * z1 + r2 * z2, axis=0))
    scene = tl.load(tile_scene + tile)
    tl.store(stopped + scene, 0)  # every tile of a scene writes the same
    tl.store(indefinite + scene, 0)


@triton.jit
def product_pass(
    triples,
    columns,
    starts,
    z,
    before,
    p,
    q,
    rz,
    pq,
    stopped,
    tile_rows,
    tile_ends,
    tile_scene,
    scene_tiles,
    number,
    tiles,
    scenes,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """p = z + β p and q = A p, the neighbours' p made anew where it is read; p·q of every tile."""
    tile = tl.program_id(0)
    scene = tl.load(tile_scene + tile)
    if tl.load(stopped + number * scenes + scene) == 0:
        first, last = tl.load(scene_tiles + scene), tl.load(scene_tiles + scene + 1)
        rows, present = _rows_of(tile_rows, tile_ends, tile, TILE)
        now = _total(rz + number * tiles, first, last, CHUNK)
        share = now * 0.0
        if number > 0:
            share = now / _total(rz + (number - 1) * tiles, first, last, CHUNK)
        z0, z1, z2 = _vectors(z, rows, present)
        p0, p1, p2 = _vectors(before, rows, present)
        p0, p1, p2 = z0 + share * p0, z1 + share * p1, z2 + share * p2
        _keep(p, rows, present, p0, p1, p2)
        begin = tl.load(starts + rows, mask=present, other=0)
        degree = tl.load(starts + rows + 1, mask=present, other=0) - begin
        q0, q1, q2 = p0 * 0.0, p1 * 0.0, p2 * 0.0
        for slot in range(0, tl.max(degree, axis=0)):
            here = present & (slot < degree)
            column = tl.load(columns + begin + slot, mask=here, other=0)
            v0, v1, v2 = _vectors(z, column, here)
            w0, w1, w2 = _vectors(before, column, here)
            v0, v1, v2 = v0 + share * w0, v1 + share * w1, v2 + share * w2
            entry = 3 * begin + slot
            a, b, c = _vectors(triples, entry, here)
            q0 += a * v0 + b * v1 + c * v2
            a, b, c = _vectors(triples, entry + degree, here)
            q1 += a * v0 + b * v1 + c * v2
            a, b, c = _vectors(triples, entry + 2 * degree, here)
            q2 += a * v0 + b * v1 + c * v2
        _keep(q, rows, present, q0, q1, q2)
        tl.store(pq + number * tiles + tile, tl.sum(p0 * q0 + p1 * q1 + p2 * q2, axis=0))


@triton.jit
def update_pass(
    inverse,
    p,
    q,
    x,
    r,
    z,
    rz,
    pq,
    tolerance,
    indefinite,
    stopped,
    tile_rows,
    tile_ends,
    tile_scene,
    scene_tiles,
    number,
    tiles,
    scenes,
    TILE: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """x += α p, r −= α q, z = P r where a scene goes on, and r·z of every tile; whether it goes on after that."""
    tile = tl.program_id(0)
    scene = tl.load(tile_scene + tile)
    halted = tl.load(stopped + number * scenes + scene)
    if halted == 0:
        first, last = tl.load(scene_tiles + scene), tl.load(scene_tiles + scene + 1)
        now, curvature = _total(rz + number * tiles, first, last, CHUNK), _total(pq + number * tiles, first, last, CHUNK)
        sharp = tl.load(tolerance + scene)
        wanted = now > sharp * sharp * _total(rz, first, last, CHUNK)
        if wanted and curvature > 0:
            rows, present = _rows_of(tile_rows, tile_ends, tile, TILE)
            length = now / curvature
            a, b, c = _vectors(p, rows, present)
            x0, x1, x2 = _vectors(x, rows, present)
            _keep(x, rows, present, x0 + length * a, x1 + length * b, x2 + length * c)
            a, b, c = _vectors(q, rows, present)
            r0, r1, r2 = _vectors(r, rows, present)
            r0, r1, r2 = r0 - length * a, r1 - length * b, r2 - length * c
            _keep(r, rows, present, r0, r1, r2)
            z0, z1, z2 = _preconditioned(inverse, rows, present, r0, r1, r2)
            _keep(z, rows, present, z0, z1, z2)
            tl.store(rz + (number + 1) * tiles + tile, tl.sum(r0 * z0 + r1 * z1 + r2 * z2, axis=0))
        else:
            halted = 1
            if wanted:
                tl.store(indefinite + scene, 1)
    tl.store(stopped + (number + 1) * scenes + scene, halted)

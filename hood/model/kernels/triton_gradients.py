"""The kernels of the gradients behind :mod:`hood.model.kernels.triton_step`; importing this module needs Triton.

No annotations from the future here: Triton reads the annotations of a kernel's constants.
"""
# mypy: disable-error-code="no-untyped-def, misc"

import triton
import triton.language as tl

from hood.model.kernels.triton_kernels import dot, layer_of, vector_of


@triton.jit
def _back(grad, pointer, stride, columns, present, dtype, PRECISION: tl.constexpr, WIDEN: tl.constexpr):
    """grad W for a layer's weights W (out, in)."""
    mask = present[:, None] & present[None, :]
    weight = tl.load(pointer + columns[:, None] * stride + columns[None, :], mask=mask, other=0.0).to(dtype)
    return dot(grad.to(dtype), weight, PRECISION, WIDEN)


@triton.jit
def _tail_back(
    grad,
    hidden,
    weight_2,
    bias_2,
    weight_3,
    bias_3,
    scale,
    columns,
    present,
    eps,
    dtype,
    PRECISION: tl.constexpr,
    WIDEN: tl.constexpr,
    WIDTH: tl.constexpr,
):
    """The gradient before the first ReLU from ``grad`` behind the layer norm, both in float32, and what those of the parameters
    are made of: what was before the layers, and the gradients behind them. ``hidden`` as in :func:`_tail`."""
    one = tl.maximum(hidden, 0.0).to(dtype)
    middle = layer_of(one, weight_2, WIDTH, columns, present, PRECISION, WIDEN) + vector_of(bias_2, columns, present)[None, :]
    two = tl.maximum(middle, 0.0).to(dtype)
    raw = layer_of(two, weight_3, WIDTH, columns, present, PRECISION, WIDEN) + vector_of(bias_3, columns, present)[None, :]
    centred = tl.where(present[None, :], raw - (tl.sum(raw, axis=1) / WIDTH)[:, None], 0.0)
    rstd = 1.0 / tl.sqrt(tl.sum(centred * centred, axis=1) / WIDTH + eps)
    normed = centred * rstd[:, None]
    scaled = grad * vector_of(scale, columns, present)[None, :]
    along = (tl.sum(scaled * normed, axis=1) / WIDTH)[:, None]
    grad_3 = tl.where(
        present[None, :], (scaled - (tl.sum(scaled, axis=1) / WIDTH)[:, None] - normed * along) * rstd[:, None], 0.0
    )
    grad_2 = tl.where(two > 0.0, _back(grad_3, weight_3, WIDTH, columns, present, dtype, PRECISION, WIDEN), 0.0)
    grad_1 = tl.where(one > 0.0, _back(grad_2, weight_2, WIDTH, columns, present, dtype, PRECISION, WIDEN), 0.0)
    return grad_1, one, grad_2, two, grad_3, normed


@triton.jit
def _keep_sums(vectors, sums_1, sums_2, sums_3, sums_scale, sums_shift, columns, present, WIDTH: tl.constexpr):
    """What a program has summed of the gradients of b₁, b₂, b₃, scale and shift, one behind the other."""
    vectors += columns
    tl.store(vectors, sums_1, mask=present)
    tl.store(vectors + WIDTH, sums_2, mask=present)
    tl.store(vectors + 2 * WIDTH, sums_3, mask=present)
    tl.store(vectors + 3 * WIDTH, sums_scale, mask=present)
    tl.store(vectors + 4 * WIDTH, sums_shift, mask=present)


@triton.jit
def edges_back(
    latent,
    tables,
    stride,
    column,
    receivers,
    senders,
    chosen,
    weight_1,
    stride_1,
    weight_2,
    bias_2,
    weight_3,
    bias_3,
    scale,
    grad_updated,
    grad_received,
    stride_received,
    grad_latent,
    factors,
    parts,
    count,
    tiles,
    eps,
    PRECISION: tl.constexpr,
    WIDEN: tl.constexpr,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    TILE: tl.constexpr,
    SOME: tl.constexpr,
):
    """Gradients of the edges' latents; the factors of those of W₁, W₂ and W₃, (6, N, d): what was before the layers, and the
    gradients behind them; and the other parameters' gradients, summed over the tiles of a program. What the forward pass knew
    is computed again."""
    program = tl.program_id(0)
    columns = tl.arange(0, PADDED)
    present = columns < WIDTH
    dtype = latent.dtype.element_ty
    sums_1 = tl.zeros((PADDED,), tl.float32)
    sums_2 = tl.zeros((PADDED,), tl.float32)
    sums_3 = tl.zeros((PADDED,), tl.float32)
    sums_scale = tl.zeros((PADDED,), tl.float32)
    sums_shift = tl.zeros((PADDED,), tl.float32)
    tile = program
    while tile < tiles:
        rows = tile * TILE + tl.arange(0, TILE)
        inside = rows < count
        both = inside[:, None] & present[None, :]
        if SOME:
            owned = tl.load(chosen + rows, mask=inside, other=0).to(tl.int64)
        else:
            owned = rows.to(tl.int64)
        places = owned[:, None] * WIDTH + columns[None, :]
        node = tl.load(receivers + rows, mask=inside, other=0).to(tl.int64)
        sender = tl.load(senders + rows, mask=inside, other=0).to(tl.int64)
        edge = tl.load(latent + places, mask=both, other=0.0)
        at_ends = tables + column + columns[None, :]
        hidden = tl.load(at_ends + node[:, None] * stride, mask=both, other=0.0).to(tl.float32)
        hidden += tl.load(at_ends + WIDTH + sender[:, None] * stride, mask=both, other=0.0).to(tl.float32)
        hidden += layer_of(edge, weight_1, stride_1, columns, present, PRECISION, WIDEN)
        beside = tl.load(grad_updated + places, mask=both, other=0.0).to(tl.float32)
        at_node = grad_received + node[:, None] * stride_received + columns[None, :]
        grad = beside + tl.load(at_node, mask=both, other=0.0).to(tl.float32)
        rest = (weight_2, bias_2, weight_3, bias_3, scale)
        back = _tail_back(grad, hidden, *rest, columns, present, eps, dtype, PRECISION, WIDEN, WIDTH)
        grad_1, one, grad_2, two, grad_3, normed = back
        sums_1 += tl.sum(grad_1, axis=0)
        sums_2 += tl.sum(grad_2, axis=0)
        sums_3 += tl.sum(grad_3, axis=0)
        sums_scale += tl.sum(grad * normed, axis=0)
        sums_shift += tl.sum(grad, axis=0)
        whole = beside + _back(grad_1, weight_1, stride_1, columns, present, dtype, PRECISION, WIDEN)
        tl.store(grad_latent + places, whole.to(dtype), mask=both)
        target = factors + rows[:, None].to(tl.int64) * WIDTH + columns[None, :]
        length = count.to(tl.int64) * WIDTH
        tl.store(target, edge, mask=both)
        tl.store(target + length, one, mask=both)
        tl.store(target + 2 * length, two, mask=both)
        tl.store(target + 3 * length, grad_1.to(dtype), mask=both)
        tl.store(target + 4 * length, grad_2.to(dtype), mask=both)
        tl.store(target + 5 * length, grad_3.to(dtype), mask=both)
        tile += tl.num_programs(0)
    own = parts + program * 5 * WIDTH
    _keep_sums(own, sums_1, sums_2, sums_3, sums_scale, sums_shift, columns, present, WIDTH)


@triton.jit
def ends_back(
    grad_hidden,
    nodes,
    offsets,
    reverse,
    grad_tables,
    stride,
    column,
    count,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    TILE: tl.constexpr,
):
    """Gradients of the tables at TILE nodes: sums over the edges that a node receives, and over those that it sends."""
    places = tl.program_id(0) * TILE + tl.arange(0, TILE)
    inside = places < count
    columns = tl.arange(0, PADDED)
    present = columns < WIDTH
    node = tl.load(nodes + places, mask=inside, other=0).to(tl.int64)
    first = tl.load(offsets + places, mask=inside, other=0)
    degree = tl.load(offsets + places + 1, mask=inside, other=0) - first
    most = tl.max(degree, axis=0)
    received = tl.zeros((TILE, PADDED), tl.float32)
    sent = tl.zeros((TILE, PADDED), tl.float32)
    step = most * 0
    while step < most:
        here = step < degree
        both = here[:, None] & present[None, :]
        row = (first + step).to(tl.int64)
        other = tl.load(reverse + row, mask=here, other=0).to(tl.int64)
        received += tl.load(grad_hidden + row[:, None] * WIDTH + columns[None, :], mask=both, other=0.0).to(tl.float32)
        sent += tl.load(grad_hidden + other[:, None] * WIDTH + columns[None, :], mask=both, other=0.0).to(tl.float32)
        step += 1
    both = inside[:, None] & present[None, :]
    target = grad_tables + node[:, None] * stride + column + columns[None, :]
    tl.store(target, received.to(grad_tables.dtype.element_ty), mask=both)
    tl.store(target + WIDTH, sent.to(grad_tables.dtype.element_ty), mask=both)


@triton.jit
def tail_back(
    hidden,
    grad_out,
    weight_2,
    bias_2,
    weight_3,
    bias_3,
    scale,
    grad_hidden,
    factors,
    parts,
    count,
    tiles,
    eps,
    PRECISION: tl.constexpr,
    WIDEN: tl.constexpr,
    WIDTH: tl.constexpr,
    PADDED: tl.constexpr,
    TILE: tl.constexpr,
):
    """The gradient before the first ReLU; the factors of those of W₂ and W₃, (4, N, d): what was before the layers, and the
    gradients behind them; and the other parameters' gradients, summed over the tiles of a program."""
    program = tl.program_id(0)
    columns = tl.arange(0, PADDED)
    present = columns < WIDTH
    dtype = hidden.dtype.element_ty
    sums_1 = tl.zeros((PADDED,), tl.float32)
    sums_2 = tl.zeros((PADDED,), tl.float32)
    sums_3 = tl.zeros((PADDED,), tl.float32)
    sums_scale = tl.zeros((PADDED,), tl.float32)
    sums_shift = tl.zeros((PADDED,), tl.float32)
    tile = program
    while tile < tiles:
        rows = tile * TILE + tl.arange(0, TILE)
        both = (rows < count)[:, None] & present[None, :]
        places = rows[:, None].to(tl.int64) * WIDTH + columns[None, :]
        first = tl.load(hidden + places, mask=both, other=0.0).to(tl.float32)
        grad = tl.load(grad_out + places, mask=both, other=0.0).to(tl.float32)
        rest = (weight_2, bias_2, weight_3, bias_3, scale)
        back = _tail_back(grad, first, *rest, columns, present, eps, dtype, PRECISION, WIDEN, WIDTH)
        grad_1, one, grad_2, two, grad_3, normed = back
        length = count.to(tl.int64) * WIDTH
        tl.store(factors + places, one, mask=both)
        tl.store(factors + length + places, two, mask=both)
        tl.store(factors + 2 * length + places, grad_2.to(dtype), mask=both)
        tl.store(factors + 3 * length + places, grad_3.to(dtype), mask=both)
        sums_1 += tl.sum(grad_1, axis=0)
        sums_2 += tl.sum(grad_2, axis=0)
        sums_3 += tl.sum(grad_3, axis=0)
        sums_scale += tl.sum(grad * normed, axis=0)
        sums_shift += tl.sum(grad, axis=0)
        tl.store(grad_hidden + places, grad_1.to(dtype), mask=both)
        tile += tl.num_programs(0)
    own = parts + program * 5 * WIDTH
    _keep_sums(own, sums_1, sums_2, sums_3, sums_scale, sums_shift, columns, present, WIDTH)
